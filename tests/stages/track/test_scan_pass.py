"""One scan pass: the drone's position relative to the prediction, for several vehicle attitudes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.kernels.geometry.so3 import exp_rotation
from stages.kernels.sweep.pulses import cone_of
from stages.kernels.track.hull import DEPTH, GAP_RETURN, KIND, RETURN, A
from stages.messages import SweptPulses
from stages.track.hull import COLUMNS
from stages.track.scan_pass import collect_into, drone_returns, evaluate
from tests.stages.made import START_NS

SPAN_M = 0.5
EXPECTED_M = np.array([0.3, 0.4, 12.0])  # nearly overhead


def fan(R_map_vehicle, drone_m):
    """Pulses each 3 cm over a square metre about the prediction; those that hit the drone return."""
    side = np.linspace(-0.5, 0.5, 34)
    positions = EXPECTED_M + np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2) @ np.eye(2, 3)
    length = np.linalg.norm(positions, axis=1)
    hit = np.linalg.norm(positions - drone_m, axis=1) < 0.1
    return SweptPulses(
        stamp_ns=START_NS,
        point_stamp_ns=START_NS + np.arange(len(positions)),
        direction_vehicle=(positions / length[:, None] @ R_map_vehicle).astype(np.float32),
        range_m=np.where(hit, length, 0.0).astype(np.float32),
        laser=(np.arange(len(positions)) % 16).astype(np.uint8),
        reflectivity=np.full(len(positions), 30, dtype=np.uint8),
        turntable_rad=0.0,
        origin_vehicle_m=(0.0, 0.0, 0.0),
    )


@pytest.mark.parametrize("tilt_deg", [(0, 0, 0), (8, 0, 0), (0, -15, 0), (5, 5, 120)])
@pytest.mark.parametrize("offset_m", [(0.2, 0.0, 0.0), (0.0, -0.2, 0.0)])
def test_a_drone_next_to_the_prediction_is_estimated_for_any_vehicle_attitude(tilt_deg, offset_m):
    R = exp_rotation(np.radians(tilt_deg).astype(np.float64))
    drone_m = EXPECTED_M + offset_m
    pulses = fan(R, drone_m)
    pose, cone = (R, np.zeros(3)), cone_of(pulses.direction_vehicle)
    x, P = np.concatenate([EXPECTED_M, np.zeros(3)]), np.diag([0.2**2] * 3 + [1.0] * 3)
    scan_pass = collect_into(None, pulses, (pose, pose), cone, x, P, SPAN_M, True)
    assert scan_pass is not None
    seen = evaluate(scan_pass, SPAN_M, 0.0, 0.8, True, 1.0)
    assert seen is not None
    assert seen.hits > 10
    assert math.dist(seen.x[:2], drone_m[:2]) < 0.03


@pytest.mark.parametrize(("behind_m", "kinds"), [(0.1, {RETURN, GAP_RETURN}), (0.4, {RETURN}), (0.7, set())])
def test_gap_returns_have_to_be_nearer_to_the_prediction(behind_m, kinds):
    """Three returns behind the prediction, at 0.7, 2.8 and 5 sigma of 0.14 m."""
    found = set()
    for kind in (RETURN, GAP_RETURN):
        pulses = np.zeros((3, COLUMNS))
        pulses[:, A], pulses[:, DEPTH], pulses[:, KIND] = (-0.05, 0.0, 0.05), behind_m, kind
        if drone_returns(pulses, SPAN_M, 0.1) is not None:
            found.add(kind)
    assert found == kinds
