"""Yaw resets and reboots of the autopilot by its ATTITUDE."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink.poses.attitude_monitor import AttitudeEvent, AttitudeMonitor
from links.mavlink.poses.gate import PoseLimits, RejectReason
from links.mavlink.poses.pose_sender import PoseSender
from links.mavlink.poses.position_messages import OwnAttitude
from tests.links.mavlink.mavlink_poses import HOST0, MS, good_pose

mavlink: Any = ardupilotmega


def attitude(boot_ms: int, yaw_deg: float, rate_degps: float = 0.0, roll_deg: float = 0.0) -> Any:
    radians = (math.radians(v) for v in (roll_deg, 0.0, math.remainder(yaw_deg, 360.0), 0.0, 0.0, rate_degps))
    return mavlink.MAVLink_attitude_message(boot_ms, *radians)


def events(messages: list[Any]) -> list[AttitudeEvent | None]:
    monitor = AttitudeMonitor()
    return [monitor.add(message, HOST0) for message in messages]


def test_a_turn_that_the_rates_explain_is_no_reset():
    turning = [attitude(1000 + 100 * i, 170 + 12 * i, 120.0) for i in range(40)]
    assert set(events(turning)) == {None}


@pytest.mark.parametrize(
    ("jump_deg", "event"), [(5.0, None), (-12.0, AttitudeEvent.YAW_RESET), (180.0, AttitudeEvent.YAW_RESET)]
)
def test_a_change_of_yaw_that_no_rate_explains_is_a_reset(jump_deg: float, event: AttitudeEvent | None):
    assert events([attitude(1000, 30.0), attitude(1100, 30.0), attitude(1200, 30.0 + jump_deg)])[-1] is event


def test_over_a_gap_no_reset_is_seen():
    assert events([attitude(1000, 30.0), attitude(2100, 90.0)]) == [None, None]


def test_a_time_that_runs_backwards_is_a_boot_and_a_late_frame_is_ignored():
    monitor = AttitudeMonitor()
    assert monitor.add(attitude(60_000, 30.0), HOST0) is None
    assert monitor.add(attitude(59_900, 80.0), HOST0 + 1) is None
    assert monitor.newest is not None
    assert monitor.newest.arrival_ns == HOST0
    assert monitor.add(attitude(5000, 80.0), HOST0 + 2) is AttitudeEvent.BOOTED
    assert monitor.newest.arrival_ns == HOST0 + 2


def test_one_that_is_not_finite_is_ignored():
    assert events([attitude(1000, 30.0), attitude(1100, math.nan), attitude(1200, 30.0)]) == [None] * 3


def test_after_a_yaw_reset_no_position_is_sent_until_the_autopilot_boots():
    sender = PoseSender(("odometry",), PoseLimits(), yaw="none")
    sender.on_attitude(OwnAttitude(0.0, 0.0, 1.0, HOST0))
    sender.on_yaw_reset()  # before the first pose: the yaw is still learnt
    assert len(sender.messages(good_pose(), HOST0)) == 1
    sender.on_sent(good_pose(), HOST0)
    sender.on_yaw_reset()
    assert sender.messages(good_pose(HOST0 + 20 * MS), HOST0 + 20 * MS) == []
    assert sender.rejected == {RejectReason.ODOM_YAW_RESET: 1}
    sender.on_boot()
    assert len(sender.messages(good_pose(HOST0 + 40 * MS, odom_yaw_rad=0.5), HOST0 + 40 * MS)) == 1


def test_after_a_boot_no_position_is_sent_in_the_axes_of_before():
    sender = PoseSender(("odometry",), PoseLimits(), yaw="none")
    sender.on_attitude(OwnAttitude(0.0, 0.0, 1.0, HOST0))
    assert len(sender.messages(good_pose(), HOST0)) == 1
    sender.on_sent(good_pose(), HOST0)
    sender.on_boot()
    same = good_pose(HOST0 + 20 * MS)
    assert sender.messages(same, same.stamp_ns) == []
    assert sender.rejected == {RejectReason.ODOM_YAW: 1}
    learnt_again = good_pose(HOST0 + 40 * MS, odom_yaw_rad=0.01)
    assert len(sender.messages(learnt_again, learnt_again.stamp_ns)) == 1
