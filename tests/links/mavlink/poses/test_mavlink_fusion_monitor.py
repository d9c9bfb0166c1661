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

    def fly(self, seconds: float, ratio: float, message: Any = report) -> int:
        """Number of poses sent."""
        sent = 0
        for i in range(round(50 * seconds)):
            self.now_ns += 20 * MS
            if i % 10 == 0:
                self.sender.on_estimator_status(message(ratio), self.now_ns)
            pose = good_pose(self.now_ns)
            messages = self.sender.messages(pose, self.now_ns)
            if messages:
                self.sender.on_sent(pose, self.now_ns, messages)
            self.counters += [m.reset_counter for m in messages]
            self.texts += [m.text for m in self.sender.due_texts(self.now_ns)]
            sent += len(messages)
        return sent


@pytest.mark.parametrize("message", [report, estimator_status])
def test_a_rejected_pose_ends_the_stream_until_the_ratio_is_small_again(message: Any):
    flight = Flight()
    assert flight.fly(2.0, 0.3, message) == 100
    assert 30 <= flight.fly(2.0, 1.4, message) <= 40
    assert flight.sender.rejected[RejectReason.REJECTED_BY_AUTOPILOT] >= 60
    assert flight.fly(2.0, 0.8, message) == 0  # not small
    assert flight.fly(2.9, 0.3, message) == 0
    assert flight.fly(2.0, 0.3, message) > 80
    assert flight.counters[-1] == flight.counters[0] + 1  # the gap
    assert "grd: STOPPED: autopilot rejects the position" in flight.texts
    assert "grd: autopilot rejects the position (1.4)" in flight.texts


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


def test_a_ratio_during_a_gps_glitch_is_not_that_of_the_pose():
    flight = Flight()
    assert flight.fly(3.0, 1.4, gps_glitch) == 150
    assert flight.fly(3.0, 1.4, estimator_status) < 50


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
