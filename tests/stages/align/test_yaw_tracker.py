"""Selection of a match: the first only if unambiguous, then the predicted one, another one only after some time."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from stages.align.dead_reckoning import DeadReckonedYaw
from stages.align.spectra import spectrum
from stages.align.yaw_tracker import YawTracker
from stages.heading.heading_bank import Heading
from tests.stages.align.test_spectra import lines_at

S = 1_000_000_000
VARIANCE = math.radians(0.1) ** 2


def at(t_s, vehicle_deg=0.0, drone_deg=0.0, variance=VARIANCE) -> DeadReckonedYaw:
    return DeadReckonedYaw(round(t_s * S) + S, math.radians(vehicle_deg), math.radians(drone_deg), variance)


def seen(*azimuths_deg):
    return spectrum(lines_at(np.array(azimuths_deg, dtype=float)))


def follow(tracker: YawTracker, vehicle, drone, when: DeadReckonedYaw, rate=0.0):
    """Choose and accept: the yaw in degrees and the weights of the branches, or the reason."""
    match = tracker.choose(vehicle, drone, when, rate)
    if match.yaw_rad is None:
        return match.reason, None
    return math.degrees(match.yaw_rad), tracker.accept(match.yaw_rad, math.radians(0.2), when)


def test_streets_at_right_angles_match_at_once():
    yaw, weights = follow(YawTracker(), seen(0, 90), seen(-20, 70), at(0))
    assert yaw == pytest.approx(20.0, abs=0.2)
    np.testing.assert_array_equal(weights, [1, 0, 0, 0])


def test_two_common_streets_match():
    yaw, _ = follow(YawTracker(), seen(0, 0, 34, 34), seen(-20, 14, 14, 70), at(0))
    assert yaw == pytest.approx(20.0, abs=0.3)


def test_one_common_street_of_several_does_not_match():
    reason, _ = follow(YawTracker(), seen(0, 90, 0), seen(-20, 70, 14, 14, 41, 41), at(0))
    assert "which fits any street" in str(reason) or "fit" in str(reason)


def test_without_a_common_street_there_is_no_match():
    tracker = YawTracker()
    reason, _ = follow(tracker, np.zeros(720), seen(3), at(0))
    assert reason == "the lines of both cameras have no direction in common"
    assert tracker.offset_rad is None


def test_yaw_is_tracked_over_the_full_circle():
    """The drone turns 30 deg per step: yaw is tracked over 360 deg though images give it modulo 90 deg."""
    tracker = YawTracker()
    for i in range(13):
        yaw, weights = follow(tracker, seen(0, 90), seen(-30 * i, 90 - 30 * i), at(0.2 * i, drone_deg=30.0 * i))
        assert (yaw - 30 * i + 180) % 360 - 180 == pytest.approx(0.0, abs=0.3)
        assert weights[0] > 0.999999


def test_the_turn_of_the_vehicle_has_the_opposite_sign():
    tracker = YawTracker()
    for i in range(8):
        yaw, _ = follow(tracker, seen(-30 * i, 90 - 30 * i), seen(0, 90), at(0.2 * i, vehicle_deg=30.0 * i))
        assert (yaw + 30 * i + 180) % 360 - 180 == pytest.approx(0.0, abs=0.3)


def test_an_uncertain_prediction_makes_other_branches_possible():
    tracker = YawTracker()
    follow(tracker, seen(0, 90), seen(0, 90), at(0))
    sigma = math.radians(30.0)
    _, weights = follow(tracker, seen(0, 90), seen(-20, 70), at(3, variance=sigma**2))
    S_ = sigma**2 + tracker_noise()
    expected = [math.exp(-0.5 * math.radians(a) ** 2 / S_) for a in (20, 110, 200, -70)]
    expected[2] += math.exp(-0.5 * math.radians(-160) ** 2 / S_)
    np.testing.assert_allclose(weights, np.array(expected) / sum(expected), atol=0.02)


def tracker_noise() -> float:
    return 2 * (math.radians(0.2) ** 2 + math.radians(0.7) ** 2)


def test_a_useless_prediction_makes_all_branches_equal():
    tracker = YawTracker()
    follow(tracker, seen(0, 90), seen(0, 90), at(0))
    _, weights = follow(tracker, seen(0, 90), seen(-20, 70), at(60, variance=10.0))
    np.testing.assert_array_equal(weights, [0.25] * 4)


def test_a_match_at_another_yaw_is_rejected_at_first():
    tracker = YawTracker()
    for i in range(5):
        follow(tracker, seen(0, 90), seen(0, 90), at(0.2 * i))
    reason, _ = follow(tracker, seen(0, 90), seen(-31, 59), at(1.0))
    assert "+31 deg from the yaw predicted by dead reckoning" in str(reason)
    assert not tracker.reacquired


def test_a_lasting_match_at_another_yaw_replaces_the_tracked_one():
    tracker = YawTracker()
    for i in range(5):
        follow(tracker, seen(0, 90), seen(0, 90), at(0.2 * i))
    taken = None
    for i in range(5, 500):
        yaw, weights = follow(tracker, seen(0, 90), seen(-31, 59), at(0.2 * i))
        if weights is not None:
            taken = 0.2 * i
            break
    assert taken is not None
    assert 2.0 < taken < 60.0
    assert tracker.reacquired
    assert yaw == pytest.approx(31.0, abs=0.3)
    np.testing.assert_array_equal(weights, [0.25] * 4)


def test_the_maps_resolve_what_one_image_does_not():
    """A vehicle that sees one street after the other, each of which alone matches any street of the drone."""
    drone = seen(0, 0, 34, 34, 61, 61)
    tracker, yaw = YawTracker(), None
    for i, street in enumerate([0, 34, 61, 34]):
        yaw, _ = follow(tracker, seen(street, street), drone, at(0.2 * i))
        alone, _ = follow(YawTracker(), seen(street, street), drone, at(0))
        assert isinstance(alone, str)
    assert yaw == pytest.approx(0.0, abs=0.3)


def test_a_fast_turn_widens_the_gate():
    """In a turn of 120 deg/s a stamp error of 20 ms is 2.4 deg."""
    for rate, taken in ((0.0, False), (math.radians(120), True)):
        tracker = YawTracker()
        for i in range(30):
            follow(tracker, seen(0, 90), seen(0, 90), at(0.1 * i))
        yaw, _ = follow(tracker, seen(0, 90), seen(-4, 86), at(3.0), rate)
        assert isinstance(yaw, float) is taken


def test_forget_resets_the_tracker():
    tracker = YawTracker()
    follow(tracker, seen(0, 90), seen(0, 90), at(0))
    tracker.forget()
    assert tracker.offset_rad is None
    yaw, _ = follow(tracker, seen(0, 90), seen(-40, 50), at(0.2))
    assert yaw == pytest.approx(40.0, abs=0.3)


# streets at many angles, with the heading by motion

VEHICLE, DRONE = seen(0, 90, 0), seen(-20, 70, 14, 14, 41, 41)  # one common street: no image identifies it
AT = DeadReckonedYaw(S, 0.0, 0.0, math.radians(0.1) ** 2)


@pytest.mark.parametrize("quarters", range(4))
@pytest.mark.parametrize("street_deg", [20.0, -14.0, -41.0])
def test_motion_selects_the_street_and_the_direction(street_deg, quarters):
    tracker = YawTracker()
    assert tracker.choose(VEHICLE, DRONE, AT, 0.0).yaw_rad is None
    true_rad = math.radians(street_deg + 90 * quarters)
    match = tracker.choose(VEHICLE, DRONE, AT, 0.0, Heading(true_rad + math.radians(3.0), math.radians(2.0)))
    assert match.yaw_rad is not None
    assert math.remainder(match.yaw_rad - true_rad, 2 * math.pi) == pytest.approx(0.0, abs=math.radians(0.3))


def test_no_match_at_the_heading_by_motion_is_none():
    nowhere = Heading(math.radians(3.0), math.radians(1.5))
    match = YawTracker().choose(VEHICLE, DRONE, AT, 0.0, nowhere)
    assert match.yaw_rad is None
    assert "no match at the heading by the drone's motion" in match.reason
    square = YawTracker().choose(seen(0, 90), seen(-20, 70), AT, 0.0, nowhere)
    assert square.reason == "the best match of the lines contradicts the drone's motion"


def test_a_match_that_motion_contradicts_is_released_modulo_90_deg():
    tracker = YawTracker()
    match = tracker.choose(seen(0, 90), seen(-20, 70), AT, 0.0)
    tracker.accept(match.yaw_rad, math.radians(0.2), AT)
    sigma = math.radians(2.0)
    assert not tracker.is_contradicted(None)
    assert not tracker.is_contradicted(Heading(math.radians(20 + 180 + 8), sigma))
    assert tracker.is_contradicted(Heading(math.radians(20 - 90 + 14), sigma))
    tracker.release()
    assert tracker.offset_rad is None
    assert not tracker.is_contradicted(Heading(0.0, sigma))
    again = tracker.choose(seen(0, 90), seen(-20, 70), dataclasses.replace(AT, stamp_ns=2 * S), 0.0)
    assert math.degrees(again.yaw_rad) == pytest.approx(20.0, abs=0.2)
