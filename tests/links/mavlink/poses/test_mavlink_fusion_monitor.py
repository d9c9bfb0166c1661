"""The autopilot's EKF rejects the pose: it is reported, and ends or resets the stream."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink.poses.fusion_monitor import MAX_RESETS, FusionMonitor
from links.mavlink.poses.gate import PoseLimits, RejectReason
from links.mavlink.poses.pose_sender import PoseSender
from tests.links.mavlink.mavlink_poses import HOST0, MS, good_pose

mavlink: Any = ardupilotmega


def report(ratio: float) -> Any:
    return mavlink.MAVLink_ekf_status_report_message(0, 0.1, ratio, 0.1, 0.1, 0.0)


def report_of_yaw(ratio: float) -> Any:
    return mavlink.MAVLink_ekf_status_report_message(0, 0.1, 0.2, 0.1, ratio, 0.0)


def ardupilot_gps_glitch(ratio: float) -> Any:
    return mavlink.MAVLink_ekf_status_report_message(mavlink.EKF_GPS_GLITCHING, 0.1, ratio, 0.1, 0.1, 0.0)


def estimator_status(ratio: float, flags: int = 0) -> Any:
    return mavlink.MAVLink_estimator_status_message(0, flags, 0.1, ratio, 0.1, 0.1, 0.0, 0.0, 0.1, 0.1)


def gps_glitch(ratio: float) -> Any:
    return estimator_status(ratio, mavlink.ESTIMATOR_GPS_GLITCH)


class Flight:
    """Poses at 50 Hz, and a status five times a second."""

    def __init__(self, on_rejection: Any = "stop") -> None:
        self.sender = PoseSender(("odometry",), PoseLimits(), yaw="measured", on_rejection=on_rejection)
        self.now_ns = HOST0
        self.counters: list[int] = []
        self.texts: list[str] = []
        self.uses_grd: bool | None = None

    def fly(self, seconds: float, ratio: float, message: Any = report) -> int:
        """Number of poses sent."""
        sent = 0
        for i in range(round(50 * seconds)):
            self.now_ns += 20 * MS
            if i % 10 == 0:
                self.sender.on_estimator_status(message(ratio), self.now_ns, self.uses_grd)
            pose = good_pose(self.now_ns)
            messages = self.sender.messages(pose, self.now_ns)
            if messages:
                self.sender.on_sent(pose, self.now_ns, messages)
            self.counters += [m.reset_counter for m in messages]
            self.texts += [m.text for m in self.sender.due_texts(self.now_ns)]
            sent += len(messages)
        return sent


@pytest.mark.parametrize(("message", "uses_grd", "not_small"), [(report, True, 0.8), (estimator_status, None, 1.1)])
def test_a_rejected_pose_ends_the_stream_until_the_ratio_is_small_again(
    message: Any, uses_grd: bool | None, not_small: float
):
    flight = Flight()
    flight.uses_grd = uses_grd
    assert flight.fly(2.0, 0.3, message) == 100
    assert 30 <= flight.fly(2.0, 1.4, message) <= 40
    assert flight.sender.rejected[RejectReason.REJECTED_BY_AUTOPILOT] >= 60
    assert flight.fly(2.0, not_small, message) == 0
    assert flight.fly(2.9, 0.3, message) == 0
    assert flight.fly(2.0, 0.3, message) > 80
    assert flight.counters[-1] == flight.counters[0] + 1  # the gap
    assert "grd: STOPPED: autopilot rejects the pose" in flight.texts
    assert "grd: autopilot rejects the position (1.4)" in flight.texts


def test_the_ratio_of_another_source_set_is_not_that_of_the_pose():
    """ArduPilot flies on GPS, which it rejects next to buildings."""
    flight = Flight()
    flight.uses_grd = False
    assert flight.fly(5.0, 1.4) == 250
    assert flight.sender.fusion.rejections == 0


def test_poses_are_sent_again_after_the_change_to_another_set():
    flight = Flight()
    flight.uses_grd = True
    assert flight.fly(2.0, 1.4) < 50
    flight.uses_grd = False
    assert flight.fly(2.9, 1.4) == 0
    assert flight.fly(2.0, 1.4) > 80


def test_of_an_unknown_set_a_ratio_below_the_gate_is_enough():
    """The drone flies on GPS, whose ratio stays high near buildings."""
    flight = Flight()
    assert flight.fly(2.0, 1.4) < 50
    assert flight.fly(2.9, 0.8) == 0
    assert flight.fly(2.0, 0.8) > 80


@pytest.mark.parametrize("on_rejection", ["stop", "reset"])
def test_a_rejected_yaw_ends_the_stream(on_rejection: Any):
    """ArduPilot fuses no other yaw for the rest of the flight, also after a reset of the position."""
    flight = Flight(on_rejection)
    flight.uses_grd = True
    assert flight.fly(2.0, 0.3, report_of_yaw) == 100
    assert 30 <= flight.fly(2.0, 1.4, report_of_yaw) <= 40
    flight.fly(2.0, 1.4, report_of_yaw)
    assert "grd: autopilot rejects the yaw (1.4)" in flight.texts


def test_the_ratio_that_the_compass_had_at_the_switch_is_not_that_of_the_yaw():
    flight = Flight()
    assert flight.fly(1.0, 1.3, report_of_yaw) == 50
    flight.uses_grd = True
    assert flight.fly(3.0, 1.3, report_of_yaw) == 150  # kept since then
    assert flight.fly(2.0, 1.5, report_of_yaw) < 50


def test_a_glitch_interrupts_the_time_of_small_ratios():
    flight = Flight()
    assert flight.fly(2.0, 1.4) < 50
    assert flight.fly(1.4, 0.3) == 0
    assert flight.fly(1.6, 2.0, ardupilot_gps_glitch) == 0
    assert flight.fly(1.4, 0.3) == 0


def test_stopped_is_sent_three_times_also_when_poses_come_back_for_a_moment():
    sender = PoseSender(("odometry",), PoseLimits(), yaw="measured")
    texts: list[str] = []
    for step in range(1000):
        now_ns = HOST0 + step * 20 * MS
        pose = good_pose(now_ns)
        if step < 300 or 320 <= step < 335:
            sender.on_sent(pose, now_ns, sender.messages(pose, now_ns))
        texts += [m.text for m in sender.due_texts(now_ns)]
    assert texts.count("grd: STOPPED: no poses sent") == 3


def test_a_rejected_compass_is_not_that_of_a_position_without_yaw():
    flight = Flight()
    flight.sender = PoseSender(("vision_position_estimate",), PoseLimits(), yaw="none")
    assert flight.sender.fusion.add(report_of_yaw(0.1), True, HOST0, True, flight.sender.sends_yaw) is None
    for k in range(20):
        now_ns = HOST0 + 200 * k * MS
        assert flight.sender.fusion.add(report_of_yaw(3.0), True, now_ns, True, flight.sender.sends_yaw) is None


def test_a_short_rejection_ends_nothing():
    flight = Flight()
    for _ in range(10):
        assert flight.fly(0.4, 1.4) == 20
        assert flight.fly(0.4, 0.3) == 20
    assert flight.sender.fusion.rejections == 0


def test_a_reset_changes_the_counter_and_after_some_the_stream_ends():
    flight = Flight("reset")
    flight.fly(1.0, 0.3)
    assert flight.fly(0.8, 1.4) == 40
    assert flight.counters[-1] == flight.counters[0] + 1
    assert flight.fly(20.0, 1.4) < 500
    assert flight.counters[-1] == flight.counters[0] + MAX_RESETS
    assert flight.sender.fusion.stopped


def test_with_report_only_a_text_is_sent():
    flight = Flight("report")
    assert flight.fly(10.0, 1.4) == 500
    assert flight.sender.fusion.rejections > 5
    assert "grd: autopilot rejects the position (1.4)" in flight.texts


def test_a_high_ratio_without_poses_is_none_of_ours():
    monitor = FusionMonitor("stop")
    assert all(monitor.add(report(3.0), False, HOST0 + 200 * i * MS) is None for i in range(50))
    assert not monitor.stopped


def test_a_boot_ends_the_stop():
    flight = Flight()
    flight.fly(1.0, 0.3)
    flight.fly(2.0, 1.4)
    assert flight.sender.fusion.stopped
    flight.sender.on_boot()
    assert flight.fly(0.2, 0.3) == 10


def test_px4_that_fuses_nothing_any_more_receives_poses_again():
    """Without GPS its ratio is NaN as soon as poses have ended."""
    flight = Flight()
    assert flight.fly(2.0, 1.4, estimator_status) < 50
    assert flight.fly(2.9, math.nan, estimator_status) == 0
    assert flight.fly(2.0, math.nan, estimator_status) > 80
    assert flight.fly(2.0, 0.2, estimator_status) == 100


@pytest.mark.parametrize(("glitch", "status"), [(gps_glitch, estimator_status), (ardupilot_gps_glitch, report)])
def test_a_ratio_during_a_gps_glitch_is_not_that_of_the_pose(glitch: Any, status: Any):
    flight = Flight()
    assert flight.fly(3.0, 1.4, glitch) == 150
    assert flight.fly(3.0, 1.4, status) < 50


def test_after_a_stop_a_small_ratio_counts_whatever_the_flag_says():
    flight = Flight()
    assert flight.fly(2.0, 1.4, estimator_status) < 50
    assert flight.fly(2.9, 0.1, gps_glitch) == 0
    assert flight.fly(2.0, 0.1, gps_glitch) > 80


def test_an_infinite_ratio_is_a_rejection():
    flight = Flight()
    assert flight.fly(2.0, math.inf, estimator_status) < 50
    assert flight.fly(5.0, math.inf, estimator_status) == 0


def test_a_ratio_that_is_interrupted_by_that_of_gps_is_no_rejection():
    flight = Flight()
    for _ in range(5):
        assert flight.fly(0.4, 1.4, estimator_status) == 20
        assert flight.fly(0.2, 1.4, gps_glitch) == 10
