"""When poses are sent, which texts report those that are not, and when the reset counter changes."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import pytest

from links.mavlink.poses.autopilot_estimate import AutopilotAttitude, AutopilotPosition
from links.mavlink.poses.gate import PoseLimits, RejectReason
from links.mavlink.poses.pose_sender import PoseSender
from links.mavlink.poses.status_texts import TEXT_BYTES, fitted
from links.mavlink.profiles import YawOutput
from stages.geometry.frames import rotation_z
from stages.messages import PoseState
from tests.links.mavlink.mavlink_poses import HOST0, MS, good_pose


class Output:
    """Sends poses at a rate and keeps the sent counters and texts."""

    def __init__(self, **settings: Any) -> None:
        self.pose_sender = PoseSender(("odometry",), PoseLimits(), **{"yaw": "measured", **settings})
        self.now_ns = HOST0
        self.counters: list[int] = []
        self.sent: list[Any] = []
        self.texts: list[tuple[int, str]] = []

    def pose(self, after_ms: int = 20, sent: bool = True, **changes: Any) -> int:
        self.now_ns += after_ms * MS
        pose = good_pose(self.now_ns, **changes)
        messages = self.pose_sender.messages(pose, self.now_ns)
        if messages and sent:
            self.pose_sender.on_sent(pose, self.now_ns, messages)
            self.counters += [m.reset_counter for m in messages]
            self.sent += messages
        self.collect()
        return len(messages)

    def wait(self, ms: int) -> None:
        for _ in range(ms // 50):
            self.now_ns += 50 * MS
            self.collect()

    def collect(self) -> None:
        self.texts += [(m.severity, m.text) for m in self.pose_sender.due_texts(self.now_ns)]


def test_the_counter_is_constant_without_gaps_and_jumps():
    output = Output(reset_counter=250)
    for _ in range(50):
        output.pose()
    assert set(output.counters) == {250}


def yaw_ned_rad(message: Any) -> float:
    w, x, y, z = message.q
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def test_the_axes_are_the_autopilots_at_the_first_pose_and_stay_those():
    """The drone's yaw in map is 0; the autopilot reports 60 deg to the right of its north."""
    output = Output()
    autopilot = output.pose_sender.autopilot
    autopilot.attitude = AutopilotAttitude(0.0, 0.0, math.radians(60.0), HOST0)
    output.pose(odom_yaw_rad=None)
    autopilot.attitude = AutopilotAttitude(0.0, 0.0, math.radians(100.0), HOST0)  # its EKF has reset its yaw
    output.pose(odom_yaw_rad=None)
    for message in output.sent:
        assert yaw_ned_rad(message) == pytest.approx(math.radians(60.0), abs=1e-6)
        x, y = message.x, message.y
        c, s = math.cos(math.radians(60.0)), math.sin(math.radians(60.0))
        assert (c * x + s * y, -s * x + c * y) == pytest.approx((101.0, -2.0), abs=1e-5)
    output.pose_sender.on_boot()
    output.pose(odom_yaw_rad=None)
    assert yaw_ned_rad(output.sent[-1]) == pytest.approx(math.radians(100.0), abs=1e-6)


def test_a_learnt_yaw_of_the_autopilots_axes_counts_more_than_its_compass():
    output = Output()
    output.pose_sender.autopilot.attitude = AutopilotAttitude(0.0, 0.0, math.radians(60.0), HOST0)
    output.pose(odom_yaw_rad=math.radians(25.0))
    assert yaw_ned_rad(output.sent[-1]) == pytest.approx(math.radians(25.0), abs=1e-6)
    output.pose_sender.on_boot()  # its axes are others; the learnt yaw is of the boot before
    output.pose_sender.autopilot.attitude = AutopilotAttitude(0.0, 0.0, math.radians(60.0), output.now_ns)
    output.pose(odom_yaw_rad=math.radians(25.0))
    assert yaw_ned_rad(output.sent[-1]) == pytest.approx(math.radians(60.0), abs=1e-6)


def test_with_yaw_a_learnt_yaw_that_is_not_sharp_counts_less_than_the_attitude():
    output = Output()
    output.pose_sender.autopilot.attitude = AutopilotAttitude(0.0, 0.0, math.radians(60.0), HOST0)
    output.pose(odom_yaw_rad=math.radians(25.0), odom_yaw_sigma_rad=math.radians(3.0))
    assert yaw_ned_rad(output.sent[-1]) == pytest.approx(math.radians(60.0), abs=1e-6)


def ned_m(message: Any) -> tuple[float, float, float]:
    return message.x, message.y, message.z


@pytest.mark.parametrize("yaw", ["none", "measured"])
def test_poses_are_sent_in_the_frame_of_the_autopilots_position_at_the_first_one(yaw: YawOutput):
    """It is 900 m north and 50 m west of its origin, 60 m high; `map` is 90 deg from its axes."""
    output = Output(yaw=yaw)
    autopilot = output.pose_sender.autopilot
    autopilot.attitude = AutopilotAttitude(0.0, 0.0, math.pi / 2, HOST0)
    autopilot.position = AutopilotPosition(HOST0, np.array([900.0, 50.0, 60.0]), np.zeros(3))
    output.pose(odom_yaw_rad=math.pi / 2)
    assert ned_m(output.sent[-1]) == pytest.approx((900.0, -50.0, -60.0), abs=1e-3)
    autopilot.position = AutopilotPosition(HOST0, np.array([905.0, 45.0, 60.0]), np.zeros(3))  # its own, later
    output.pose(odom_yaw_rad=math.pi / 2, xyz_map_m=np.array([101.0, 5.0, 11.0]))  # y of map is its x
    assert ned_m(output.sent[-1]) == pytest.approx((903.0, -50.0, -61.0), abs=1e-3)
    output.pose(odom_yaw_rad=math.pi / 2, resets=1)
    assert ned_m(output.sent[-1]) == pytest.approx((900.0, -50.0, -60.0), abs=1e-3)
    output.pose_sender.on_boot()  # its origin is another one
    autopilot.attitude = AutopilotAttitude(0.0, 0.0, 0.0, output.now_ns)
    autopilot.position = AutopilotPosition(output.now_ns, np.array([1.0, 2.0, 3.0]), np.zeros(3))
    output.pose(odom_yaw_rad=0.0)
    assert ned_m(output.sent[-1]) == pytest.approx((1.0, -2.0, -3.0), abs=1e-3)


def test_a_frame_without_the_autopilots_position_begins_again_with_its_first_one():
    output = Output()
    output.pose(odom_yaw_rad=0.0)
    assert ned_m(output.sent[-1]) == pytest.approx((101.0, -2.0, -10.0), abs=1e-3)
    position = AutopilotPosition(output.now_ns, np.array([300.0, 400.0, 5.0]), np.zeros(3))
    output.pose_sender.autopilot.position = position
    output.pose(odom_yaw_rad=0.0)
    output.pose(odom_yaw_rad=0.0, xyz_map_m=np.array([102.0, 2.0, 10.0]))
    assert ned_m(output.sent[-2]) == pytest.approx((300.0, -400.0, -5.0), abs=1e-3)
    assert ned_m(output.sent[-1]) == pytest.approx((301.0, -400.0, -5.0), abs=1e-3)
    assert output.counters == [0, 1, 1]


def test_a_frame_whose_pose_was_not_sent_is_none():
    output = Output()
    output.pose(odom_yaw_rad=0.0, sent=False)
    position = AutopilotPosition(output.now_ns, np.array([900.0, 50.0, 60.0]), np.zeros(3))
    output.pose_sender.autopilot.position = position
    output.pose_sender.autopilot.attitude = AutopilotAttitude(0.0, 0.0, 1.0, output.now_ns)
    output.pose(odom_yaw_rad=None)
    assert ned_m(output.sent[-1]) == pytest.approx((900.0, -50.0, -60.0), abs=1e-3)
    assert yaw_ned_rad(output.sent[-1]) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("away_m", "turned_deg", "begins_again"),
    [(0.5, 0.0, False), (0.5, 10.0, False), (40.0, 0.0, True), (0.5, 90.0, True)],
)
def test_in_another_map_the_frame_begins_again_where_the_autopilot_is(
    away_m: float, turned_deg: float, begins_again: bool
):
    """The vehicle's odometry restarts: the same place has other coordinates, and the body another yaw."""
    output = Output()
    autopilot = output.pose_sender.autopilot
    autopilot.attitude = AutopilotAttitude(0.0, 0.0, 0.0, HOST0)
    autopilot.position = AutopilotPosition(HOST0, np.array([900.0, 50.0, 60.0]), np.zeros(3))
    output.pose(odom_yaw_rad=None)
    R = rotation_z(math.radians(turned_deg))
    other = {"xyz_map_m": np.array([101.0 + away_m, 2.0, 10.0]), "R_map_drone": R}
    output.pose(odom_yaw_rad=None, resets=1, map_number=1, **other)
    moved = (900.0, -50.0, -60.0) if begins_again else (900.0 + away_m, -50.0, -60.0)
    assert ned_m(output.sent[-1]) == pytest.approx(moved, abs=1e-3)
    assert yaw_ned_rad(output.sent[-1]) == pytest.approx(0.0 if begins_again else -math.radians(turned_deg), abs=1e-6)
    assert output.counters == [0, 1]


@pytest.mark.parametrize("jump", [{"resets": 1}, {"track_id": 2}, {"after_ms": 5000}])
def test_in_the_same_map_the_frame_stays_wherever_the_autopilot_has_drifted(jump: dict[str, int]):
    output = Output()
    autopilot = output.pose_sender.autopilot
    autopilot.position = AutopilotPosition(HOST0, np.array([900.0, 50.0, 60.0]), np.zeros(3))
    output.pose(odom_yaw_rad=0.0)
    drifted = AutopilotPosition(
        output.now_ns + jump.get("after_ms", 0) * MS, np.array([915.0, 50.0, 60.0]), np.zeros(3)
    )
    autopilot.position = drifted
    output.pose(odom_yaw_rad=0.0, **jump)
    assert ned_m(output.sent[-1]) == pytest.approx((900.0, -50.0, -60.0), abs=1e-3)


def test_in_another_map_the_frame_stays_while_the_autopilots_estimate_is_not_known():
    """Its telemetry is silent."""
    output = Output()
    autopilot = output.pose_sender.autopilot
    autopilot.attitude = AutopilotAttitude(0.0, 0.0, math.radians(60.0), HOST0)
    autopilot.position = AutopilotPosition(HOST0, np.array([900.0, 50.0, 60.0]), np.zeros(3))
    output.pose(odom_yaw_rad=None)
    output.pose(odom_yaw_rad=None, after_ms=3000, map_number=1, resets=1)
    assert ned_m(output.sent[-1]) == pytest.approx((900.0, -50.0, -60.0), abs=1e-3)
    assert yaw_ned_rad(output.sent[-1]) == pytest.approx(math.radians(60.0), abs=1e-6)
    autopilot.attitude = AutopilotAttitude(0.0, 0.0, math.radians(60.0), output.now_ns)
    autopilot.position = AutopilotPosition(output.now_ns, np.array([800.0, 50.0, 60.0]), np.zeros(3))
    output.pose(odom_yaw_rad=None, map_number=1, resets=1)
    assert ned_m(output.sent[-1]) == pytest.approx((800.0, -50.0, -60.0), abs=1e-3)
    assert output.counters == [0, 1, 2]


def test_an_echo_of_the_poses_does_not_move_their_frame():
    """Without GPS the autopilot's first position is grd's, 0.3 s late."""
    output = Output()
    output.pose(odom_yaw_rad=0.0)
    output.pose_sender.autopilot.position = AutopilotPosition(output.now_ns, np.array([99.5, 2.0, 10.0]), np.zeros(3))
    output.pose(odom_yaw_rad=0.0)
    assert ned_m(output.sent[-1]) == pytest.approx((101.0, -2.0, -10.0), abs=1e-3)
    assert output.counters == [0, 0]
    assert output.pose_sender.frame is not None
    assert output.pose_sender.frame.anchored


def test_a_pose_that_was_not_sent_does_not_move_the_frame():
    output = Output()
    autopilot = output.pose_sender.autopilot
    autopilot.attitude = AutopilotAttitude(0.0, 0.0, 0.0, HOST0)
    autopilot.position = AutopilotPosition(HOST0, np.array([900.0, 50.0, 60.0]), np.zeros(3))
    output.pose(odom_yaw_rad=None)
    output.pose(odom_yaw_rad=None, map_number=1, xyz_map_m=np.array([151.0, 2.0, 10.0]), sent=False)
    output.pose(odom_yaw_rad=None)
    assert ned_m(output.sent[-1]) == pytest.approx((900.0, -50.0, -60.0), abs=1e-3)


def test_axes_without_yaw_that_are_learnt_again_turn_about_the_drone():
    output = Output(yaw="none")
    output.pose_sender.autopilot.attitude = AutopilotAttitude(0.0, 0.0, 0.0, HOST0)
    output.pose(odom_yaw_rad=0.0)
    output.pose(odom_yaw_rad=math.radians(3.0), resets=1)
    assert ned_m(output.sent[-1]) == pytest.approx((101.0, -2.0, -10.0), abs=1e-3)
    output.pose(odom_yaw_rad=math.radians(3.0), resets=1, xyz_map_m=np.array([102.0, 2.0, 10.0]))
    expected = 101.0 + math.cos(math.radians(3.0)), -2.0 + math.sin(math.radians(3.0)), -10.0
    assert ned_m(output.sent[-1]) == pytest.approx(expected, abs=1e-3)


def test_a_position_that_moves_is_taken_at_the_time_of_the_pose_unless_it_is_old():
    for age_s, x_m in ((0.5, 902.5), (1.5, 101.0)):
        output = Output()
        stamp_ns = HOST0 + 20 * MS - round(1e9 * age_s)
        velocity_mps = np.array([5.0, 0.0, 0.0])
        output.pose_sender.autopilot.position = AutopilotPosition(stamp_ns, np.array([900.0, 0.0, 0.0]), velocity_mps)
        output.pose(odom_yaw_rad=0.0)
        assert output.sent[0].x == pytest.approx(x_m, abs=1e-3)


@pytest.mark.parametrize("age_s", [None, 5.0])
def test_without_a_recent_attitude_the_axes_are_those_of_map(age_s: float | None):
    output = Output()
    if age_s is not None:
        attitude = AutopilotAttitude(0.0, 0.0, math.radians(60.0), HOST0 - round(1e9 * age_s))
        output.pose_sender.autopilot.attitude = attitude
    output.pose(odom_yaw_rad=None)
    assert (output.sent[0].x, output.sent[0].y) == (101.0, -2.0)
    assert yaw_ned_rad(output.sent[0]) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("jump", [{"resets": 1}, {"resets": 256}, {"track_id": 2}])
def test_any_jump_of_the_pose_changes_the_counter_once(jump: Any):
    output = Output(reset_counter=255)
    output.pose()
    for _ in range(5):
        output.pose(**jump)
    assert output.counters == [255, 0, 0, 0, 0, 0]


@pytest.mark.parametrize(("gap_ms", "counters"), [(290, [0, 0]), (310, [0, 1])])
def test_a_gap_that_the_autopilot_notices_changes_the_counter(gap_ms: int, counters: list[int]):
    output = Output()
    output.pose()
    output.pose(after_ms=gap_ms)
    assert output.counters == counters


def test_a_gap_of_rejected_poses_changes_the_counter():
    output = Output()
    output.pose()
    for _ in range(20):
        assert output.pose(state=PoseState.AMBIGUOUS) == 0
    output.pose()
    assert output.counters == [0, 1]


def test_poses_that_could_not_be_sent_are_a_gap_and_count_once():
    output = Output()
    output.pose()
    for _ in range(300):
        output.pose(sent=False)
    output.pose()
    output.pose()
    assert output.counters == [0, 1, 1]


def test_a_jump_during_a_gap_is_one_change():
    output = Output()
    output.pose()
    output.pose(after_ms=2000, resets=3, track_id=4)
    assert output.counters == [0, 1]


def test_a_pose_that_is_not_newer_is_not_sent_and_stops_nothing():
    output = Output()
    output.pose()
    assert output.pose(after_ms=0) == 0
    assert output.pose_sender.sending


def test_stopping_and_resuming_is_reported():
    output = Output()
    for _ in range(300):
        output.pose()
    for _ in range(300):
        output.pose(state=PoseState.AMBIGUOUS, reason="street and side street are similar; 3 of 4")
    for _ in range(300):
        output.pose()
    severities = {text: severity for severity, text in output.texts}
    assert severities["grd: STOPPED: ambiguous rotation"] == 2  # critical
    assert severities["grd: sending poses"] == 5
    assert severities["grd: AMBIGUOUS: street and side street are similar"] == 4
    texts = [text for _, text in output.texts]
    assert texts.index("grd: STOPPED: ambiguous rotation") < texts.index(
        "grd: AMBIGUOUS: street and side street are similar"
    )
    assert output.pose_sender.sending


def test_missing_poses_are_noticed_without_a_pose():
    output = Output()
    for _ in range(60):
        output.pose()
    output.wait(4000)
    assert (2, "grd: STOPPED: no poses sent") in output.texts
    assert not output.pose_sender.sending


def test_flapping_states_send_no_text_of_their_own_and_the_last_state_is_reported():
    output = Output()
    for i in range(1500):  # 30 s
        output.pose(state=PoseState.FULL if i % 2 else PoseState.LOST)
    assert output.texts == []
    for _ in range(300):
        output.pose()
    assert [text for _, text in output.texts] == ["grd: sending poses", "grd: FULL: lidar and both cameras"]


def test_at_most_one_text_in_two_seconds_is_sent():
    output, times_ns = Output(), []
    for i in range(3000):  # 60 s, a change each 1.2 s
        before = len(output.texts)
        output.pose(state=PoseState.FULL if i // 60 % 2 else PoseState.LOST)
        times_ns += [output.now_ns] * (len(output.texts) - before)
    assert len(times_ns) > 10
    assert min(b - a for a, b in itertools.pairwise(times_ns)) >= 2_000 * MS


def test_a_text_that_could_not_be_sent_is_kept_unless_a_newer_one_replaces_it():
    output = Output()
    for _ in range(300):
        output.pose()
    pose_sender, now_ns = output.pose_sender, output.now_ns + 600 * MS
    (first,) = pose_sender.due_texts(now_ns)
    assert first.text == "grd: STOPPED: no poses sent"
    pose_sender.texts.on_not_sent()
    (repeated,) = pose_sender.due_texts(now_ns + MS)  # immediately
    assert repeated.text == first.text


def test_without_messages_nothing_is_sent_or_stopped():
    pose_sender = PoseSender((), PoseLimits(), yaw="measured")
    assert pose_sender.messages(good_pose(), HOST0) == []
    assert not pose_sender.sending
    texts = [m.text for i in range(40) for m in pose_sender.due_texts(HOST0 + 100 * i * MS)]
    assert texts == ["grd: FULL: lidar and both cameras"]


@pytest.mark.parametrize("reason", RejectReason)
def test_each_reason_for_stopping_fits_the_field(reason: RejectReason):
    assert fitted(f"STOPPED: {reason.value}") == f"grd: STOPPED: {reason.value}".encode()


@pytest.mark.parametrize(
    ("text", "sent"),
    [
        ("Straße", b"grd: Stra?e"),
        ("x" * 60, b"grd: " + b"x" * 45),
        ("a " * 40, b"grd:" + b" a" * 23),
        ("x" * 45 + " y", b"grd: " + b"x" * 45),
        ("x" * 20 + " " + "y" * 40, b"grd: " + b"x" * 20),
    ],
)
def test_a_text_ends_at_a_word_within_its_field(text: str, sent: bytes):
    assert fitted(text) == sent
    assert len(sent) <= TEXT_BYTES


@pytest.mark.parametrize(("yaw", "severity"), [("none", 6), ("measured", 4)])
def test_a_position_alone_is_a_warning_only_if_poses_with_yaw_are_sent(yaw: YawOutput, severity: int):
    pose_sender = PoseSender(("odometry",), PoseLimits(), yaw=yaw)
    for i in range(75):
        pose = dataclasses.replace(good_pose(HOST0 + 20 * i * MS), state=PoseState.POSITION_ONLY, reason="by LiDAR")
        pose_sender.messages(pose, HOST0 + 20 * i * MS)
    (text,) = pose_sender.due_texts(HOST0 + 1500 * MS)
    assert (text.severity, text.text) == (severity, "grd: POSITION_ONLY: by LiDAR")


@pytest.mark.parametrize(("max_pose_hz", "every_ms"), [(None, 20), (50.0, 20), (25.0, 40), (20.0, 60), (10.0, 100)])
def test_a_lower_rate_of_poses_sends_fewer_but_a_jump_at_once(max_pose_hz: float | None, every_ms: int):
    sender = PoseSender(("odometry",), PoseLimits(), yaw="measured", max_pose_hz=max_pose_hz)
    sent_ms: list[int] = []
    for ms in range(0, 2000, 20):
        now_ns = HOST0 + ms * MS
        pose = dataclasses.replace(good_pose(now_ns), resets=int(ms >= 1020))
        messages = sender.messages(pose, now_ns)
        if messages:
            sender.on_sent(pose, now_ns, messages)
            sent_ms.append(ms)
    before = [ms for ms in sent_ms if ms < 1020]
    assert before == list(range(0, 1020, every_ms))
    assert 1020 in sent_ms
    assert not sender.rejected


def test_a_bad_pose_ends_the_stream_at_once_at_any_rate():
    sender = PoseSender(("odometry",), PoseLimits(), yaw="measured", max_pose_hz=10.0)
    sender.on_sent(good_pose(HOST0), HOST0, sender.messages(good_pose(HOST0), HOST0))
    now_ns = HOST0 + 20 * MS
    assert sender.messages(dataclasses.replace(good_pose(now_ns), state=PoseState.LOST), now_ns) == []
    assert not sender.sending
