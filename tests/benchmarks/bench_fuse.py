"""Time per message of the fusion: `python -m pytest tests/benchmarks/bench_fuse.py`. Goal: p99 2 ms, one core.

Side by side: a LiDAR position in the bank of hypotheses and in the graph; the fixed-lag update against solving the
window again in batch.
"""

from __future__ import annotations

import time

import gtsam
import numpy as np
import pytest

from stages.fuse import Fuse
from tests.stages.fuse.imu_flights import ImuFlight

FLIGHTS = {
    "graph": ImuFlight(kind="fast", seed=2, until_s=12.0, vehicle_mps=3.0, rotations=True, images=True),
    "bank": ImuFlight(kind="hover", seed=1, until_s=12.0, wind_mps=0.0),
}


@pytest.mark.parametrize("name", FLIGHTS)
def test_every_message_of_a_flight(benchmark, name):
    """One round is a flight; the extra info is by port, of each message with all that follows from it, poses included.

    In CPU time of the thread: on a machine that others use too, what they take is not ours.
    """
    events = FLIGHTS[name].events()
    took: dict[str, list[float]] = {}

    def fly():
        stage = Fuse()
        for _, port, message in events:
            began = time.thread_time()
            tuple(getattr(stage, f"on_{port}")(message))
            took.setdefault(port, []).append(time.thread_time() - began)

    fly()
    took.clear()
    benchmark.pedantic(fly, rounds=3)
    whole = np.concatenate([np.array(v) for v in took.values()])
    for port, values in [*took.items(), ("all", whole)]:
        p50, p99 = 1e6 * np.percentile(values, [50, 99])
        benchmark.extra_info[port] = f"p50 {p50:.0f} us, p99 {p99:.0f} us, max {1e6 * max(values):.0f} us"
        print(f"{name} {port}: {benchmark.extra_info[port]}")  # noqa: T201


def flown(name):
    """The stage after a flight."""
    stage = Fuse()
    for _, port, message in FLIGHTS[name].events():
        tuple(getattr(stage, f"on_{port}")(message))
    return stage


@pytest.mark.parametrize("name", FLIGHTS)
def test_a_prediction(benchmark, name):
    stage = flown(name)
    assert stage._estimator.graph.running == (name == "graph")
    benchmark(lambda: stage._pose(stage._intake.now_ns))


def test_one_position_by_the_fixed_lag_smoother(benchmark):
    graph = flown("graph")._estimator.graph
    benchmark.pedantic(
        lambda: graph.add_position(graph.stamp_ns, graph.state.xyz_m[0] + 0.02, 0.01 * np.eye(3), graph.state),
        rounds=30,
    )
    assert graph.recoveries == 0


def test_the_same_window_in_batch(benchmark):
    smoother = flown("graph")._estimator.graph._smoother
    factors, values = smoother.getFactors(), smoother.calculateEstimate()
    batch = gtsam.NonlinearFactorGraph()
    for i in range(factors.size()):
        if factors.at(i) is not None:
            batch.add(factors.at(i))
    benchmark.pedantic(lambda: gtsam.LevenbergMarquardtOptimizer(batch, values).optimize(), rounds=30)
