"""NED and FRD against ours: axes by hand, turns both ways, covariances by propagation."""

from __future__ import annotations

import math

import numpy as np
import pytest

from links.mavlink.frames import (
    UPPER,
    R_odom_drone_from_rpy,
    R_odom_drone_from_wxyz,
    pose_covariance_from_upper,
    rpy_from_R_odom_drone,
    turned_over,
    upper_from_pose_covariance,
    upper_from_velocity_covariance,
    velocity_covariance_from_upper,
    wxyz_from_R_odom_drone,
)
from stages.geometry.frames import rotation_from_rpy_deg

ATTITUDES = [(0, 0, 0), (10, -20, 30), (-5, 3, 179), (60, 40, -120), (170, 10, 90), (0, 89, 0), (180, 0, 180)]


def test_east_and_down_become_minus_y_and_minus_z():
    np.testing.assert_array_equal(turned_over(np.array([[1.0, 2.0, 3.0]])), [[1.0, -2.0, -3.0]])
    np.testing.assert_array_equal(turned_over(turned_over(np.array([1.0, 2.0, 3.0]))), [1.0, 2.0, 3.0])


def test_a_drone_heading_east_looks_along_minus_y_and_its_left_is_north():
    R = R_odom_drone_from_rpy(0.0, 0.0, math.radians(90.0))
    np.testing.assert_allclose(R @ [1, 0, 0], [0, -1, 0], atol=1e-12)  # forward: east
    np.testing.assert_allclose(R @ [0, 1, 0], [1, 0, 0], atol=1e-12)  # left: north
    np.testing.assert_allclose(R @ [0, 0, 1], [0, 0, 1], atol=1e-12)


def test_positive_pitch_lifts_the_nose_and_positive_roll_lowers_the_right_side():
    nose_up = R_odom_drone_from_rpy(0.0, math.radians(30.0), 0.0)
    np.testing.assert_allclose(nose_up @ [1, 0, 0], [math.cos(math.pi / 6), 0, 0.5], atol=1e-12)
    right_down = R_odom_drone_from_rpy(math.radians(30.0), 0.0, 0.0)
    np.testing.assert_allclose(right_down @ [0, -1, 0], [0, -math.cos(math.pi / 6), -0.5], atol=1e-12)


@pytest.mark.parametrize("rpy_deg", ATTITUDES)
def test_angles_and_quaternions_come_back_and_agree(rpy_deg: tuple[float, float, float]):
    R = R_odom_drone_from_rpy(*np.radians(rpy_deg))
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R_odom_drone_from_rpy(*rpy_from_R_odom_drone(R)), R, atol=1e-7)
    q = wxyz_from_R_odom_drone(R)
    assert math.hypot(*q) == pytest.approx(1.0)
    assert q[0] >= 0
    np.testing.assert_allclose(R_odom_drone_from_wxyz(q), R, atol=1e-12)


def test_mavlinks_quaternion_of_a_turn_to_the_east_is_a_turn_about_down():
    half = math.radians(45.0)
    expected = R_odom_drone_from_rpy(0.0, 0.0, math.radians(90.0))
    np.testing.assert_allclose(R_odom_drone_from_wxyz([math.cos(half), 0, 0, math.sin(half)]), expected, atol=1e-12)


def _upper(theirs: np.ndarray) -> list[float]:
    return theirs[UPPER].tolist()


def test_a_level_drones_variances_change_place_and_keep_their_size():
    theirs = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])  # x y z roll pitch yaw
    ours = pose_covariance_from_upper(_upper(theirs), np.eye(3))
    assert ours is not None
    np.testing.assert_allclose(ours, np.diag([4.0, 5.0, 6.0, 1.0, 2.0, 3.0]))


def test_mixed_terms_change_sign_with_their_axes():
    theirs = np.eye(6)
    theirs[0, 1] = theirs[1, 0] = 0.5  # north-east
    theirs[1, 2] = theirs[2, 1] = 0.25  # east-down
    theirs[0, 5] = theirs[5, 0] = 0.125  # north-yaw
    ours = velocity_covariance_from_upper(_upper(theirs))
    assert ours is not None
    assert (ours[3, 4], ours[4, 5], ours[2, 3]) == (-0.5, 0.25, -0.125)


def test_position_covariance_turns_into_the_body():
    """1 m2 northwards and little else, drone heading east: in its body that is sideways."""
    theirs = np.diag([1.0, 0.01, 0.04, 0.1, 0.1, 0.1])
    ours = pose_covariance_from_upper(_upper(theirs), R_odom_drone_from_rpy(0.0, 0.0, math.radians(90.0)))
    assert ours is not None
    np.testing.assert_allclose(np.diagonal(ours), [0.1, 0.1, 0.1, 0.01, 1.0, 0.04], atol=1e-12)


def test_covariances_come_back():
    A = np.random.default_rng(1).normal(size=(6, 6))
    covariance, R = A @ A.T, rotation_from_rpy_deg((10.0, 20.0, 130.0))
    back = pose_covariance_from_upper(upper_from_pose_covariance(covariance, R), R)
    velocity = velocity_covariance_from_upper(upper_from_velocity_covariance(covariance))
    assert back is not None
    assert velocity is not None
    np.testing.assert_allclose(back, covariance, atol=1e-12)
    np.testing.assert_allclose(velocity, covariance, atol=1e-12)


def test_a_covariance_that_is_none_is_none():
    for wrong in ([math.nan] + [0.0] * 20, [math.inf] * 21, [-1.0] + [0.0] * 20, [0.0] * 20):
        assert pose_covariance_from_upper(wrong, np.eye(3)) is None
