"""Poses as messages: axes by hand, NaN for unknown values, and the round trip through the reader of ODOMETRY."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink.poses.gate import PoseLimits
from links.mavlink.poses.pose_messages import landing_target, odometry, quality_percent, vision_position_estimate
from links.mavlink.poses.sent_frame import SentFrame
from links.mavlink.readers import read_odometry
from links.mavlink.transport.framing import packed, parse_frame
from stages.geometry.frames import rotation_from_rpy_deg
from tests.links.mavlink.mavlink_poses import good_pose, position_of

mavlink: Any = ardupilotmega
LIMITS = PoseLimits()
MAP, LEFT = (SentFrame(yaw_rad, np.zeros(3)) for yaw_rad in (0.0, math.radians(90.0)))


def over_the_wire(message: Any) -> Any:
    return parse_frame(packed(message, mavlink.MAVLink(None, srcSystem=1, srcComponent=197)))


def test_odometry_is_the_drone_in_the_start_frame_forward_right_down():
    message = over_the_wire(odometry(good_pose(), MAP, 7, LIMITS))
    assert (message.frame_id, message.child_frame_id) == (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD)
    assert message.estimator_type == mavlink.MAV_ESTIMATOR_TYPE_VIO
    assert (message.x, message.y, message.z) == (101.0, -2.0, -10.0)
    np.testing.assert_allclose(message.q, [1, 0, 0, 0], atol=1e-7)
    assert (message.reset_counter, message.time_usec) == (7, good_pose().stamp_ns // 1000)


def test_a_drone_facing_left_has_yaw_minus_90_deg():
    R = rotation_from_rpy_deg((0.0, 0.0, 90.0))  # counter-clockwise positions from above
    message = over_the_wire(odometry(good_pose(R_map_drone=R, R_vehicle_drone=R), MAP, 0, LIMITS))
    np.testing.assert_allclose(message.q, [math.sqrt(0.5), 0, 0, -math.sqrt(0.5)], atol=1e-6)
    estimate = over_the_wire(vision_position_estimate(good_pose(R_map_drone=R), MAP, 3))
    np.testing.assert_allclose([estimate.roll, estimate.pitch, estimate.yaw], [0, 0, -math.pi / 2], atol=1e-6)
    assert (estimate.x, estimate.y, estimate.z, estimate.reset_counter) == (101.0, -2.0, -10.0, 3)


def test_nose_up_is_a_positive_pitch():
    R = rotation_from_rpy_deg((0.0, -20.0, 0.0))  # y is left, so nose up is negative
    estimate = over_the_wire(vision_position_estimate(good_pose(R_map_drone=R), MAP, 0))
    assert math.degrees(estimate.pitch) == pytest.approx(20.0, abs=1e-4)


def test_a_pose_is_turned_into_the_axes_that_it_is_sent_in():
    """Axes that have a yaw of 90 deg in map: 101 m forward and 2 m left are 2 m forward and 101 m right."""
    message = over_the_wire(odometry(good_pose(), LEFT, 7, LIMITS))
    assert (message.x, message.y, message.z) == pytest.approx((2.0, 101.0, -10.0), abs=1e-5)
    np.testing.assert_allclose(message.q, [math.sqrt(0.5), 0, 0, math.sqrt(0.5)], atol=1e-6)
    estimate = over_the_wire(vision_position_estimate(good_pose(), LEFT, 3))
    assert (estimate.x, estimate.y, estimate.yaw) == pytest.approx((2.0, 101.0, math.pi / 2), abs=1e-5)
    covariance = np.diag([1e-4, 1e-4, 4e-4, 0.01, 0.04, 0.09])
    message = over_the_wire(odometry(good_pose(map_covariance=covariance), LEFT, 7, LIMITS))
    assert [message.pose_covariance[k] for k in (0, 6, 11)] == pytest.approx([0.04, 0.01, 0.09])


def test_px4_receives_poses_with_yaw_as_ned():
    message = over_the_wire(odometry(good_pose(), LEFT, 7, LIMITS, "px4"))
    assert (message.frame_id, message.child_frame_id) == (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD)
    np.testing.assert_allclose(message.q, [math.sqrt(0.5), 0, 0, math.sqrt(0.5)], atol=1e-6)


def test_a_frame_through_a_position_has_it():
    frame = SentFrame.through(0.3, np.array([5.0, 6.0, 7.0]), np.array([-1.0, 2.0, 40.0]))
    np.testing.assert_allclose(frame.position(np.array([5.0, 6.0, 7.0])), [-1.0, 2.0, 40.0])
    moved_m = frame.position(np.array([6.0, 6.0, 7.0])) - frame.position(np.array([5.0, 6.0, 7.0]))
    np.testing.assert_allclose(moved_m, [math.cos(0.3), -math.sin(0.3), 0.0])


ANGLES = st.tuples(st.floats(-40, 40), st.floats(-40, 40), st.floats(-180, 180))
SPOTS = st.tuples(*[st.floats(-200, 200)] * 3)


@given(ANGLES, SPOTS, st.integers(0, 10_000))
@settings(max_examples=50, deadline=None)
def test_a_sent_pose_is_read_back_unchanged(rpy_deg: Any, xyz: Any, seed: int):
    rng = np.random.default_rng(seed)
    root = rng.normal(0, 0.05, (6, 6))
    covariance = root @ root.T + 1e-4 * np.eye(6)
    pose = good_pose(
        xyz_map_m=np.array(xyz),
        R_map_drone=rotation_from_rpy_deg(rpy_deg),
        map_covariance=covariance,
    )
    message = over_the_wire(odometry(pose, MAP, 0, LIMITS))
    message.rollspeed = message.pitchspeed = message.yawspeed = 0.0  # the reader needs finite values
    message.vx = message.vy = message.vz = 0.0
    read = read_odometry(message, pose.stamp_ns)
    np.testing.assert_allclose(read.xyz_odom_m, xyz, rtol=1e-6, atol=1e-5)
    assert pose.R_map_drone is not None
    np.testing.assert_allclose(read.R_odom_drone, pose.R_map_drone, atol=1e-6)
    assert read.pose_covariance is not None
    np.testing.assert_allclose(read.pose_covariance, covariance, rtol=1e-4, atol=1e-6)


def test_the_local_frame_is_static_while_the_vehicle_drives_below_a_hovering_drone():
    positions = set()
    for driven_m in (0.0, 3.0, 50.0):
        pose = good_pose(xyz_vehicle_m=np.array([5.0 - driven_m, 0.0, 10.0]), xyz_map_m=np.array([5.0, 0.0, 10.0]))
        message = odometry(pose, MAP, 0, LIMITS)
        positions.add((message.x, message.y, message.z))
    assert positions == {(5.0, 0.0, -10.0)}


def test_velocities_are_never_sent_and_are_nan_and_not_zero():
    message = over_the_wire(odometry(good_pose(), MAP, 0, LIMITS))
    assert all(math.isnan(v) for v in (message.vx, message.vy, message.vz))
    assert all(math.isnan(v) for v in (message.rollspeed, message.pitchspeed, message.yawspeed))
    assert all(math.isnan(v) for v in message.velocity_covariance)
    assert np.isfinite(message.pose_covariance).all()


def test_quality_decreases_from_100_to_1_at_the_limit_by_the_worse_sigma():
    exact = np.diag([1e-12] * 6)
    half = np.diag([1e-12] * 3 + [(0.5 * LIMITS.position_sigma_m) ** 2] * 3)
    turned = np.diag([math.radians(4.0) ** 2] + [1e-12] * 5)  # 4 deg of 5
    limit = np.diag([1e-12] * 3 + [LIMITS.position_sigma_m**2] * 3)

    def quality(start: Any, relative: Any) -> int:
        return quality_percent(good_pose(map_covariance=start, covariance=relative).estimate, LIMITS)

    assert quality(exact, exact) == 100
    assert quality(half, exact) == quality(exact, half) == 50
    assert quality(turned, half) == 20
    assert quality(limit, exact) == 1


def test_the_landing_target_is_the_vehicle_in_the_drones_body():
    message = over_the_wire(landing_target(good_pose()))
    assert (message.frame, message.position_valid) == (mavlink.MAV_FRAME_BODY_FRD, 1)
    np.testing.assert_allclose([message.x, message.y, message.z], [-1, 2, 10], rtol=1e-6)  # behind, right, below
    assert message.distance == pytest.approx(math.sqrt(105.0), rel=1e-6)
    line = np.array([-math.tan(message.angle_y), math.tan(message.angle_x), 1.0])  # ArduPilot's reading of the angles
    np.testing.assert_allclose(10.0 * line, [-1, 2, 10], rtol=1e-5)


def test_a_yawed_and_tilted_drone_has_the_vehicle_in_its_rotated_body_frame():
    yaw = rotation_from_rpy_deg((0.0, 0.0, 90.0))
    message = over_the_wire(landing_target(good_pose(R_vehicle_drone=yaw)))
    np.testing.assert_allclose([message.x, message.y, message.z], [-2, -1, 10], atol=1e-5)
    tilted = over_the_wire(landing_target(good_pose(R_vehicle_drone=rotation_from_rpy_deg((0.0, 10.0, 0.0)))))
    assert tilted.x == pytest.approx(-math.cos(math.radians(10)) + 10 * math.sin(math.radians(10)), abs=1e-5)


def test_a_vehicle_above_the_drone_has_a_position_and_no_angles():
    message = over_the_wire(landing_target(good_pose(xyz_vehicle_m=np.array([0.0, 1.0, -2.0]))))
    assert (message.x, message.y, message.z) == (0.0, 1.0, -2.0)
    assert math.isnan(message.angle_x)
    assert math.isnan(message.angle_y)


def test_the_reset_counter_is_one_byte():
    assert over_the_wire(odometry(good_pose(), MAP, 256 + 5, LIMITS)).reset_counter == 5


@pytest.mark.parametrize("estimate", [None, position_of(good_pose())])
def test_a_pose_without_a_rotation_is_an_error_of_the_caller(estimate: Any):
    pose = good_pose(estimate=estimate)
    with pytest.raises(ValueError, match="gate"):
        odometry(pose, MAP, 0, LIMITS)
    with pytest.raises(ValueError, match="rotation"):
        landing_target(pose)
