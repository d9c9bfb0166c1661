"""Stages that yield: they rest while others' queues run over, and no longer."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from flow.edge import Waiting
from flow.graph import load_graph
from flow.inbox import Inbox
from flow.problem import ConfigError
from flow.stage import Stage
from flow.yielding import FIRST_S, MOST_S, Queue, Rest
from stages.messages import Image
from tests.flow.live_toys import PATIENCE_S, Memory, graph_of, run_live
from tests.flow.toys import Number

ROOT = Path(__file__).resolve().parents[2]
PICTURES = ("vp_vehicle", "vp_drone", "ego", "drone_odometry")
DEPTH = 8
LIVE = f"""\
stages:
  gate:
    use: tests.flow.test_yielding.Slow
    inputs: {{number: {{from: line.number, depth: {DEPTH}}}}}
  pictures:
    use: tests.flow.toys.Double
    inputs: {{number: {{from: others.number, policy: latest}}}}
    yields: true
links:
  line: {{use: tests.flow.live_toys.Line}}
  others: {{use: tests.flow.live_toys.OtherLine}}
"""


class Slow(Stage):
    """Cannot keep up."""

    def on_number(self, number: Number) -> None:
        del number
        time.sleep(0.4)


def numbers(inbox: Inbox, count: int) -> None:
    for i in range(count):
        inbox.put(0, i, 0, Number(stamp_ns=i, value=float(i)))


@pytest.fixture
def inbox() -> Inbox:
    return Inbox([Waiting("drop_oldest", DEPTH)])


def test_it_rests_longer_each_time_while_a_queue_is_half_full_then_shorter_then_not(inbox):
    rest = Rest([Queue("gate.number", inbox, 0, DEPTH)])
    assert (rest.next_s(), rest.fullest()) == (0.0, None)
    numbers(inbox, DEPTH // 2)
    assert rest.fullest() == "gate.number"
    assert [rest.next_s() for _ in range(5)] == [FIRST_S, 2 * FIRST_S, 4 * FIRST_S, MOST_S, MOST_S]
    inbox.take_all()
    eased = [rest.next_s() for _ in range(12)]
    assert eased == sorted(eased, reverse=True)
    assert eased[0] < MOST_S
    assert eased[-1] == 0.0


def test_what_was_dropped_between_two_pictures_counts_though_nothing_waits_now(inbox):
    rest = Rest([Queue("gate.number", inbox, 0, DEPTH)])
    rest.next_s()
    numbers(inbox, DEPTH + 1)
    inbox.take_all()
    assert rest.next_s() == FIRST_S
    assert rest.next_s() < FIRST_S  # it is not counted twice


def yielding(tmp_path) -> tuple[int, list[str]]:
    """How many of 40 pictures, one each 20 ms, the stage took while the gate's queue was full; and what was said."""
    memory = Memory()
    live = run_live(graph_of(tmp_path, LIVE), [memory])
    try:
        live.nodes["line"].put(*range(3 * DEPTH))
        until = time.monotonic() + PATIENCE_S
        while live.report().edges["gate.number"].dropped == 0:
            assert time.monotonic() < until
            time.sleep(0.005)
        for i in range(40):
            live.nodes["others"].put(i)
            time.sleep(0.02)
        taken = live.report().edges["pictures.number"].taken
        return taken, [str(incident) for incident in live.report().incidents]
    finally:
        live.stop()


def test_while_another_stage_loses_messages_it_takes_fewer_pictures_and_that_is_said(tmp_path):
    taken, said = yielding(tmp_path)
    assert 1 <= taken < 12
    assert any("pictures: takes fewer pictures: this host is too slow for all" in text for text in said)


def test_a_configuration_says_whether_a_stage_yields(tmp_path):
    assert {spec.name for spec in graph_of(tmp_path, LIVE).nodes.values() if spec.yields} == {"pictures"}
    (tmp_path / "x.yaml").write_text(LIVE.replace("yields: true", "yields: 3\n    thread: gate"))
    with pytest.raises(ConfigError, match=r"x.yaml:8: stages.odometry.visual.yields: must be true or false, got 3\."):
        load_graph(tmp_path / "x.yaml")
    (tmp_path / "x.yaml").write_text(LIVE.replace("yields: true", "yields: true\n    thread: gate"))
    with pytest.raises(ConfigError, match="'pictures' works in the same thread, 'gate', and yields: both would rest"):
        load_graph(tmp_path / "x.yaml")


def test_in_the_field_all_that_takes_pictures_yields_and_nothing_else():
    graph = load_graph(ROOT / "configs" / "field.yaml")
    pictures = {edge.consumer for edge in graph.edges if edge.message is Image and edge.consumer in graph.nodes}
    stages = {name for name in pictures if graph.nodes[name].kind == "stages"}
    assert {spec.name for spec in graph.nodes.values() if spec.yields} == stages == set(PICTURES)
