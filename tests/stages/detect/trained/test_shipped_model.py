"""The shipped model in skies of another physics than those of its training: tests/stages/caster.py."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.stages.caster import Ball, Drone, Wire, flying, still
from tests.stages.detect.test_evidence_detect import accepted_after_s, run, telemetry_of

PLACE_M = np.array([0.0, 8.0, 10.0])
OBJECTS = {
    "a lamp on its arm": [
        Ball(still(0.0, 8.0, 10.0), 0.15), Wire((0.0, 8.0, 10.0), (1.2, 8.0, 10.05), 0.04),
        Wire((1.2, 8.0, 10.05), (1.2, 8.0, -1.5), 0.07),
    ],
    "a wire": [Wire((-15.0, 8.0, 9.8), (15.0, 8.0, 10.2), 0.01)],
    "a bird": [Drone(flying((-8.0, 8.0, 10.0), (5.0, 0.5, 0.0)), 0.4)],
    "a balloon": [Ball(flying((-1.0, 8.0, 10.0), (0.6, 0.0, 0.3)), 0.2)],
}  # fmt: skip


def wandering(phase):
    amplitude_m, radps = np.array([1.5, 0.5, 0.8]), np.array([0.8, 1.3, 1.0])
    return lambda t_s: PLACE_M + amplitude_m * np.sin(np.outer(t_s, radps) + phase * np.array([1.0, 2.0, 3.0]))


@pytest.mark.parametrize("span_m", [0.4, 0.7])
@pytest.mark.parametrize(
    "trajectory",
    [wandering(0.0), wandering(1.7), flying((-1.0, 8.0, 9.0), (0.2, 0.0, 1.0)), flying((-7.0, 8.0, 10.0), (4.0, 0.0, 0.2))],
    ids=["wanders", "wanders otherwise", "climbs", "passes"],
)  # fmt: skip
def test_a_drone_with_telemetry_is_accepted(trajectory, span_m):
    _, detections = run([Drone(trajectory, span_m)], 4.0, publish=telemetry_of(trajectory))
    assert accepted_after_s(detections) < 4.0


def test_a_drone_that_hovers_as_its_telemetry_says_is_probable():
    hovers = still(*PLACE_M)
    candidates, _ = run([Drone(hovers)], 4.0, publish=telemetry_of(hovers))
    assert max(m.probability.max() for m in candidates if len(m.probability)) > 0.7


@pytest.mark.parametrize(
    "publish", [None, telemetry_of(wandering(0.0))], ids=["no telemetry", "the drone is elsewhere"]
)
@pytest.mark.parametrize("name", OBJECTS)
def test_no_other_object_is_accepted(name, publish):
    candidates, detections = run(OBJECTS[name], 4.0, publish=publish)
    assert any(len(m.probability) for m in candidates)  # it was weighed
    assert accepted_after_s(detections) == math.inf
