"""Smallest-angle matching and V_G V_D^-1: the rotation back from directions, signs and order, a wrong start."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.align.paper_match import angle_between_rad, columns, match
from stages.geometry.frames import rotation_from_rpy_deg, rotation_z
from stages.kernels.geometry.so3 import exp_rotation

RNG = np.random.default_rng(8)
TRUE = rotation_from_rpy_deg((5.0, -8.0, 40.0))


def streets(R_carrier_world):
    """The world's axes in a camera_mount's axes, a row each."""
    return R_carrier_world.T.copy()


def test_columns_are_two_directions_and_their_cross_product():
    np.testing.assert_allclose(
        columns(np.array([1.0, 0, 0]), np.array([0.6, 0.8, 0])), [[1, 0.6, 0], [0, 0.8, 0], [0, 0, 1]], atol=1e-12
    )


def test_the_rotation_is_V_G_V_D_inverse():
    drone = streets(rotation_from_rpy_deg((3, 4, 70)))
    found = match(drone @ TRUE.T, drone, TRUE)
    np.testing.assert_allclose(found.R_vehicle_drone, TRUE, atol=1e-12)
    assert found.angle_rad < 1e-6


@given(
    st.permutations(range(3)),
    st.permutations(range(3)),
    st.tuples(*[st.sampled_from([-1.0, 1.0])] * 6),
    st.integers(0, 1000),
)
@settings(max_examples=50, deadline=None)
def test_order_and_sign_of_directions_have_no_effect(order_g, order_d, signs, seed):
    rng = np.random.default_rng(seed)
    drone = streets(rotation_from_rpy_deg((3, 4, 70)))
    vehicle = drone @ TRUE.T
    vehicle = vehicle[list(order_g)] * np.array(signs[:3])[:, None]
    drone = drone[list(order_d)] * np.array(signs[3:])[:, None]
    previous = TRUE @ exp_rotation(rng.uniform(-0.2, 0.2, 3))
    np.testing.assert_allclose(match(vehicle, drone, previous).R_vehicle_drone, TRUE, atol=1e-9)


def test_turning_vehicle_or_drone_turns_the_rotation_with_it():
    drone = streets(rotation_from_rpy_deg((3, 4, 70)))
    vehicle = drone @ TRUE.T
    turn = rotation_from_rpy_deg((2, -1, 25))
    found = match(vehicle @ turn.T, drone, turn @ TRUE)
    np.testing.assert_allclose(found.R_vehicle_drone, turn @ TRUE, atol=1e-12)
    found = match(vehicle, drone @ turn.T, TRUE @ turn.T)
    np.testing.assert_allclose(found.R_vehicle_drone, TRUE @ turn.T, atol=1e-12)


def test_directions_that_are_not_at_right_angles_give_a_rotation():
    g = np.array([[1.0, 0, 0], [0.05, 0.9987, 0], [0, 0, 1.0]])
    d = np.array([[1.0, 0, 0], [-0.05, 0.9987, 0], [0, 0, 1.0]])
    R = match(g, d, np.eye(3)).R_vehicle_drone
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert angle_between_rad(R, np.eye(3)) < 0.1


def test_the_best_two_pairs_are_used_and_the_third_is_their_cross_product():
    """The x directions disagree by 10 deg: y and z decide."""
    g = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    d = np.array([[math.cos(0.17), 0, math.sin(0.17)], [0, 1.0, 0], [0, 0, 1.0]])
    np.testing.assert_allclose(match(g, d, np.eye(3)).R_vehicle_drone, np.eye(3), atol=1e-12)


def test_a_direction_is_in_one_pair_only():
    """(0.8, 0.6, 0) is nearer to x, which is taken: it goes with y, 53 deg away. The error is shared: 53.13 / 2."""
    g = np.array([[1.0, 0, 0], [0.8, 0.6, 0]])
    found = match(g, np.eye(3)[:2], np.eye(3))
    assert math.degrees(found.angle_rad) == pytest.approx(53.13, abs=0.01)
    np.testing.assert_allclose(found.R_vehicle_drone, rotation_z(-math.radians(53.13 / 2)), atol=1e-4)


def test_two_directions_each_are_enough():
    drone = streets(rotation_from_rpy_deg((3, 4, 70)))[:2]
    np.testing.assert_allclose(match(drone @ TRUE.T, drone, TRUE).R_vehicle_drone, TRUE, atol=1e-12)


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_an_initial_error_of_90_deg_stays(quarter):
    """The correction by motion of the paper removes it."""
    turn = rotation_z(quarter * math.pi / 2)
    vehicle = np.eye(3)
    drone = vehicle @ TRUE
    found = match(vehicle, drone, turn @ TRUE @ exp_rotation(np.array([0.1, -0.1, 0.15])))
    np.testing.assert_allclose(found.R_vehicle_drone, turn @ TRUE, atol=1e-9)


def test_the_reported_angle_is_that_of_the_worse_pair():
    off = rotation_z(math.radians(12))
    assert math.degrees(match(np.eye(3), np.eye(3), off).angle_rad) == pytest.approx(12.0)
    assert math.degrees(angle_between_rad(np.eye(3), off)) == pytest.approx(12.0)
