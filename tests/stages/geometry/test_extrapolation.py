"""Extrapolation of the vehicle: constant turn rate for a second, with the covariance of possible maneuvers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.extrapolation import (
    GAP_MANEUVER,
    HARDEST_MANEUVER,
    SOURCE_CHANGE_S,
    USUAL_MANEUVER,
    AcceptedPoses,
    ManeuverBound,
    constant_turn_rate,
)
from stages.geometry.frames import rotation_z
from stages.messages import VehicleMotion

S = 1_000_000_000


def bend(time_s):
    """3 m/s forward, 0.2 rad/s to the left."""
    yaw, radius = 0.2 * time_s, 15.0
    return rotation_z(yaw), np.array([radius * math.sin(yaw), radius * (1 - math.cos(yaw)), 0.5])


def pose(time_s, at=bend, covariance=True):
    R, xyz_m = at(time_s)
    return VehicleMotion(
        stamp_ns=round(time_s * S),
        xyz_map_m=xyz_m,
        R_map_vehicle=R,
        covariance=np.diag([1e-4] * 3 + [4e-4] * 3) if covariance else None,
    )


POSES = [pose(0.1 * k) for k in range(10)]


def test_a_maneuver_deviates_by_half_a_t_squared():
    may = ManeuverBound(4.0, 0.6)
    assert may.displacement_m(0.5) == pytest.approx(0.5)
    assert may.turn_rad(2.0) == pytest.approx(1.2)
    assert USUAL_MANEUVER.displacement_m(1) < GAP_MANEUVER.displacement_m(1) < HARDEST_MANEUVER.displacement_m(1)
    assert USUAL_MANEUVER.turn_rad(1) < GAP_MANEUVER.turn_rad(1) < HARDEST_MANEUVER.turn_rad(1)


@pytest.mark.parametrize("beyond_s", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("turned", [0.0, 2.0])
def test_extrapolation_follows_the_constant_turn_rate(beyond_s, turned):
    frame = rotation_z(turned)
    R, xyz_m = bend(0.9 + beyond_s)
    extrapolated = constant_turn_rate(
        [pose(m.stamp_ns / S, lambda s: (frame @ bend(s)[0], frame @ bend(s)[1])) for m in POSES],
        round((0.9 + beyond_s) * S),
    )
    np.testing.assert_allclose(extrapolated.xyz_map_m, frame @ xyz_m, atol=0.006)
    np.testing.assert_allclose(extrapolated.R_map_vehicle, frame @ R, atol=1e-6)


def test_after_the_horizon_the_pose_is_constant_and_the_covariance_grows():
    one, many = (
        constant_turn_rate(POSES, POSES[-1].stamp_ns + round(s * S)) for s in (SOURCE_CHANGE_S, 5 * SOURCE_CHANGE_S)
    )
    np.testing.assert_allclose(one.xyz_map_m, many.xyz_map_m)
    np.testing.assert_allclose(one.R_map_vehicle, many.R_map_vehicle)
    assert np.trace(many.covariance) > 100 * np.trace(one.covariance)
    sigma = np.sqrt(np.diag(many.covariance - POSES[-1].covariance))
    np.testing.assert_allclose(sigma, [0.5 * 0.5 * 5**2] * 3 + [0.5 * 3.0 * 5**2] * 3)


def test_one_pose_or_poses_from_long_ago_give_no_speed():
    for poses in (POSES[-1:], [pose(-5.0), POSES[-1]]):
        extrapolated = constant_turn_rate(poses, 2 * S)
        np.testing.assert_allclose(extrapolated.xyz_map_m, POSES[-1].xyz_map_m)
        np.testing.assert_allclose(extrapolated.R_map_vehicle, POSES[-1].R_map_vehicle)


def test_a_pose_without_covariance_is_extrapolated_without_one():
    assert constant_turn_rate([pose(0.0, covariance=False)], S).covariance is None


def test_the_speed_is_kept_when_the_start_frame_jumps():
    poses, far = AcceptedPoses(), 1000.0
    assert poses.speed_mps is None
    for k in range(10):
        poses.add(pose(0.1 * k))
    assert poses.speed_mps == pytest.approx(3.0, abs=0.01)
    for k in range(4):  # of a new frame, every 20 ms: too short for a speed
        poses.add(pose(0.92 + 0.02 * k, lambda s: (bend(s)[0], bend(s)[1] + far)))
    assert poses.newest_ns == round(0.98 * S)
    assert poses.speed_mps == pytest.approx(3.0, abs=0.01)
