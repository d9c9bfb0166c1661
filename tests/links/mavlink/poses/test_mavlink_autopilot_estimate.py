"""Yaw resets and reboots of the autopilot by its ATTITUDE."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink import Autopilot
from links.mavlink.poses.autopilot_estimate import AutopilotAttitude, AutopilotEstimate, EstimateEvent
from links.mavlink.poses.gate import PoseLimits, RejectReason
from links.mavlink.poses.odom_frame import read_odom_frame
from links.mavlink.poses.pose_sender import PoseSender
from links.mavlink.transport.framing import packed, parse_frame
from links.simulated.rig.pose_loop import PEER, VirtualConnection
from tests.links.mavlink.mavlink_poses import HOST0, MS, good_pose, position_of

mavlink: Any = ardupilotmega


def attitude(boot_ms: int, yaw_deg: float, rate_degps: float = 0.0, roll_deg: float = 0.0) -> Any:
    radians = (math.radians(v) for v in (roll_deg, 0.0, math.remainder(yaw_deg, 360.0), 0.0, 0.0, rate_degps))
    return mavlink.MAVLink_attitude_message(boot_ms, *radians)


def events(messages: list[Any]) -> list[EstimateEvent | None]:
    autopilot = AutopilotEstimate()
    return [autopilot.add(message, HOST0) for message in messages]


def test_a_turn_that_the_rates_explain_is_no_reset():
    turning = [attitude(1000 + 100 * i, 170 + 12 * i, 120.0) for i in range(40)]
    assert set(events(turning)) == {None}


@pytest.mark.parametrize(
    ("jump_deg", "event"), [(5.0, None), (-12.0, EstimateEvent.YAW_RESET), (180.0, EstimateEvent.YAW_RESET)]
)
def test_a_change_of_yaw_that_no_rate_explains_is_a_reset(jump_deg: float, event: EstimateEvent | None):
    assert events([attitude(1000, 30.0), attitude(1100, 30.0), attitude(1200, 30.0 + jump_deg)])[-1] is event


def test_in_a_fast_turn_the_rates_may_be_wrong_by_their_share():
    turning = [attitude(1000 + 300 * i, 170 + 1.25 * 36 * i, 120.0) for i in range(20)]  # 25 % faster than the rates
    assert set(events(turning)) == {None}


def test_the_session_stops_positions_without_yaw_when_the_autopilot_resets_its_yaw():
    link = Autopilot(yaw="none")
    session = link.open_session(VirtualConnection(), lambda: HOST0, threaded=False)
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for boot_ms, yaw_deg, sent in ((1000, 30.0, 1), (1100, 30.0, 2), (1200, 60.0, 2)):
        list(session.receive(packed(attitude(boot_ms, yaw_deg), mav), PEER, HOST0))
        session.send_pose(good_pose(HOST0 + (boot_ms - 1100) // 10 * MS, odom_yaw_rad=math.radians(30.0)))
        assert session.counters.get("sent: ODOMETRY", 0) == sent
    assert session.poses.rejected == {RejectReason.ODOM_YAW_RESET: 1}


def test_over_a_gap_no_reset_is_seen():
    assert events([attitude(1000, 30.0), attitude(2100, 90.0)]) == [None, None]


def test_a_time_that_runs_backwards_is_a_boot_and_a_late_frame_is_ignored():
    autopilot = AutopilotEstimate()
    assert autopilot.add(attitude(60_000, 30.0), HOST0) is None
    assert autopilot.add(attitude(59_900, 80.0), HOST0 + 1) is None
    assert autopilot.attitude is not None
    assert autopilot.attitude.arrival_ns == HOST0
    assert autopilot.add(attitude(5000, 80.0), HOST0 + 2) is EstimateEvent.BOOTED
    assert autopilot.attitude.arrival_ns == HOST0 + 2


def test_any_message_with_a_time_since_boot_shows_a_boot_and_what_was_known_before_is_dropped():
    autopilot = AutopilotEstimate()
    autopilot.add(attitude(60_000, 30.0), HOST0)
    position = mavlink.MAVLink_local_position_ned_message(60_010, 1, 2, -3, 1, 0, 0)
    assert autopilot.add(position, HOST0) is None
    assert autopilot.position is not None
    np.testing.assert_allclose(autopilot.position.at(HOST0 + 100 * MS), [1.1, -2, 3])
    assert autopilot.position.at(HOST0 + 400 * MS) is None
    assert autopilot.add(mavlink.MAVLink_scaled_imu_message(2_000, *[0] * 9), HOST0) is EstimateEvent.BOOTED
    assert autopilot.attitude is autopilot.position is None


def test_a_boot_is_seen_in_the_replies_to_timesync():
    """After a boot ArduPilot sends heartbeats and these alone, until the messages are requested again."""
    link, now_ns, device_ns = Autopilot(), [HOST0], [600 * 1000 * MS]
    session = link.open_session(VirtualConnection(), lambda: now_ns[0], threaded=False)
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)

    def run(seconds: float) -> int:
        for _ in range(round(20 * seconds)):
            now_ns[0], device_ns[0] = now_ns[0] + 50 * MS, device_ns[0] + 50 * MS
            session.tick()
            sent = [parse_frame(record.data) for record in session.sent()]
            asked = [m.ts1 for m in sent if m.get_type() == "TIMESYNC"]
            answers = [mavlink.MAVLink_timesync_message(device_ns[0], ts1) for ts1 in asked]
            for answer in (mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3), *answers):
                list(session.receive(packed(answer, mav), PEER, now_ns[0]))
        return session.counters.get("message intervals restarted", 0)

    before = run(10)
    device_ns[0] = 0
    assert run(2) == before + 1
    assert run(10) == before + 1


def test_times_of_timesync_and_of_messages_are_not_compared():
    """A device may send another time in its replies."""
    autopilot = AutopilotEstimate()
    for boot_ms in range(60_000, 60_400, 100):
        assert autopilot.add(attitude(boot_ms, 30.0), HOST0) is None
        assert autopilot.on_timesync(1_760_000_000_000 + boot_ms) is None
    assert autopilot.on_timesync(1_000) is EstimateEvent.BOOTED
    assert autopilot.add(attitude(1_100, 30.0), HOST0) is None


def test_a_position_of_px4_without_aiding_is_not_used():
    autopilot = AutopilotEstimate()
    for flags, used in ((1 | 8, False), (1 | 8 | 256, True)):
        autopilot.add(mavlink.MAVLink_estimator_status_message(1_000_000, flags, *[0.1] * 4, 0, 0, 1, 1), HOST0)
        autopilot.add(mavlink.MAVLink_local_position_ned_message(1_010, 1, 2, -3, 1, 0, 0), HOST0)
        assert (autopilot.position is not None) == used


def test_one_that_is_not_finite_is_ignored():
    assert events([attitude(1000, 30.0), attitude(1100, math.nan), attitude(1200, 30.0)]) == [None] * 3


def test_after_a_yaw_reset_no_position_is_sent_until_the_autopilot_boots():
    sender = PoseSender(("odometry",), PoseLimits(), yaw="none")
    sender.autopilot.attitude = AutopilotAttitude(0.0, 0.0, 0.0, HOST0)
    sender.on_yaw_reset()  # before the first pose: the yaw is still learnt
    messages = sender.messages(good_pose(), HOST0)
    assert len(messages) == 1
    sender.on_sent(good_pose(), HOST0, messages)
    sender.on_yaw_reset()
    assert sender.messages(good_pose(HOST0 + 20 * MS), HOST0 + 20 * MS) == []
    assert sender.rejected == {RejectReason.ODOM_YAW_RESET: 1}
    sender.on_boot()
    assert len(sender.messages(good_pose(HOST0 + 40 * MS, odom_yaw_rad=0.05), HOST0 + 40 * MS)) == 1


def test_after_a_boot_no_position_is_sent_in_the_axes_of_before():
    sender = PoseSender(("odometry",), PoseLimits(), yaw="none")
    sender.autopilot.attitude = AutopilotAttitude(0.0, 0.0, 0.0, HOST0)
    messages = sender.messages(good_pose(), HOST0)
    assert len(messages) == 1
    sender.on_sent(good_pose(), HOST0, messages)
    sender.on_boot()
    same = good_pose(HOST0 + 20 * MS)
    assert sender.messages(same, same.stamp_ns) == []
    assert sender.rejected == {RejectReason.ODOM_YAW: 1}
    learnt_again = good_pose(HOST0 + 40 * MS, odom_yaw_rad=0.01)
    assert len(sender.messages(learnt_again, learnt_again.stamp_ns)) == 1


def test_while_the_estimate_does_not_jump_positions_keep_the_axes_of_the_first():
    sender = PoseSender(("odometry",), PoseLimits(), yaw="none")
    sender.autopilot.attitude = AutopilotAttitude(0.0, 0.0, 0.0, HOST0)
    coarse, sharp = {"odom_yaw_sigma_rad": math.radians(4.0)}, {"odom_yaw_sigma_rad": math.radians(1.0)}

    def sent(at_ms: int, **changes: Any) -> Any:
        pose = good_pose(HOST0 + at_ms * MS, **changes)
        (message,) = sender.messages(pose, pose.stamp_ns)
        sender.on_sent(pose, pose.stamp_ns, [message])
        return message

    first = sent(0, odom_yaw_rad=0.0, **coarse)
    same = sent(20, odom_yaw_rad=0.25, **sharp)
    assert (same.x, same.y, same.pose_covariance) == (first.x, first.y, first.pose_covariance)
    jumped = sent(40, odom_yaw_rad=0.25, resets=good_pose().resets + 1, **sharp)
    assert jumped.reset_counter == first.reset_counter + 1
    assert (jumped.x, jumped.y) == pytest.approx((first.x, first.y))
    resets, moved = good_pose().resets + 1, {"xyz_map_m": np.array([111.0, 2.0, 10.0])}
    for at_ms, yaw_rad in ((60, 0.25), (80, 0.0)):
        message = sent(at_ms, odom_yaw_rad=yaw_rad, resets=resets, **moved, **coarse)
        assert message.y == pytest.approx(first.y + 10.0 * math.sin(0.25), abs=1e-4)


@pytest.mark.parametrize("was_sent", [True, False])
def test_after_several_boots_no_position_is_sent_in_the_axes_of_the_first(was_sent: bool):
    sender = PoseSender(("odometry",), PoseLimits(), yaw="none")
    sender.autopilot.attitude = AutopilotAttitude(0.0, 0.0, 0.0, HOST0)
    messages = sender.messages(good_pose(), HOST0)
    if was_sent:
        sender.on_sent(good_pose(), HOST0, messages)
    for boot in range(1, 4):
        sender.on_boot()
        same = good_pose(HOST0 + boot * 20 * MS)
        assert sender.messages(same, same.stamp_ns) == []
    learnt_again = good_pose(HOST0 + 100 * MS, odom_yaw_rad=0.01)
    assert len(sender.messages(learnt_again, learnt_again.stamp_ns)) == 1


def test_the_distance_from_the_first_position_adds_no_error():
    sender = PoseSender(("odometry",), PoseLimits(), yaw="none")
    sender.autopilot.attitude = AutopilotAttitude(0.0, 0.0, 0.0, HOST0)
    first = good_pose()
    (near,) = sender.messages(first, HOST0)
    sender.on_sent(first, HOST0, [near])
    assert first.xyz_map_m is not None
    (far,) = sender.messages(good_pose(HOST0 + 20 * MS, xyz_map_m=first.xyz_map_m + 1000.0), HOST0 + 20 * MS)
    assert far.pose_covariance == near.pose_covariance


@pytest.mark.parametrize(("compass_deg", "sent"), [(0.0, 1), (12.0, 1), (-30.0, 0), (170.0, 0)])
def test_with_a_wrong_compass_no_position_is_sent_once_the_yaw_is_measured(compass_deg: float, sent: int):
    """The body's yaw is 0 in map and in the learnt axes."""
    sender = PoseSender(("odometry",), PoseLimits(), yaw="none")
    sender.autopilot.attitude = AutopilotAttitude(0.0, 0.0, math.radians(compass_deg), HOST0)
    pose = good_pose()
    assert len(sender.messages(dataclasses.replace(pose, estimate=position_of(pose)), HOST0)) == 1
    assert len(sender.messages(pose, HOST0)) == sent
    assert sender.rejected == ({} if sent else {RejectReason.COMPASS: 1})


def test_a_session_that_sends_yaw_reports_its_axes_and_keeps_the_yaw_of_the_attitude_for_a_restart(tmp_path: Path):
    """The axes are those learnt, 25 deg; the autopilot's compass is 35 deg off them, and a restart reads its yaw."""
    link = Autopilot(yaw="measured", switch_source=True, state_file=tmp_path / "sent.json")
    session = link.open_session(VirtualConnection(), lambda: HOST0, threaded=False)
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    position = mavlink.MAVLink_local_position_ned_message(1000, 0, 0, 0, 0, 0, 0)
    for message in (attitude(1000, 60.0), position):
        list(session.receive(packed(message, mav), PEER, HOST0))
    session.send_pose(good_pose(odom_yaw_rad=math.radians(25.0)))
    assert session.counters["yaw in map of the sent axes [deg]"] == 25
    session.write_state()
    kept = parse_frame(bytes.fromhex(json.loads((tmp_path / "sent.json").read_text())["odom"]))
    assert math.degrees(read_odom_frame(kept, HOST0).yaw_map_odom_rad) == pytest.approx(60.0, abs=1e-3)


def test_a_yaw_reset_before_the_switch_is_the_angle_between_the_axes_of_both_sets():
    link = Autopilot(yaw="measured", switch_source=True)
    session = link.open_session(VirtualConnection(), lambda: HOST0, threaded=False)
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for boot_ms, yaw_deg, turn_deg in ((1000, 60.0, 0.0), (1100, 100.0, -40.0)):
        list(session.receive(packed(attitude(boot_ms, yaw_deg), mav), PEER, HOST0))
        session.send_pose(good_pose(HOST0 + (boot_ms - 1100) // 10 * MS, odom_yaw_rad=None))
        assert math.degrees(session.switch._turn_rad) == pytest.approx(turn_deg, abs=1e-4)


def test_landing_target_alone_is_no_sending_of_poses():
    sender = PoseSender(("odometry", "landing_target"), PoseLimits(), yaw="none")
    sender.autopilot.attitude = AutopilotAttitude(0.0, 0.0, 0.0, HOST0)
    first = good_pose()
    sender.on_sent(first, HOST0, sender.messages(first, HOST0))
    assert sender.sending
    counter = sender.reset_counter
    sender.on_yaw_reset()
    later = good_pose(HOST0 + 20 * MS)
    messages = sender.messages(later, later.stamp_ns)
    assert [message.get_type() for message in messages] == ["LANDING_TARGET"]
    sender.on_sent(later, later.stamp_ns, messages)
    assert not sender.sending
    sender.on_boot()
    again = good_pose(HOST0 + 4000 * MS, odom_yaw_rad=0.05)
    sender.autopilot.attitude = AutopilotAttitude(0.0, 0.0, 0.0, again.stamp_ns)
    assert {message.get_type() for message in sender.messages(again, again.stamp_ns)} == {"ODOMETRY", "LANDING_TARGET"}
    assert sender.reset_counter == (counter + 1) % 256


class LinkFlight:
    """A session with yaw: a pose every 20 ms, and with each tenth an EKF status with this ratio of the position."""

    def __init__(self, **settings: Any) -> None:
        self.now_ns = HOST0
        self.link = Autopilot(yaw="measured", **settings)
        self.session = self.link.open_session(VirtualConnection(), lambda: self.now_ns, threaded=False)
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)

    def give(self, message: Any) -> None:
        list(self.session.receive(packed(message, self._mav), PEER, self.now_ns))

    def fly(self, seconds: float, ratio: float) -> LinkFlight:
        for step in range(round(50 * seconds)):
            self.now_ns += 20 * MS
            if step % 10 == 0:
                self.give(attitude((self.now_ns - HOST0) // MS + 1000, 60.0))
                self.give(mavlink.MAVLink_ekf_status_report_message(0, 0.1, ratio, 0.1, 0.1, 0.0))
            self.session.send_pose(good_pose(self.now_ns))
            self.session.tick()
        return self


@pytest.mark.parametrize(
    ("text", "silence_s", "stopped"), [("Set 1", 0, False), ("Set 1", 4, True), ("Set 2", 0, True)]
)
def test_a_ratio_counts_unless_the_autopilot_is_known_to_use_another_set(text: str, silence_s: int, stopped: bool):
    flight = LinkFlight().fly(1.0, 0.1)
    flight.give(mavlink.MAVLink_statustext_message(6, f"Using EKF Source {text}".encode()))
    flight.now_ns += silence_s * 1000 * MS
    assert flight.fly(2.0, 1.4).session.poses.fusion.stopped is stopped


@pytest.mark.parametrize("switch_source", [True, False])
def test_the_state_of_the_gps_is_requested_only_to_switch_source_sets(switch_source: bool):
    flight = LinkFlight(switch_source=switch_source)
    flight.fly(12.0, 0.1)
    frames = [parse_frame(record.data) for record in flight.session.sent()]
    asked = {round(frame.param1) for frame in frames if frame.get_type() == "COMMAND_LONG" and frame.command == 511}
    assert (24 in asked) is switch_source
