"""The cost of the engine: a graph of three nodes replayed, and the same nodes called directly on the same records.

Run: pytest tests/benchmarks/bench_flow.py --benchmark-columns=min,median,max
Cost per step = (time of the replay - time of direct calls) / STEPS; `test_cost_per_step` prints its median.
"""

from __future__ import annotations

import statistics
import sys
import time

import pytest

from flow.graph import load_graph
from flow.link import Record
from flow.replay import Replay, replay
from flow.taps import Digest
from tests.flow.toys import GRAPH, Add, Double, Numbers

RECORDS = [Record("/numbers", 1000 + i, i, b"1.5", i) for i in range(2_000)]
STEPS = 4 * len(RECORDS)  # decode, double, add.left, add.right


@pytest.fixture
def graph(tmp_path):
    (tmp_path / "x.yaml").write_text(GRAPH)
    return load_graph(tmp_path / "x.yaml")


def call_directly():
    numbers, double, add = Numbers(), Double(), Add(name="adder")
    add._seen = Total()
    for record in RECORDS:
        number = numbers.decode(record)
        doubled = double.on_number(number)
        tuple(add.on_left(number))
        tuple(add.on_right(doubled))


class Total(list):
    """Bounds the adder's list of numbers: summing it would otherwise cost more than the engine."""

    def append(self, value):
        if len(self) >= 8:
            self.clear()
        super().append(value)


def run_engine(graph, taps=()):
    runner = Replay(graph, taps)
    runner.nodes["add"]._seen = Total()
    for record in RECORDS:
        runner.feed(record)
    return runner.finish()


def test_stages_called_directly(benchmark):
    benchmark.pedantic(call_directly, rounds=15, warmup_rounds=2)


def test_stages_in_the_engine(benchmark, graph):
    report = benchmark.pedantic(run_engine, (graph,), rounds=15, warmup_rounds=2)
    assert report.steps == STEPS + 2  # and a finish for each stage


def test_stages_in_the_engine_with_the_hash_of_every_message(benchmark, graph):
    benchmark.pedantic(lambda: run_engine(graph, [Digest()]), rounds=15, warmup_rounds=2)


def test_cost_per_step(benchmark, graph):
    """The two alternate, so that other load on the host affects both."""

    def once(work):
        begin = time.perf_counter()
        work()
        return time.perf_counter() - begin

    pairs = [(once(call_directly), once(lambda: run_engine(graph))) for _ in range(15)]
    costs_us = [(engine - direct) / STEPS * 1e6 for direct, engine in pairs]
    benchmark.extra_info["engine_us_per_step"] = round(statistics.median(costs_us), 2)
    benchmark.extra_info["ratio"] = round(statistics.median(e / d for d, e in pairs), 2)
    sys.stdout.write(
        f"\nengine cost per step: median {statistics.median(costs_us):.2f} us (range {min(costs_us):.2f}-{max(costs_us):.2f})"
    )
    benchmark.pedantic(replay, (graph, []), rounds=1)
