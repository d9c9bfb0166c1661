"""Time per message of the fusion: `python -m pytest tests/benchmarks/bench_fuse.py`. Goal: p99 2 ms, one core.

Side by side: the smoother and the Kalman filter, over one flight of 12 s; the parts of both.
"""

from __future__ import annotations

import time

import numpy as np
import pytest

from stages.fuse import Fuse
from stages.fuse.motion_model import Step
from stages.fuse.settings import FuseErrors
from stages.fuse.smoother import Smoother
from stages.geometry.frames import rotation_z
from stages.heading.motion_yaw import weigh
from tests.stages.fuse.ekf import Ekf, EkfFuse
from tests.stages.fuse.made_drone_flight import Made
from tests.stages.heading.test_motion_yaw import circle, points

STAGES = {"smoother": Fuse, "ekf": EkfFuse}
BACKS = {"smoother": lambda: Smoother(3.0), "ekf": Ekf}
TENTH = 100_000_000
STEP = Step(rotation_z(0.05), np.array([0.3, 0.0, 0.0]), np.diag([0.002**2] * 3 + [0.01**2] * 3), True, True)
STAYS = Step(np.eye(3), np.zeros(3), np.zeros((6, 6)), True, True)


@pytest.mark.parametrize("name", STAGES)
def test_every_message_of_a_flight(benchmark, name):
    """One round is a flight; the extra info is by port, of each message with all that follows from it, poses included.

    In CPU time of the thread: on a machine that others use too, what they take is not ours.
    """
    events = Made(vehicle_mps=3.0, vehicle_dps=10.0).events()
    took: dict[str, list[float]] = {}

    def fly():
        stage = STAGES[name]()
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


def flown(name, steps=40):
    back = BACKS[name]()
    back.start(0, np.eye(3), np.zeros(3), 0.01 * np.eye(6))
    for k in range(1, steps):
        back.extend(k * TENTH, STEP, None, 0.1)
    return back


@pytest.mark.parametrize("name", BACKS)
def test_one_pose_more(benchmark, name):
    back = flown(name)
    benchmark.pedantic(lambda: back.extend(back.stamp_ns + TENTH, STEP, None, 0.1), rounds=300, warmup_rounds=10)


@pytest.mark.parametrize("name", BACKS)
def test_one_position(benchmark, name):
    back = flown(name)

    def setup():
        back.extend(back.stamp_ns + TENTH, STEP, None, 0.1)

    def add():
        back.add_position(back.stamp_ns, STAYS, back.xyz_map_m + 0.02, 0.0025 * np.eye(3))

    benchmark.pedantic(add, setup=setup, rounds=300, warmup_rounds=10)


@pytest.mark.parametrize("name", STAGES)
def test_a_prediction(benchmark, name):
    stage = STAGES[name]()
    made = Made(until_s=6.0)
    made.run(stage)
    now_ns = stage._intake.now_ns
    benchmark(lambda: stage._pose(now_ns))


def test_a_heading_by_motion(benchmark):
    benchmark(weigh, points(circle(48), step_s=0.6), FuseErrors())
