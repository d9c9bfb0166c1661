"""Positions without yaw on the wire: frames, NaN and variances of each autopilot."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink.poses.autopilot_estimate import AutopilotAttitude
from links.mavlink.poses.gate import PoseLimits, RejectReason
from links.mavlink.poses.pose_sender import PoseMessage, PoseSender
from links.mavlink.profiles import ProfileName
from links.mavlink.transport.framing import packed, parse_frame
from stages.messages import PoseState
from tests.links.mavlink.mavlink_poses import HOST0, MS, good_pose, position_of

mavlink: Any = ardupilotmega


def sender(
    kinds: tuple[PoseMessage, ...] = ("odometry",), profile: ProfileName = "ardupilot", attitude: bool = True
) -> PoseSender:
    pose_sender = PoseSender(kinds, PoseLimits(), yaw="none", profile=profile)
    if attitude:
        pose_sender.autopilot.attitude = AutopilotAttitude(0.1, 0.2, 2.0, HOST0)
    return pose_sender


def position(stamp_ns: int = HOST0, **changes: Any) -> Any:
    """A pose without rotation, 101 m along `map`, which is 90 deg from the autopilot's axes."""
    changes = {"estimate": position_of(good_pose()), "state": PoseState.POSITION_ONLY, **changes}
    return good_pose(stamp_ns, odom_yaw_rad=math.pi / 2, **changes)


def sent(pose_sender: PoseSender, pose: Any, now_ns: int = HOST0) -> list[Any]:
    own = mavlink.MAVLink(None, srcSystem=1, srcComponent=197)
    return [parse_frame(packed(message, own)) for message in pose_sender.messages(pose, now_ns)]


def test_ardupilot_receives_the_position_in_its_axes_and_its_own_attitude():
    (message,) = sent(sender(), position())
    assert (message.frame_id, message.child_frame_id) == (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD)
    # xyz_map (101, 2, 10): y of map is x of odom
    np.testing.assert_allclose([message.x, message.y, message.z], [2, 101, -10], atol=1e-4)
    w, x, y, z = message.q
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    assert yaw == pytest.approx(2.0, abs=1e-6)
    assert np.isfinite(message.pose_covariance).all()
    angle_error = math.cbrt(sum(message.pose_covariance[i] ** 2 for i in (15, 18, 20)))  # handle_odometry
    assert angle_error > 1.5  # the largest that it takes
    assert all(math.isnan(v) for v in (message.vx, message.vy, message.vz, message.velocity_covariance[0]))


def test_px4_receives_the_position_as_ned_and_no_rotation():
    (message,) = sent(sender(profile="px4"), position())
    assert (message.frame_id, message.child_frame_id) == (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD)
    np.testing.assert_allclose([message.x, message.y, message.z], [2, 101, -10], atol=1e-4)
    assert all(math.isnan(v) for v in message.q)
    assert all(math.isnan(message.pose_covariance[i]) for i in (15, 18, 20))
    assert all(message.pose_covariance[i] > 0 for i in (0, 6, 11))
    assert message.estimator_type == mavlink.MAV_ESTIMATOR_TYPE_VIO


def test_vision_position_estimate_has_the_same_content():
    (message,) = sent(sender(("vision_position_estimate",)), position())
    np.testing.assert_allclose([message.x, message.y, message.z], [2, 101, -10], atol=1e-4)
    np.testing.assert_allclose([message.roll, message.pitch, message.yaw], [0.1, 0.2, 2.0], atol=1e-6)


@pytest.mark.parametrize(("attitude", "later_ms"), [(False, 0), (True, 1020)])
@pytest.mark.parametrize("profile", ["ardupilot", "px4"])
def test_without_a_recent_attitude_nothing_is_sent(profile: ProfileName, attitude: bool, later_ms: int):
    """It may have booted: its axes may be others."""
    pose_sender, now_ns = sender(profile=profile, attitude=attitude), HOST0 + later_ms * MS
    assert sent(pose_sender, position(now_ns), now_ns) == []
    assert pose_sender.rejected == {RejectReason.NO_ATTITUDE: 1}


def test_a_position_sends_no_landing_target_and_a_full_pose_does():
    pose_sender = sender(("odometry", "landing_target"))
    kinds = [message.get_type() for message in sent(pose_sender, position())]
    assert kinds == ["ODOMETRY"]
    assert pose_sender.rejected == {RejectReason.POSITION_ONLY: 1}
    kinds = [
        message.get_type()
        for message in sent(pose_sender, good_pose(HOST0 + 20 * MS, odom_yaw_rad=2.0), HOST0 + 20 * MS)
    ]
    assert kinds == ["ODOMETRY", "LANDING_TARGET"]


@pytest.mark.parametrize(("age_s", "messages"), [(1.9, 1), (2.1, 0), (None, 0)])
def test_a_yaw_is_sent_only_while_cameras_measure_it(age_s: float | None, messages: int):
    pose_sender = PoseSender(("odometry",), PoseLimits(), yaw="measured")
    measured_ns = None if age_s is None else HOST0 - round(1e9 * age_s)
    assert len(pose_sender.messages(good_pose(rotation_ns=measured_ns), HOST0)) == messages
    assert pose_sender.rejected == ({} if messages else {RejectReason.YAW_NOT_MEASURED: 1})
