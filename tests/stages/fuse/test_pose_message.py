"""The fused pose in the vehicle frame: axes of its covariance and the uncertainty of the vehicle's own motion, by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from stages.fuse.pose_message import MapEstimate, Status, pose
from stages.messages import PoseState

SHIFT_M2 = np.diag([0.01, 0.02, 0.04])  # vehicle axes, of the vehicle's position since its newest message
NO_SHIFT_M2 = np.zeros((3, 3))
YAW_RAD2 = 0.001
COS, SIN = 0.8, 0.6
R_MAP_VEHICLE = np.array([[COS, -SIN, 0.0], [SIN, COS, 0.0], [0.0, 0.0, 1.0]])
R_VEHICLE_DRONE = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # drone x, y, z: vehicle y, z, x
XYZ_VEHICLE_M = np.array([1.0, 2.0, 3.0])
LEVER_VEHICLE_M = np.array([-2.0, 1.0, 0.0])  # derivative of the drone's position by the vehicle's yaw


def motions(yaw_rad2=0.0, shift_m2=NO_SHIFT_M2):
    """A vehicle at the origin of `map`, turned by R_MAP_VEHICLE, with the given uncertainty of its extrapolation."""
    position_m2 = shift_m2 + yaw_rad2 * np.outer(LEVER_VEHICLE_M, LEVER_VEHICLE_M)
    return SimpleNamespace(
        vehicle=SimpleNamespace(
            at=lambda _: (R_MAP_VEHICLE, np.zeros(3)),
            to_vehicle=lambda _, xyz_m, velocity_mps: (R_MAP_VEHICLE.T @ xyz_m, R_MAP_VEHICLE.T @ velocity_mps),
        ),
        vehicle_covariance_m2=lambda _, xyz_vehicle_m: (position_m2, yaw_rad2, LEVER_VEHICLE_M),
    )


def fused(covariance, R_map_drone, motions):
    known = MapEstimate(10**9, R_map_drone, R_MAP_VEHICLE @ XYZ_VEHICLE_M, covariance, np.zeros(3), np.eye(3))
    return pose(known, Status(PoseState.FULL, "", 10**9, 1, 0, 1.0), motions)


def test_without_a_rotation_the_position_covariance_turns_from_map_into_vehicle_axes():
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = np.diag([1.0, 4.0, 9.0])
    message = fused(covariance, None, motions())
    np.testing.assert_allclose(
        message.estimate.covariance_vehicle_m2, [[2.08, 1.44, 0.0], [1.44, 2.92, 0.0], [0.0, 0.0, 9.0]], atol=1e-12
    )
    np.testing.assert_allclose(message.estimate.covariance_map_m2, np.diag([1.0, 4.0, 9.0]))
    assert message.R_vehicle_drone is None


def test_with_a_rotation_the_covariance_in_drone_axes_is_the_same_from_both_frames():
    covariance = np.diag([1e-4, 2e-4, 3e-4, 0.1, 0.2, 0.3])
    message = fused(covariance, R_MAP_VEHICLE @ R_VEHICLE_DRONE, motions())
    np.testing.assert_allclose(message.estimate.covariance, covariance)
    np.testing.assert_allclose(message.estimate.map_covariance, covariance)
    np.testing.assert_allclose(message.R_vehicle_drone, R_VEHICLE_DRONE, atol=1e-12)


def test_the_shift_of_the_vehicle_is_added_in_drone_axes():
    message = fused(np.eye(6), R_MAP_VEHICLE @ R_VEHICLE_DRONE, motions(shift_m2=SHIFT_M2))
    np.testing.assert_allclose(message.estimate.covariance, np.diag([1.0, 1.0, 1.0, 1.02, 1.04, 1.01]), atol=1e-12)
    np.testing.assert_allclose(message.estimate.map_covariance, np.eye(6))


def test_the_yaw_of_the_vehicle_turns_the_drone_about_its_vertical_and_moves_it_along_the_lever():
    message = fused(np.eye(6), R_MAP_VEHICLE @ R_VEHICLE_DRONE, motions(YAW_RAD2))
    column = np.array([0.0, 1.0, 0.0, 1.0, 0.0, -2.0])  # vertical, then lever, both in drone axes
    np.testing.assert_allclose(message.estimate.covariance, np.eye(6) + YAW_RAD2 * np.outer(column, column), atol=1e-12)


@pytest.mark.parametrize("yaw_rad2", [0.0, YAW_RAD2])
def test_without_a_rotation_the_motion_of_the_vehicle_is_added_in_vehicle_axes(yaw_rad2):
    message = fused(np.zeros((6, 6)), None, motions(yaw_rad2, SHIFT_M2))
    expected_m2 = SHIFT_M2 + yaw_rad2 * np.array([[4.0, -2.0, 0.0], [-2.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(message.estimate.covariance_vehicle_m2, expected_m2, atol=1e-12)
