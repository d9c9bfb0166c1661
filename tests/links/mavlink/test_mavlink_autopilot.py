"""MAVLink frames to messages: fields by hand, sequence, foreign and damaged frames, the log of a real flight."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import Record
from flow.message import check_arrays
from flow.stage import output_ports
from links.importing import import_file
from links.mavlink import Autopilot
from links.mavlink.readers import read_raw_imu
from links.recording import RecordingReader
from links.simulated.autopilot.flight_stack.telemetry import imu_counts
from stages.messages import (
    AutopilotEstimator,
    AutopilotStatus,
    DroneAttitude,
    DroneImu,
    DroneLocalPosition,
    DroneOdometry,
)

mavlink: Any = ardupilotmega
SHARED = Path(__file__).resolve().parents[4] / "shared" / "data" / "mavlink"
HOST0, MS = 1_748_773_230_000_000_000, 1_000_000
UPPER = [0.0] * 21


class Sender:
    """Packs messages as one system would, numbered."""

    def __init__(self, system: int = 1, component: int = 1, v1: bool = False) -> None:
        self._mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self._v1 = v1

    def frame(self, message: Any) -> bytes:
        data = bytes(message.pack(self._mav, force_mavlink1=self._v1))
        self._mav.seq = (self._mav.seq + 1) % 256
        return data

    def attitude(self, boot_ms: int, roll: float = 0.1, pitch: float = 0.2, yaw: float = 0.3) -> bytes:
        return self.frame(mavlink.MAVLink_attitude_message(boot_ms, roll, pitch, yaw, 1.0, 2.0, 3.0))


def record(data: bytes, at_ms: float = 0.0) -> Record:
    at_ns = HOST0 + round(at_ms * MS)
    return Record("/autopilot/rx", arrival_ns=at_ns, stamp_ns=at_ns, data=data)


def odometry(
    q: Any = (1, 0, 0, 0), frame: int = 20, child: int = 12, x: float = 1.0, upper: Any = UPPER, quality: int = 80
):
    moving = (4.0, 5.0, 6.0, 0.1, 0.2, 0.3)
    return mavlink.MAVLink_odometry_message(
        7_000_123, frame, child, x, 2.0, 3.0, list(q), *moving, list(upper), UPPER, 9, 0, quality
    )


def test_the_outputs_are_the_messages_of_an_autopilot_its_cues_and_the_state_of_an_earlier_run():
    assert set(output_ports(Autopilot)) == {
        "drone_attitude",
        "drone_local_position",
        "drone_odometry",
        "drone_imu",
        "autopilot_status",
        "autopilot_estimator",
        "earlier_odom_frame",
        "drone_gnss",
        "drone_global_position",
        "uwb_range",
    }


@pytest.mark.parametrize("v1", [False, True])
def test_attitude_and_position_are_converted_to_grds_axes(v1: bool):
    sender, link = Sender(v1=v1), Autopilot()
    attitude = link.decode(record(sender.attitude(7000, 0.0, 0.0, math.pi / 2)))
    assert isinstance(attitude, DroneAttitude)
    check_arrays(attitude)
    np.testing.assert_allclose(attitude.R_odom_drone @ [1, 0, 0], [0, -1, 0], atol=1e-6)
    np.testing.assert_allclose(attitude.angular_velocity_drone_radps, [1, -2, -3])
    moved = mavlink.MAVLink_local_position_ned_message(7001, 1.0, 2.0, -3.0, 4.0, 5.0, -6.0)
    position = link.decode(record(sender.frame(moved), 1.0))
    assert isinstance(position, DroneLocalPosition)
    check_arrays(position)
    np.testing.assert_allclose(position.xyz_odom_m, [1, -2, 3])
    np.testing.assert_allclose(position.velocity_odom_mps, [4, -5, 6])


def test_odometry_has_the_velocity_in_the_body_and_rotation_first_in_its_covariance():
    upper = [1.0, 0, 0, 0, 0, 0, 2.0, 0, 0, 0, 0, 3.0, 0, 0, 0, 4.0, 0, 0, 5.0, 0, 6.0]
    message = Autopilot().decode(record(Sender().frame(odometry(upper=upper))))
    assert isinstance(message, DroneOdometry)
    check_arrays(message)
    np.testing.assert_allclose(message.xyz_odom_m, [1, -2, -3])
    np.testing.assert_allclose(message.velocity_drone_mps, [4, -5, -6])
    np.testing.assert_allclose(message.angular_velocity_drone_radps, [0.1, -0.2, -0.3], rtol=1e-6)
    np.testing.assert_allclose(message.R_odom_drone, np.eye(3), atol=1e-12)
    assert message.pose_covariance is not None
    np.testing.assert_allclose(np.diagonal(message.pose_covariance), [4, 5, 6, 1, 2, 3])
    assert (message.reset_counter, message.quality_percent) == (9, 80)


def test_the_odometry_of_px4_has_its_velocity_in_ned():
    """It faces east: 4 m/s north are to its left."""
    q = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
    message = Autopilot().decode(record(Sender().frame(odometry(q=q, frame=1, child=1))))
    assert isinstance(message, DroneOdometry)
    check_arrays(message)
    np.testing.assert_allclose(message.velocity_drone_mps, [5, 4, -6], atol=1e-6)
    np.testing.assert_allclose(message.angular_velocity_drone_radps, [0.1, -0.2, -0.3], rtol=1e-6)
    assert message.velocity_covariance is None


def test_an_odometry_without_covariance_or_quality_has_none():
    message = Autopilot().decode(record(Sender().frame(odometry(upper=[math.nan] * 21, quality=0))))
    assert isinstance(message, DroneOdometry)
    assert (message.pose_covariance, message.quality_percent) == (None, None)
    failed = Autopilot().decode(record(Sender().frame(odometry(quality=-1))))
    assert isinstance(failed, DroneOdometry)
    assert failed.quality_percent == 0


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (odometry(frame=0), "odometry in other frames"),
        (odometry(child=1), "odometry in other frames"),
        (odometry(q=(0, 0, 0, 0)), "invalid rotation"),
        (odometry(q=(math.nan, 0, 0, 0)), "invalid rotation"),
        (odometry(x=math.inf), "not finite"),
        (mavlink.MAVLink_attitude_message(1, math.nan, 0, 0, 0, 0, 0), "not finite"),
        (mavlink.MAVLink_local_position_ned_message(1, 0, 0, 0, 0, math.inf, 0), "not finite"),
    ],
)
def test_invalid_messages_are_counted_by_reason(message: Any, reason: str):
    link = Autopilot()
    assert link.decode(record(Sender().frame(message))) is None
    assert link.counters[f"rejected: {reason}"] == 1


def test_both_imus_are_si_in_drone_axes_and_gravity_is_measured_upwards():
    raw = mavlink.MAVLink_raw_imu_message(7_000_000, 100, 200, -1000, 10, 20, 30, 0, 0, 0)
    highres = mavlink.MAVLink_highres_imu_message(
        7_000_000, 0.980665, 1.96133, -9.80665, 0.01, 0.02, 0.03, 0, 0, 0, math.nan, 0, 0, 0, 63
    )
    for message, half in ((raw, 0.0005), (highres, 0.0)):  # the counts of RAW_IMU are truncated
        imu = Autopilot().decode(record(Sender().frame(message)))
        assert isinstance(imu, DroneImu)
        check_arrays(imu)
        acceleration = 9.80665 * np.array([0.1 + half, -0.2 - half, 1.0 + half])
        np.testing.assert_allclose(imu.acceleration_drone_mps2, acceleration, rtol=1e-6)
        turn = [0.01 + half, -0.02 - half, -0.03 - half]
        np.testing.assert_allclose(imu.angular_velocity_drone_radps, turn, rtol=1e-6)


@pytest.mark.parametrize("rate_radps", [0.0, 0.0007, -0.0042, 0.031])
def test_the_mean_of_truncated_counts_is_that_of_the_rate(rate_radps: float):
    """With a noise of 5 mrad/s. As they are, counts of a slow rate have 8 % less than it."""
    rates = np.random.default_rng(1).normal(rate_radps, 5e-3, 40_000)
    counts = [imu_counts(np.array([rate, 0.0, 0.0, 0.0, 0.0, 9.81]))[3] for rate in rates.tolist()]
    zeros = [0] * 5
    frames = {n: mavlink.MAVLink_raw_imu_message(1, 0, 0, -1000, n, *zeros) for n in set(counts)}
    read = {n: read_raw_imu(frame, 0).angular_velocity_drone_radps[0] for n, frame in frames.items()}
    assert np.mean([read[n] for n in counts]) == pytest.approx(np.mean(rates), abs=2e-5)


def test_the_magnetic_field_is_in_microtesla_and_drone_axes():
    raw = mavlink.MAVLink_raw_imu_message(7_000_000, 0, 0, -1000, 0, 0, 0, 240, 100, -416)  # mgauss
    imu = Autopilot().decode(record(Sender().frame(raw)))
    assert isinstance(imu, DroneImu)
    np.testing.assert_allclose(imu.magnetic_field_drone_ut, [24.0, -10.0, 41.6], rtol=1e-6)


def test_a_field_of_zero_is_none_and_that_of_highres_imu_is_not_read():
    """PX4 subtracts a bias that its filter fits to its yaw, which may be ours."""
    raw = mavlink.MAVLink_raw_imu_message(7_000_000, 0, 0, -1000, 0, 0, 0, 0, 0, 0)
    field = [0.24, 0.1, -0.416]
    highres = mavlink.MAVLink_highres_imu_message(7_000_000, 0, 0, -9.8, 0, 0, 0, *field, 0, 0, 0, 0, 0b111_111_111)
    for message in (raw, highres):
        imu = Autopilot().decode(record(Sender().frame(message)))
        assert isinstance(imu, DroneImu)
        assert imu.magnetic_field_drone_ut is None


def imu_frames(sender: Any, at_ms: int) -> tuple[bytes, bytes]:
    raw = mavlink.MAVLink_raw_imu_message(1000 * at_ms, 0, 0, -1000, 0, 0, 0, 0, 0, 0)
    scaled = mavlink.MAVLink_scaled_imu_message(at_ms, 0, 0, -1000, 0, 0, 0, 0, 0, 0)
    return sender.frame(raw), sender.frame(scaled)


def test_scaled_imu_is_used_only_while_raw_imu_does_not_arrive():
    sender, link = Sender(), Autopilot()
    raw, scaled = imu_frames(sender, 7000)
    assert isinstance(link.decode(record(raw, 0)), DroneImu)
    assert link.decode(record(scaled, 1)) is None
    late = sender.frame(mavlink.MAVLink_scaled_imu_message(9500, 0, 0, -1000, 0, 0, 0, 0, 0, 0))
    assert isinstance(link.decode(record(late, 2500)), DroneImu)
    only = Autopilot()
    assert isinstance(only.decode(record(imu_frames(Sender(), 7000)[1], 0)), DroneImu)


def test_the_stamp_of_an_imu_message_is_earlier_by_the_delay_of_its_values():
    sender, link = Sender(), Autopilot()
    attitude = link.decode(record(sender.attitude(7000, 0.0, 0.0, 0.0), 0))
    imu = link.decode(record(imu_frames(sender, 7010)[0], 10))
    assert isinstance(attitude, DroneAttitude)
    assert isinstance(imu, DroneImu)
    assert imu.stamp_ns - attitude.stamp_ns == pytest.approx((10 - 12.5) * MS, abs=0.6 * MS)


@pytest.mark.parametrize("minutes", [10, 40, 67, 100])
def test_after_a_reboot_all_messages_are_used_again_whatever_the_time_since_the_boot_before(minutes: int):
    """RAW_IMU is the first to arrive: it alone resets the clock."""
    sender, link = Sender(), Autopilot()
    for at_ms in range(0, 2000, 20):
        assert link.decode(record(imu_frames(sender, minutes * 60_000 + at_ms)[0], at_ms)) is not None
    for at_ms in range(8000, 10_000, 20):
        imu = link.decode(record(imu_frames(sender, at_ms - 3000)[0], at_ms))
        if at_ms >= 8200:
            assert imu is not None
            assert link.decode(record(sender.attitude(at_ms - 3000, 0.0, 0.0, 0.0), at_ms)) is not None
    assert link.counters["clock restarts"] == 1


@pytest.mark.parametrize(("mode", "state", "armed", "failsafe"), [(128 + 1, 4, True, False), (1, 5, False, True)])
def test_a_heartbeat_gives_armed_mode_and_failsafe(mode: int, state: int, armed: bool, failsafe: bool):
    status = Autopilot().decode(record(Sender().frame(mavlink.MAVLink_heartbeat_message(2, 3, mode, 5, state, 3))))
    assert isinstance(status, AutopilotStatus)
    assert (status.armed, status.custom_mode, status.failsafe) == (armed, 5, failsafe)
    assert (status.clock_offset_ns, status.clock_uncertainty_ns) == (None, None)


def test_both_estimator_reports_give_the_fused_states():
    flags = 1 | 2 | 4 | 8 | 32
    ardupilot = mavlink.MAVLink_ekf_status_report_message(flags, 0.1, 0.2, 0.3, 0.4, 0.0, 0.0)
    px4 = mavlink.MAVLink_estimator_status_message(7_000_000, flags, 0.1, 0.2, 0.3, 0.4, 0, 0, 1.0, 1.0)
    for message in (ardupilot, px4):
        report = Autopilot().decode(record(Sender().frame(message)))
        assert isinstance(report, AutopilotEstimator)
        assert (report.stamp_ns, report.flags) == (HOST0, flags)
        assert (report.attitude_good, report.velocity_good, report.position_good, report.height_good) == (True,) * 4
        assert not report.constant_position
        ratios = [report.velocity_ratio, report.horizontal_ratio, report.height_ratio, report.compass_ratio]
        np.testing.assert_allclose(ratios, [0.1, 0.2, 0.3, 0.4], rtol=1e-6)


def test_a_position_that_px4_sends_without_aiding_is_rejected():
    """PX4 always sends one; ArduPilot sends none without aiding, and its status has no part in this."""
    sender, link = Sender(), Autopilot()

    def position(at_ms: int) -> Any:
        frame = sender.frame(mavlink.MAVLink_local_position_ned_message(7000 + at_ms, 1, 2, -3, 0, 0, 0))
        return link.decode(record(frame, at_ms))

    def status(at_ms: int, flags: int) -> None:
        message = mavlink.MAVLink_estimator_status_message((7000 + at_ms) * 1000, flags, *[0.1] * 4, 0, 0, 1.0, 1.0)
        assert isinstance(link.decode(record(sender.frame(message), at_ms)), AutopilotEstimator)

    assert isinstance(position(0), DroneLocalPosition)
    status(10, 1 | 4 | 8 | 32)
    assert position(20) is None
    assert link.counters["rejected: position without aiding"] == 1
    assert isinstance(link.decode(record(sender.attitude(7030, 0.0, 0.0, 0.0), 30)), DroneAttitude)
    status(40, 1 | 4 | 8 | 32 | 256)
    assert isinstance(position(50), DroneLocalPosition)
    link.decode(record(sender.frame(mavlink.MAVLink_ekf_status_report_message(1, 0, 0, 0, 0, 0, 0)), 60))
    assert isinstance(position(70), DroneLocalPosition)


@pytest.mark.parametrize(
    ("bit", "lost"),
    [(1, "attitude_good"), (2, "velocity_good"), (4, "velocity_good"), (8, "position_good"), (32, "height_good")],
)
def test_each_flag_of_the_estimator_means_its_own(bit: int, lost: str):
    frame = mavlink.MAVLink_ekf_status_report_message((1 | 2 | 4 | 8 | 32 | 128) & ~bit, math.nan, -1.0, 0, 0, 0, 0)
    report = Autopilot().decode(record(Sender().frame(frame)))
    assert isinstance(report, AutopilotEstimator)
    good = {n: getattr(report, n) for n in ("attitude_good", "velocity_good", "position_good", "height_good")}
    assert good == {name: name != lost for name in good}
    assert report.constant_position
    assert math.isnan(report.velocity_ratio)
    assert math.isnan(report.horizontal_ratio)


def test_a_stamp_in_milliseconds_is_their_middle_and_never_after_arrival():
    sender, link = Sender(), Autopilot(clock_drift_limit_ppm=0.0)
    prompt = link.decode(record(sender.attitude(7000), 10.0))
    late = link.decode(record(sender.attitude(7020), 80.0))
    assert prompt is not None
    assert late is not None
    assert prompt.stamp_ns == HOST0 + 10 * MS
    assert late.stamp_ns == HOST0 + 30 * MS + MS // 2


def test_after_a_long_stall_buffered_messages_are_not_stamped_as_current():
    sender, link = Sender(), Autopilot()
    for i in range(50):
        link.decode(record(sender.attitude(20 * i), 20.0 * i))
    for i in range(50, 400):  # 7 s of messages arrive together
        message = link.decode(record(sender.attitude(20 * i), 8000.0 + 0.1 * i))
        assert message is None or abs(message.stamp_ns - HOST0 - 20 * i * MS) < 10 * MS
    assert link.counters["clock restarts"] == 0
    assert link.decode(record(sender.attitude(8100), 8100.0)) is not None


def timesync_reply(sender: Sender, request_ns: int, tc1_ns: int, target: tuple[int, int] | None) -> bytes:
    """A reply with the target that newer autopilots add: an extension, which our dialect does not know."""
    frame = sender.frame(mavlink.MAVLink_timesync_message(tc1_ns, request_ns))
    if target is None:
        return frame
    payload = frame[10:-2].ljust(16, b"\0") + bytes(target)
    body = bytes([len(payload)]) + frame[2:10] + payload
    crc = mavlink.x25crc(bytearray(body + bytes([mavlink.MAVLink_timesync_message.crc_extra]))).crc
    return frame[:1] + body + crc.to_bytes(2, "little")


@pytest.mark.parametrize(
    ("target", "used"), [(None, 1), ((0, 0), 1), ((1, 197), 1), ((1, 0), 1), ((1, 191), 0), ((255, 190), 0)]
)
def test_a_timesync_reply_for_another_component_is_ignored(target: tuple[int, int] | None, used: int):
    sender, link = Sender(), Autopilot()
    link.decode(record(sender.attitude(7000)))
    reply = timesync_reply(sender, HOST0 + 5 * MS, 7_010 * MS, target)
    assert link.decode(record(reply, 20.0)) is None
    assert link.counters["timesync replies"] == used
    assert link.counters.get("rejected: TIMESYNC for another component", 0) == 1 - used
    assert link.counters["lost"] == 0


def matched(reply: bytes, request_ms: float, at_ms: float) -> Record:
    """A reply to our own request, as the session records it."""
    return Record("/autopilot/rx", HOST0 + round(at_ms * MS), HOST0 + round(request_ms * MS), reply)


def test_after_a_matched_reply_other_replies_are_ignored():
    """One-way delay 50 ms; another requester's clock is 90 ms ahead, so that its reply is plausible."""
    sender, link = Sender(), Autopilot(clock_drift_limit_ppm=0.0)
    heartbeat = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3)

    def offset_and_uncertainty_ms(at_ms: float) -> tuple[float, float]:
        status = link.decode(record(sender.frame(heartbeat), at_ms))
        assert isinstance(status, AutopilotStatus)
        assert status.clock_offset_ns is not None
        assert status.clock_uncertainty_ns is not None
        return (status.clock_offset_ns - HOST0) / MS + 7000, status.clock_uncertainty_ns / MS

    link.decode(record(sender.frame(mavlink.MAVLink_highres_imu_message(7_000_000, *[0.0] * 13, 63)), 50.0))
    link.decode(record(timesync_reply(sender, HOST0 + 40 * MS, 7_000 * MS, None), 50.0))
    assert offset_and_uncertainty_ms(60.0) == (45, 5)  # not yet known to be foreign
    link.decode(matched(timesync_reply(sender, HOST0 + 950 * MS, 8_000 * MS, None), 950.0, 1050.0))
    assert offset_and_uncertainty_ms(1060.0) == (0, 50)
    link.decode(record(timesync_reply(sender, HOST0 + 1040 * MS, 8_000 * MS, (1, 197)), 1050.0))
    assert offset_and_uncertainty_ms(1070.0) == (0, 50)
    assert (link.counters["timesync replies"], link.counters["rejected: TIMESYNC for another component"]) == (2, 1)


def test_a_replay_with_another_id_still_recognises_our_replies():
    sender, link = Sender(), Autopilot(own_component_id=191, own_system_id=7)
    link.decode(record(sender.attitude(7000)))
    link.decode(matched(timesync_reply(sender, HOST0 + 5 * MS, 7_010 * MS, (1, 197)), 5.0, 20.0))
    assert link.counters["timesync replies"] == 1


def test_missing_frames_are_counted_across_the_wrap_of_the_number():
    sender, link = Sender(), Autopilot()
    for i in range(600):
        data = sender.attitude(20 * i)
        if i not in (100, 255, 256, 257, 400):
            link.decode(record(data, 20.0 * i))
    assert link.counters["lost"] == 5
    assert link.counters["decoded"] == 595


def test_a_repeated_or_late_frame_is_rejected_and_a_restarted_sequence_is_not():
    sender, link = Sender(), Autopilot()
    frames = [sender.attitude(20 * i) for i in range(200)]
    for i in (0, 1, 2, 2, 4, 3, *range(5, 200)):
        link.decode(record(frames[i], 20.0 * i))
    assert link.counters["rejected: repeated or late"] == 2
    restarted = Sender()
    kept = [link.decode(record(restarted.attitude(4000 + 20 * i), 4000.0 + 20 * i)) for i in range(3)]
    assert [message is None for message in kept] == [False, False, False]
    assert link.counters["lost"] == 1 + 56  # 3 was missing when 4 came; 199 -> 0 counts as 56 missing
    far = Sender()
    kept = [link.decode(record(far.attitude(5000 + 20 * i), 5000.0 + 20 * i)) for i in range(5)]
    assert [message is None for message in kept] == [True, False, False, False, False]


def test_other_systems_are_ignored_and_do_not_affect_the_sequence():
    ours, radio, link = Sender(), Sender(51, 68), Autopilot()
    for i in range(10):
        link.decode(record(ours.attitude(20 * i), 20.0 * i))
        assert link.decode(record(radio.attitude(9_000_000), 20.0 * i)) is None
    assert link.counters["rejected: from another system"] == 10
    assert (link.counters["lost"], link.counters["clock restarts"], link.counters["decoded"]) == (0, 0, 10)
    other = Autopilot(system_id=51, component_id=68)
    assert isinstance(other.decode(record(radio.attitude(1))), DroneAttitude)


def test_a_message_outside_the_dialect_counts_as_a_frame_and_is_no_loss():
    sender, link = Sender(), Autopilot()
    link.decode(record(sender.attitude(0)))
    private = bytearray(sender.attitude(20))
    private[7:10] = b"\xf0\xff\x00"
    assert link.decode(record(bytes(private), 20.0)) is None
    assert link.decode(record(sender.attitude(40), 40.0)) is not None
    assert (link.counters["rejected: unknown message"], link.counters["lost"]) == (1, 0)


@pytest.mark.parametrize("cut", [0, 1, 7, 8, 20])
def test_a_damaged_frame_does_not_affect_the_others(cut: int):
    sender, link = Sender(), Autopilot()
    whole = [sender.attitude(20 * i) for i in range(3)]
    assert link.decode(record(whole[0])) is not None
    assert link.decode(record(whole[1][:cut], 20.0)) is None
    assert link.decode(record(whole[2], 40.0)) is not None
    assert (link.counters["rejected: damaged"], link.counters["lost"]) == (1, 1)


@given(st.binary(max_size=300))
def test_no_bytes_raise(data: bytes):
    Autopilot().decode(record(data))


SAMPLES = [
    Sender().attitude(7000),
    Sender().frame(odometry()),
    Sender().frame(mavlink.MAVLink_timesync_message(7 * 10**9, HOST0)),
    Sender().frame(mavlink.MAVLink_raw_imu_message(7, 1, 2, 3, 4, 5, 6, 0, 0, 0)),
]


@given(
    st.sampled_from(SAMPLES),
    st.lists(st.tuples(st.integers(0, 279), st.integers(0, 255)), max_size=4),
    st.integers(0, 300),
)
def test_flipped_and_cut_bytes_are_counted_never_raised(frame: bytes, changes: list[tuple[int, int]], length: int):
    data = bytearray(frame)
    for at, value in changes:
        data[at % len(data)] = value
    link = Autopilot()
    link.decode(record(bytes(data[:length])))
    counters = link.counters
    used = counters["decoded"] + counters["unused"] + counters["timesync replies"]
    assert used + sum(counters.rejected.values()) == 1


FLOATS = st.floats(width=32)


@given(
    st.lists(FLOATS, min_size=13, max_size=13), st.lists(FLOATS, min_size=42, max_size=42), st.integers(0, 2**64 - 1)
)
def test_odometry_with_a_correct_checksum_and_any_numbers_is_finite_or_rejected(
    state: list[float], covariances: list[float], time_usec: int
):
    message = mavlink.MAVLink_odometry_message(
        time_usec, 20, 12, *state[:3], state[3:7], *state[7:], covariances[:21], covariances[21:], 0, 0, 0
    )
    decoded = Autopilot().decode(record(Sender().frame(message)))
    if decoded is not None:
        assert isinstance(decoded, DroneOdometry)
        for array in (decoded.xyz_odom_m, decoded.R_odom_drone, decoded.velocity_drone_mps):
            assert np.isfinite(array).all()


@pytest.mark.parametrize(
    ("name", "attitudes", "restarts", "damaged"),
    [
        ("copter_flight_part1.tlog", 2002, 1, 729),
        ("plane_bench_disarmed.tlog", 270, 0, 0),
    ],  # 729: from its ground station
)
def test_a_real_log_decodes_with_increasing_stamps_before_arrival(
    name: str, attitudes: int, restarts: int, damaged: int, tmp_path: Path
):
    if not (SHARED / name).exists():
        pytest.skip("needs ../shared/data/mavlink")
    imported = import_file(SHARED / name, tmp_path / "flight.mcap")
    link, last = Autopilot(), Counter[type]()
    counts: Counter[type] = Counter()
    with RecordingReader(imported.path) as reader:
        for rec in reader.records():
            message = link.decode(rec)
            if message is None:
                continue
            check_arrays(message)
            kind = type(message)
            counts[kind] += 1
            assert last[kind] < message.stamp_ns <= rec.arrival_ns
            last[kind] = message.stamp_ns
    assert link.counters["clock restarts"] == restarts
    assert 0.97 * attitudes < counts[DroneAttitude] <= attitudes
    assert link.counters.get("rejected: damaged", 0) == damaged


def test_the_link_of_a_second_autopilot_has_its_own_topics_and_state_file():
    settings = Autopilot(topic="/autopilot/rx_2", state_file=Path("out/sent.json")).settings
    assert (settings.sent_topic, settings.own_state_file) == ("/autopilot/tx_2", Path("out/sent_2.json"))
    first = Autopilot(state_file=Path("out/sent.json")).settings
    assert (first.sent_topic, first.own_state_file) == ("/autopilot/tx", Path("out/sent.json"))
    with pytest.raises(ValidationError):
        Autopilot(topic="/autopilot")
