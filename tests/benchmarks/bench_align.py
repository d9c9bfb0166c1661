"""Time per pair of images: `python -m pytest tests/benchmarks/bench_align.py`. Goal: 3 ms a pair, one core.

Side by side: our joint alignment and the paper's smallest-angle matching on the same messages, and the parts of ours.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.align import JointAlign, PaperAlign
from stages.align.refine import Tolerances, refine, street_directions
from stages.align.spectra import level_lines, overlap, peaks, spectrum
from stages.geometry.frames import rotation_z
from stages.heading.inertial_bank import start
from stages.heading.rotation_matches import RotationMatches, add_matches
from stages.messages import CameraMount
from tests.stages.align.made_lines import ATLANTA, MANHATTAN, MS, seen, turned

STREETS = {"manhattan, 80 lines": (MANHATTAN, 20), "atlanta, 300 lines": (ATLANTA, 60)}
START_NS = 100_000_000_000
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


@pytest.mark.parametrize("matches", [1, 3])
def test_the_matches_of_a_pair_in_the_bank(benchmark, matches):
    yaws = np.radians([10.0, 45.0, 70.0])[:matches]
    made = RotationMatches(
        np.array([rotation_z(yaw) for yaw in yaws]),
        np.tile(3e-5 * np.eye(3), (matches, 1, 1)),
        np.full(matches, 0.9 / matches),
        np.eye(3),
    )

    def bank():
        one = start(np.zeros(3), 0.01 * np.eye(3), None, np.array([0.0, 0.0, 1.0]))
        add_matches(one, made, 1.0)
        return (one, made, 0.1), {}

    benchmark.pedantic(add_matches, setup=bank, rounds=200)
