"""Yaw of the autopilot's frame by its odometry and LiDAR positions, and of the body with an outlier share."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.heading.inertial_bank import YawMixture
from stages.heading.odometry_heading import WRONG_COMPASS_RAD, OdometryHeading, OdomYaw, YawEvidence

S = 1_000_000_000
COMPASS_RAD = math.radians(7.0)
TRUE_RAD = 0.8  # yaw of odom in map
SIGMA_M = 0.07


def heading():
    return OdometryHeading(COMPASS_RAD, 0.03)


def fly(odometry, t_s, yaw_rad=TRUE_RAD, segment=0, seed=0, moves=True, scale=1.0):
    """Positions of a drone that flies 2 m/s on a circle, at some times; returns whether a yaw is known after each."""
    rng, known = np.random.default_rng([seed, 9]), []
    for t in t_s:
        x = np.array([300.0 + 5.0 * math.sin(0.4 * t), 5.0 * math.cos(0.4 * t) - 40.0, 12.0])
        z = rotation_z(yaw_rad) @ (scale * x) if moves else np.array([7.0, 8.0, 9.0])
        odometry.add(round(t * S), z + rng.normal(0, SIGMA_M, 3), SIGMA_M**2, x, segment)
        known.append(odometry.odom_yaw is not None)
    return known


def times(from_s, until_s):
    return np.arange(from_s, until_s, 0.2)


def off_rad(yaw_rad, true_rad=TRUE_RAD):
    return abs(math.remainder(yaw_rad - true_rad, 2 * math.pi))


@pytest.mark.parametrize("true_rad", [-3.1, -1.0, 0.8, 2.5])
def test_the_yaw_of_the_frame_is_known_within_metres_of_flight(true_rad):
    odometry = heading()
    known = fly(odometry, times(0, 8), true_rad)
    assert not any(known[:3])
    assert all(known[10:])
    yaw = odometry.odom_yaw
    assert off_rad(yaw.yaw_rad, true_rad) < 3.0 * yaw.sigma_rad
    assert yaw.sigma_rad < math.radians(5.0)
    assert odometry.confirmed


def test_its_error_is_that_of_its_sigma():
    squares = []
    for seed in range(60):
        odometry = heading()
        fly(odometry, times(0, 5), seed=seed)
        squares.append((off_rad(odometry.odom_yaw.yaw_rad) / odometry.odom_yaw.sigma_rad) ** 2)
    assert np.mean(squares) < 1.3
    assert np.mean(np.array(squares) < 4.0) > 0.93


@pytest.mark.parametrize("how", [{"moves": False}, {"scale": 2.0}, {"scale": -0.2}])
def test_an_object_that_does_not_move_as_the_odometry_gives_no_yaw(how):
    odometry = heading()
    assert not any(fly(odometry, times(0, 8), **how))
    assert not odometry.confirmed
    assert odometry.evidence(8 * S, np.eye(3)) is None


def test_less_than_a_metre_of_flight_gives_no_yaw():
    odometry = heading()
    assert not any(fly(odometry, np.arange(0, 0.45, 0.16)))


def test_a_new_segment_of_the_odometry_drops_the_yaw():
    odometry = heading()
    fly(odometry, times(0, 6))
    assert odometry.odom_yaw is not None
    assert not any(fly(odometry, [6.0], yaw_rad=2.0, segment=1))
    fly(odometry, times(6.2, 12), yaw_rad=2.0, segment=1)
    assert off_rad(odometry.odom_yaw.yaw_rad, 2.0) < 0.1


def test_a_contradiction_drops_the_yaw():
    """The odometry's frame has turned, without a new segment."""
    odometry = heading()
    fly(odometry, times(0, 6))
    known = fly(odometry, times(20, 26), yaw_rad=TRUE_RAD + 0.8)
    assert not all(known)
    assert off_rad(odometry.odom_yaw.yaw_rad, TRUE_RAD + 0.8) < 0.1


def test_the_most_certain_yaw_is_kept_and_its_sigma_grows():
    odometry = heading()
    fly(odometry, times(0, 9))
    kept = odometry.odom_yaw
    fly(odometry, np.arange(20, 21.5, 0.2))  # a short flight: less certain
    assert odometry.odom_yaw is kept
    assert kept.sigma_at(kept.stamp_ns) == kept.sigma_rad
    assert kept.sigma_at(kept.stamp_ns + 60 * S) == pytest.approx(math.hypot(kept.sigma_rad, math.radians(2.0)))


def test_an_object_found_has_to_confirm_the_yaw_but_does_not_drop_it():
    odometry = heading()
    fly(odometry, times(0, 6))
    odometry.on_found()
    assert odometry.odom_yaw is not None
    assert not odometry.confirmed
    assert odometry.evidence(6 * S, np.eye(3)) is None
    fly(odometry, times(6, 12))
    assert odometry.confirmed


def test_yaws_agree_within_four_sigmas_on_the_circle():
    kept = OdomYaw(0, math.pi - 0.01, 0.03)
    assert kept.agrees(OdomYaw(0, -math.pi + 0.1, 0.04))
    assert not kept.agrees(OdomYaw(0, -math.pi + 0.2, 0.04))
    assert kept.agrees(OdomYaw(600 * S, -math.pi + 0.2, 0.04))  # ten minutes of drift


# evidence for the body


def test_the_body_s_yaw_has_the_compass_s_error_and_outliers():
    odometry = heading()
    fly(odometry, times(0, 8))
    evidence = odometry.evidence(8 * S, rotation_z(0.5))
    assert off_rad(evidence.yaw_rad, TRUE_RAD + 0.5) < 0.1
    assert evidence.sigma_rad == pytest.approx(math.hypot(COMPASS_RAD, odometry._fit.sigma_rad))
    flat = YawMixture(np.linspace(-math.pi, math.pi, 25)[1:], np.full(24, 0.15**2), np.full(24, 1.0 / 24))
    with_compass = evidence.applied(flat)
    assert with_compass.weight.sum() == pytest.approx(1.0)
    assert with_compass.weight[24:].sum() == pytest.approx(0.03, rel=0.1)  # the compass is wrong by any angle
    best = int(np.argmax(with_compass.weight))
    assert off_rad(float(with_compass.yaw_rad[best]), TRUE_RAD + 0.5) < 2.0 * evidence.sigma_rad
    assert with_compass.variance_rad2[best] < evidence.sigma_rad**2


def test_a_yaw_that_contradicts_the_compass_keeps_its_value_and_the_compass_is_the_outlier():
    prior = YawMixture(np.array([TRUE_RAD + math.pi]), np.array([0.01]), np.array([1.0]))
    after = YawEvidence(TRUE_RAD, COMPASS_RAD, 0.03).applied(prior)
    assert after.weight[1] > 0.999
    assert after.yaw_rad[1] == prior.yaw_rad[0]
    assert after.variance_rad2[1] == prior.variance_rad2[0]


def test_the_evidence_ends_with_the_fit():
    odometry = heading()
    fly(odometry, times(0, 8))
    assert odometry.evidence(10 * S, np.eye(3)) is not None
    assert odometry.evidence(12 * S, np.eye(3)) is None


# axes of the autopilot

GENTLE = np.arange(0, 4, 0.2)


def gentle_flight():
    """Enough motion for a yaw of several degrees."""
    odometry = heading()
    fly(odometry, GENTLE)
    assert math.radians(2.0) < odometry.odom_yaw.sigma_rad < math.radians(9.0)
    return odometry


def test_without_a_yaw_of_the_body_the_axes_are_those_of_the_motion():
    odometry = gentle_flight()
    assert odometry.axes is odometry.odom_yaw


def test_the_axes_are_those_of_the_attitude_while_the_motion_shows_them_less_sharply():
    odometry = gentle_flight()
    attitude = OdomYaw(4 * S, TRUE_RAD + 0.1, math.radians(1.0))
    odometry.add_attitude(attitude)
    assert odometry.axes is attitude
    fly(odometry, times(4, 30))
    assert odometry.odom_yaw.sigma_rad < math.radians(2.0)
    assert odometry.axes is odometry.odom_yaw


@pytest.mark.parametrize("off_deg", [35.0, -90.0, 180.0])
def test_an_attitude_that_the_motion_contradicts_is_not_used(off_deg):
    odometry = gentle_flight()
    odometry.add_attitude(OdomYaw(4 * S, TRUE_RAD + math.radians(off_deg), math.radians(1.0)))
    assert odometry.axes is odometry.odom_yaw


def test_the_attitude_alone_gives_no_axes():
    odometry = heading()
    odometry.add_attitude(OdomYaw(0, TRUE_RAD, math.radians(1.0)))
    assert odometry.axes is None


def test_the_axes_stay_when_a_drone_is_found_again_and_end_with_the_frame():
    odometry = gentle_flight()
    attitude = OdomYaw(4 * S, TRUE_RAD, math.radians(1.0))
    odometry.add_attitude(attitude)
    odometry.on_found()
    assert odometry.axes is attitude
    odometry.restart()
    assert odometry.axes is None


def test_motion_that_is_sharper_than_the_attitude_gives_the_axes():
    odometry = gentle_flight()
    odometry.add_attitude(OdomYaw(4 * S, TRUE_RAD, 1.1 * odometry.odom_yaw.sigma_rad))
    assert odometry.axes is odometry.odom_yaw


@pytest.mark.parametrize(("slack_deg", "used"), [(-0.5, True), (0.5, False)])
def test_the_attitude_is_used_if_the_motion_excludes_a_wrong_compass_at_two_sigmas(slack_deg, used):
    odometry, sigma_rad = gentle_flight(), math.radians(1.0)
    limit_rad = WRONG_COMPASS_RAD - 2.0 * math.hypot(odometry.odom_yaw.sigma_at(4 * S), sigma_rad)
    assert limit_rad > 0.0
    for side in (-1.0, 1.0):
        yaw_rad = odometry.odom_yaw.yaw_rad + side * (limit_rad + math.radians(slack_deg))
        attitude = OdomYaw(4 * S, yaw_rad, sigma_rad)
        odometry.add_attitude(attitude)
        assert (odometry.axes is attitude) is used


def test_motion_of_long_ago_shows_no_compass():
    odometry = gentle_flight()
    attitude = OdomYaw(604 * S, odometry.odom_yaw.yaw_rad, math.radians(1.0))
    odometry.add_attitude(attitude)
    assert odometry.axes is odometry.odom_yaw


def test_the_axes_follow_the_attitude_with_its_drift():
    odometry = gentle_flight()
    for t in range(5):
        newest = OdomYaw((4 + t) * S, TRUE_RAD + 0.01 * t, math.radians(1.0))
        odometry.add_attitude(newest)
        assert odometry.axes is newest
    odometry.add_attitude(OdomYaw(9 * S, TRUE_RAD + 0.5, math.radians(3.0)))
    assert odometry.axes is newest
