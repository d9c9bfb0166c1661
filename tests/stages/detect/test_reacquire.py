"""Reacquisition at the position that the odometry predicts, and the candidate that is kept."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.detect.reacquire import (
    DUPLICATE_PASSES,
    GATE,
    LATEST_NS,
    LEAST_M,
    SOONEST_NS,
    reacquire,
    reacquired_candidate,
    without_duplicates,
)
from stages.detect.telemetry import DetectorTelemetry
from stages.messages import DroneLocalPosition
from stages.odometry.drone.telemetry import DroneTelemetry
from tests.stages.detect.test_candidate import candidate, observation
from tests.stages.made import START_NS

BEFORE_M = np.array([12.0, -5.0, 8.0])
ODOMETRY_MPS = np.array([3.0, 1.0, 0.5])  # in frame odom, whose yaw is unknown
PAUSE_S = 1.5


def telemetry(velocity_mps=ODOMETRY_MPS):
    telemetry = DroneTelemetry()
    for k in range(60):
        telemetry.add(START_NS + k * 100_000_000, 0.1 * k * np.asarray(velocity_mps), np.asarray(velocity_mps))
    return telemetry


def turned(xyz, yaw_deg):
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    return np.array([c * xyz[0] - s * xyz[1], s * xyz[0] + c * xyz[1], xyz[2]])


def seen_before(**changes):
    c = candidate(observation(0.0, BEFORE_M))
    c.is_promising = True
    for name, value in changes.items():
        setattr(c, name, value)
    return c


@pytest.mark.parametrize("yaw_deg", [0.0, 77.0, 180.0, -130.0])
def test_it_is_reacquired_for_any_yaw_of_the_odometrys_frame(yaw_deg):
    before = seen_before()
    now = observation(PAUSE_S, BEFORE_M + PAUSE_S * turned(ODOMETRY_MPS, yaw_deg))
    met = reacquire([before], now, telemetry())
    assert met is not None
    assert met[0] is before
    np.testing.assert_allclose(met[1], turned(ODOMETRY_MPS, yaw_deg), atol=1e-6)


@pytest.mark.parametrize(
    "relative_path_m", [(1.5, 0.5, 0.0), (0.0, 0.0, 1.2), (-4.0, -1.0, -0.8)], ids=["too far", "too high", "stands"]
)
def test_an_observation_at_another_position_is_another_object(relative_path_m):
    now = observation(PAUSE_S, BEFORE_M + PAUSE_S * ODOMETRY_MPS + relative_path_m)
    assert reacquire([seen_before()], now, telemetry()) is None


@pytest.mark.parametrize("pause_s", [0.5 * SOONEST_NS * 1e-9, 1.2 * LATEST_NS * 1e-9])
def test_the_pause_is_limited(pause_s):
    now = observation(pause_s, BEFORE_M + pause_s * ODOMETRY_MPS)
    assert reacquire([seen_before()], now, telemetry()) is None


def test_a_small_displacement_is_left_to_association():
    slow_mps = 0.9 * LEAST_M / PAUSE_S * np.array([1.0, 0.0, 0.0])
    assert reacquire([seen_before()], observation(PAUSE_S, BEFORE_M + PAUSE_S * slow_mps), telemetry(slow_mps)) is None


def test_unpromising_candidates_and_times_without_telemetry_do_not_reacquire():
    now = observation(PAUSE_S, BEFORE_M + PAUSE_S * ODOMETRY_MPS)
    assert reacquire([seen_before(is_promising=False)], now, telemetry()) is None
    assert reacquire([seen_before()], now, DroneTelemetry()) is None
    assert reacquire([], now, telemetry()) is None


def test_the_best_fitting_candidate_is_reacquired():
    near, nearer = seen_before(number=7), seen_before(number=8)
    near.path_m[-1] = BEFORE_M + np.array([0.0, 0.0, 0.25])
    now = observation(PAUSE_S, BEFORE_M + PAUSE_S * ODOMETRY_MPS)
    assert GATE > 1
    met = reacquire([near, nearer], now, telemetry())
    assert met is not None
    assert met[0] is nearer


def test_the_reacquired_candidate_keeps_the_evidence_and_the_original_is_unchanged():
    old = seen_before()
    now = observation(PAUSE_S, BEFORE_M + PAUSE_S * ODOMETRY_MPS, returns=4)
    new = reacquired_candidate(old, 99, now, ODOMETRY_MPS)
    assert (new.number, new.scan_passes, new.reacquired_at, new.returns) == (99, 2, 1, 7)
    assert len(new.path_m) == 2
    np.testing.assert_array_equal(new.xyz_m, now.xyz_map_m)
    np.testing.assert_array_equal(new.velocity_mps, ODOMETRY_MPS)
    assert (old.number, old.scan_passes, old.reacquired_at, old.returns, len(old.path_m)) == (1, 1, 0, 3, 1)
    new.free += 1
    assert old.free.sum() == 0


def test_of_two_with_the_same_last_observations_the_more_probable_is_kept():
    observations = [observation(0.1 * k, BEFORE_M) for k in range(DUPLICATE_PASSES)]
    one, two, other = candidate(*observations), candidate(*observations), candidate(observation(0.0, BEFORE_M))
    one.single_log_odds, two.single_log_odds, two.number, other.number = 1.0, 2.0, 2, 3
    assert [c.number for c in without_duplicates([one, two, other])] == [2, 3]
    assert [c.number for c in without_duplicates([other, candidate(observation(0.0, BEFORE_M))])] == [
        3,
        1,
    ]  # too few observations


def followed_on(velocity_mps):
    """A reacquired candidate with four further observations at this velocity (3,)."""
    begin_m = BEFORE_M + PAUSE_S * ODOMETRY_MPS
    before = candidate(*(observation(0.1 * k, BEFORE_M + 0.1 * k * ODOMETRY_MPS) for k in range(-9, 1)))
    c = reacquired_candidate(before, 2, observation(PAUSE_S, begin_m), np.array(ODOMETRY_MPS))
    for k in range(1, 4):
        c.update(observation(PAUSE_S + 0.1 * k, begin_m + 0.1 * k * np.asarray(velocity_mps)))
    return c


def test_the_path_since_a_reacquisition_is_compared_alone():
    telemetry, begun_ns = DetectorTelemetry(), START_NS - 1_000_000_000
    for k in range(60):
        telemetry.add_position(
            DroneLocalPosition(
                stamp_ns=begun_ns + k * 100_000_000, xyz_odom_m=0.1 * k * ODOMETRY_MPS, velocity_odom_mps=ODOMETRY_MPS
            )
        )
    drone, bird = followed_on(ODOMETRY_MPS), followed_on((8.0, 2.0, 0.5))
    assert not telemetry.of(drone, True).denied
    assert telemetry.of(bird, True).denied
    bird.reacquired_at = 0  # as a single path it is not denied
    assert not telemetry.of(bird, True).denied
