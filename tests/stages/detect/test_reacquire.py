"""A drone met again elsewhere, as it says that it has flown; and what goes on beside it."""

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
SAID_MPS = np.array([3.0, 1.0, 0.5])  # in the autopilot's frame, whose yaw nobody knows
PAUSE_S = 1.5


def telemetry(velocity_mps=SAID_MPS):
    told = DroneTelemetry()
    for k in range(60):
        told.add(START_NS + k * 100_000_000, 0.1 * k * np.asarray(velocity_mps), np.asarray(velocity_mps))
    return told


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
def test_it_is_met_where_it_says_whichever_way_its_autopilots_axes_point(yaw_deg):
    before = seen_before()
    now = observation(PAUSE_S, BEFORE_M + PAUSE_S * turned(SAID_MPS, yaw_deg))
    met = reacquire([before], now, telemetry())
    assert met is not None
    assert met[0] is before
    np.testing.assert_allclose(met[1], turned(SAID_MPS, yaw_deg), atol=1e-6)


@pytest.mark.parametrize(
    "relative_path_m", [(1.5, 0.5, 0.0), (0.0, 0.0, 1.2), (-4.0, -1.0, -0.8)], ids=["too far", "too high", "stands"]
)
def test_what_lies_elsewhere_is_something_else(relative_path_m):
    now = observation(PAUSE_S, BEFORE_M + PAUSE_S * SAID_MPS + relative_path_m)
    assert reacquire([seen_before()], now, telemetry()) is None


@pytest.mark.parametrize("pause_s", [0.5 * SOONEST_NS * 1e-9, 1.2 * LATEST_NS * 1e-9])
def test_a_short_pause_is_the_filters_and_a_long_one_says_nothing(pause_s):
    now = observation(pause_s, BEFORE_M + pause_s * SAID_MPS)
    assert reacquire([seen_before()], now, telemetry()) is None


def test_a_drone_that_hardly_moves_is_met_where_it_was():
    slow_mps = 0.9 * LEAST_M / PAUSE_S * np.array([1.0, 0.0, 0.0])
    assert reacquire([seen_before()], observation(PAUSE_S, BEFORE_M + PAUSE_S * slow_mps), telemetry(slow_mps)) is None


def test_nothing_is_met_by_what_was_not_worth_a_look_or_while_the_drone_was_silent():
    now = observation(PAUSE_S, BEFORE_M + PAUSE_S * SAID_MPS)
    assert reacquire([seen_before(is_promising=False)], now, telemetry()) is None
    assert reacquire([seen_before()], now, DroneTelemetry()) is None
    assert reacquire([], now, telemetry()) is None


def test_of_several_the_one_that_fits_best_is_met():
    near, nearer = seen_before(number=7), seen_before(number=8)
    near.path_m[-1] = BEFORE_M + np.array([0.0, 0.0, 0.25])
    now = observation(PAUSE_S, BEFORE_M + PAUSE_S * SAID_MPS)
    assert GATE > 1
    met = reacquire([near, nearer], now, telemetry())
    assert met is not None
    assert met[0] is nearer


def test_the_joined_one_has_both_pasts_and_the_old_one_goes_on_as_it_was():
    old = seen_before()
    now = observation(PAUSE_S, BEFORE_M + PAUSE_S * SAID_MPS, returns=4)
    new = reacquired_candidate(old, 99, now, SAID_MPS)
    assert (new.number, new.scan_passes, new.reacquired_at, new.returns) == (99, 2, 1, 7)
    assert len(new.path_m) == 2
    np.testing.assert_array_equal(new.xyz_m, now.xyz_map_m)
    np.testing.assert_array_equal(new.velocity_mps, SAID_MPS)
    assert (old.number, old.scan_passes, old.reacquired_at, old.returns, len(old.path_m)) == (1, 1, 0, 3, 1)
    new.free += 1
    assert old.free.sum() == 0


def test_of_two_with_the_same_last_sightings_the_likelier_is_kept():
    observations = [observation(0.1 * k, BEFORE_M) for k in range(DUPLICATE_PASSES)]
    one, two, other = candidate(*observations), candidate(*observations), candidate(observation(0.0, BEFORE_M))
    one.log_odds, two.log_odds, two.number, other.number = 1.0, 2.0, 2, 3
    assert [c.number for c in without_duplicates([one, two, other])] == [2, 3]
    assert [c.number for c in without_duplicates([other, candidate(observation(0.0, BEFORE_M))])] == [
        3,
        1,
    ]  # too few to tell


def followed_on(velocity_mps):
    """Met again where the drone says it would be, and seen there four times, flying at this velocity (3,)."""
    begin_m = BEFORE_M + PAUSE_S * SAID_MPS
    before = candidate(*(observation(0.1 * k, BEFORE_M + 0.1 * k * SAID_MPS) for k in range(-9, 1)))
    c = reacquired_candidate(before, 2, observation(PAUSE_S, begin_m), np.array(SAID_MPS))
    for k in range(1, 4):
        c.update(observation(PAUSE_S + 0.1 * k, begin_m + 0.1 * k * np.asarray(velocity_mps)))
    return c


def test_what_flies_otherwise_since_it_was_met_again_is_denied_though_its_whole_way_is_not():
    word, begun_ns = DetectorTelemetry(), START_NS - 1_000_000_000
    for k in range(60):
        word.add_position(
            DroneLocalPosition(
                stamp_ns=begun_ns + k * 100_000_000, xyz_odom_m=0.1 * k * SAID_MPS, velocity_odom_mps=SAID_MPS
            )
        )
    drone, bird = followed_on(SAID_MPS), followed_on((8.0, 2.0, 0.5))
    assert not word.of(drone, True).denied
    assert word.of(bird, True).denied
    bird.reacquired_at = 0  # as one thing all along it might pass
    assert not word.of(bird, True).denied
