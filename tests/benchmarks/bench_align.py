"""Time per pair of pictures and per window: `python -m pytest tests/benchmarks/bench_align.py`. Goal: 3 ms a pair, one core.

Side by side: our joint alignment and the paper's smallest-angle matching on the same messages, and the parts of ours.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.align import JointAlign, PaperAlign
from stages.align.refine import Tolerances, refine, street_directions
from stages.align.spectra import level_lines, overlap, peaks, spectrum
from stages.heading.hypothesis_bank import DIRECTIONS, BranchSettings, Displacement, HypothesisBank
from stages.messages import CameraMount
from tests.stages.align.made_joint_flight import START_NS, S
from tests.stages.align.made_lines import ATLANTA, MANHATTAN, MS, seen, turned

STREETS = {"manhattan, 80 lines": (MANHATTAN, 20), "atlanta, 300 lines": (ATLANTA, 60)}
STRAIGHT = math.radians(0.25)
ALLOWED = Tolerances(STRAIGHT, math.radians(0.1), math.radians(0.5), math.radians(0.05))


def pairs(streets, per_direction, count=200):
    """Images of a turning drone at 10 Hz."""
    out = []
    for i in range(count):
        made = {"per_direction": per_direction, "stamp_ns": START_NS + i * 100 * MS, "seed": i % 8}
        out.append(
            (
                seen(CameraMount.VEHICLE, turned(1, 2, 3), streets, **made),
                seen(CameraMount.DRONE, turned(4, -3, i), streets, **made),
            )
        )
    return out


@pytest.mark.parametrize("name", STREETS)
@pytest.mark.parametrize("stage_type", [JointAlign, PaperAlign])
def test_a_pair(benchmark, name, stage_type):
    made = pairs(*STREETS[name])
    stage, turn = stage_type(), iter(made * 1000)

    def one():
        vehicle, drone = next(turn)
        return [*stage.on_vehicle(vehicle), *stage.on_drone(drone)]

    benchmark.pedantic(one, rounds=len(made) - 5, warmup_rounds=5)


@pytest.mark.parametrize("name", STREETS)
def test_spectra_and_overlap(benchmark, name):
    ((vehicle, drone),) = pairs(*STREETS[name], count=1)

    def match():
        a, b = (spectrum(level_lines(seen_, STRAIGHT)) for seen_ in (vehicle, drone))
        return peaks(overlap(a, b), math.radians(4))

    benchmark(match)


@pytest.mark.parametrize("name", STREETS)
def test_refinement(benchmark, name):
    ((vehicle, drone),) = pairs(*STREETS[name], count=1)
    lines = [level_lines(seen_, STRAIGHT) for seen_ in (vehicle, drone)]
    a, b = (spectrum(one) for one in lines)
    yaw = peaks(overlap(a, b), math.radians(4))[0].yaw_rad
    benchmark(refine, *lines, street_directions(a, b, yaw), yaw, ALLOWED)


def test_a_window_of_motion(benchmark):
    bank = HypothesisBank(BranchSettings())
    displacement = np.array([0.5, 0.1])
    window = Displacement(S, 2 * S, np.tile(displacement, (DIRECTIONS, 1)), 0.01 * np.eye(2), displacement, 0.03, True)
    benchmark(bank.see, window)
