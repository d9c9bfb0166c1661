"""Telemetry, message intervals, commands, arming checks, origin and reboot of the simulated autopilot."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from links.mavlink.transport.framing import dialect
from links.simulated.autopilot.flight_stack import streams, telemetry
from links.simulated.autopilot.flight_stack.guidance import root_limited, trapezoid
from links.simulated.autopilot.flight_stack.streams import ACCEPTED, DENIED, FAILED, RAW_IMU, Streams
from links.simulated.kernels.motion import GRAVITY_MPS2
from tests.links.simulated.autopilot.flight_stack.sent_truth import START_NS, Host


def command(number: int, *parameters: float) -> Any:
    values = [*map(float, parameters), *[0.0] * (7 - len(parameters))]
    return dialect().MAVLink_command_long_message(1, 1, number, 0, *values)


def test_raw_imu_holds_integers_in_mg_and_mrad_per_s_of_frd_axes() -> None:
    sample = np.array([0.1, 0.2, -0.3, 1.0, -2.0, GRAVITY_MPS2])
    message = telemetry.raw_imu(5_000_000, sample, np.array([24.0, 10.0, -41.6]))
    assert (message.xmag, message.ymag, message.zmag) == (240, -100, 416)  # mgauss
    assert (message.xgyro, message.ygyro, message.zgyro) == (100, -200, 300)
    assert (message.xacc, message.yacc, message.zacc) == (101, 203, -1000)  # 9.81 m/s^2 over 9.80665, in mg, truncated
    assert message.time_usec == 5000
    assert telemetry.raw_imu(0, sample * 1e4, np.zeros(3)).zacc == -32767


def test_raw_imu_is_stamped_with_its_time_of_sending_at_the_rate_of_its_stream() -> None:
    host = Host(4.0, autopilot={"imu_hz": 50.0, "downlink": {"latency_s": 0.006, "jitter_s": 0.0}})
    host.run(4.0)
    frames = [(arrival, m) for arrival, m in host.frames if m.get_type() == "RAW_IMU"]
    assert len(frames) == pytest.approx(200, abs=3)
    delays = [arrival - START_NS - (1000 * m.time_usec - round(312.25e9)) for arrival, m in frames]
    assert np.mean(delays) == pytest.approx(6e6, abs=6.5e6)  # 18 ppm of 312 s are 5.6 ms


@pytest.mark.parametrize(
    ("kind", "message", "interval_us", "result", "kept_us"),
    [
        ("ardupilot", RAW_IMU, 20_000, ACCEPTED, 20_000),
        ("ardupilot", RAW_IMU, 33_333, ACCEPTED, 33_000),  # truncated to milliseconds
        ("ardupilot", RAW_IMU, 2_000, DENIED, 10_000),  # faster than 80 % of the loop
        ("ardupilot", RAW_IMU, -1, ACCEPTED, -1),
        ("ardupilot", RAW_IMU, 0, ACCEPTED, 10_000),
        ("ardupilot", 12_345, 20_000, FAILED, None),
        ("px4", streams.HIGHRES_IMU, 33_333, ACCEPTED, 33_333),
        ("px4", RAW_IMU, 20_000, DENIED, None),
    ],
)
def test_message_intervals_are_kept_truncated_or_denied(kind, message, interval_us, result, kept_us) -> None:
    made = Streams(kind, {RAW_IMU: 100.0, streams.HIGHRES_IMU: 100.0}, ())
    assert made.set_interval(message, interval_us) == result
    assert made.interval_us(message) == kept_us


def passed(made: Streams, plan_ms: int) -> int:
    """Messages of a plan that are sent in 10 s."""
    return sum(made.passes(RAW_IMU, time_ms * 1_000_000) for time_ms in range(0, 10_000, plan_ms))


def test_a_message_of_a_plan_passes_at_the_requested_rate_truncated_to_milliseconds() -> None:
    made = Streams("ardupilot", {}, ())
    assert passed(made, 10) == 1000
    made.set_interval(RAW_IMU, 40_900)
    assert passed(made, 10) == 250
    made.set_interval(RAW_IMU, -1)
    assert passed(made, 10) == 0
    made.set_interval(RAW_IMU, 0)
    assert passed(made, 10) == 1000
    assert made.set_interval(RAW_IMU, 20_000, third=1.0) == DENIED


def test_a_command_is_acknowledged_and_a_denied_message_stays_as_it_was() -> None:
    host = Host(4.0, autopilot={"imu_hz": 0.0}, denied_intervals=[streams.ATTITUDE])
    host.run(1.0)
    host.send(command(511, RAW_IMU, 20_000))
    host.send(command(511, streams.ATTITUDE, 1_000_000))
    host.run(3.0)
    acks = [(m.command, m.result) for m in host.received("COMMAND_ACK")]
    assert acks == [(511, ACCEPTED), (511, DENIED)]
    assert len(host.received("RAW_IMU")) == pytest.approx(98, abs=4)
    assert len(host.received("ATTITUDE")) == pytest.approx(150, abs=4)


def test_a_source_set_can_be_commanded_and_one_that_does_not_exist_is_denied() -> None:
    host = Host(3.0, plan=[{"do": "hold", "for_s": 60}])
    host.run(2.0)
    host.send(command(42007, 2))
    host.send(command(42007, 3))
    host.run(3.0)
    assert [m.result for m in host.received("COMMAND_ACK")] == [ACCEPTED, DENIED]
    assert host.stack.ekf.primary.active == 1
    assert not any("Source Set" in text for text in host.texts())  # only a selection by the remote control has one


def test_timesync_is_answered_with_the_autopilots_clock() -> None:
    host = Host(1.0)
    host.run(0.5)
    host.send(dialect().MAVLink_timesync_message(0, 77))
    host.run(1.0)
    (reply,) = [m for m in host.received("TIMESYNC") if m.ts1 == 77]
    assert reply.tc1 == pytest.approx(312.25e9 + 0.5e9, abs=0.05e9)


def test_without_poses_it_does_not_arm_and_says_so() -> None:
    take_off = [{"do": "take_off", "height_m": 5.0, "for_s": 20}]
    host = Host(6.0, on_ground=True, plan=take_off, source_sets=["external"])
    host.sends = lambda time_s: False
    host.run(6.0)
    assert "PreArm: VisOdom: not healthy" in host.texts()
    assert not host.received("LOCAL_POSITION_NED")  # nothing before aiding
    assert host.received("HEARTBEAT")[-1].base_mode & 128 == 0
    assert host.stack.quadrotor.grounded


def test_with_poses_and_an_origin_it_arms_and_takes_off() -> None:
    take_off = [{"do": "take_off", "height_m": 5.0, "for_s": 30}]
    host = Host(20.0, on_ground=True, plan=take_off, source_sets=["external"], gps_until_s=0.0)
    host.run(5.0)
    assert any("waiting for home" in text for text in host.texts())
    host.send(dialect().MAVLink_set_gps_global_origin_message(1, 10, 20, 30))
    host.run(6.0)
    assert host.received("GPS_GLOBAL_ORIGIN")[-1].latitude == 10
    host.run(20.0)
    assert "armed" in host.events()
    assert host.stack.quadrotor.state[2] == pytest.approx(-1.8 + 5.0, abs=0.5)


def test_a_second_origin_is_ignored() -> None:
    host = Host(3.0, source_sets=["external"], gps_until_s=0.0, plan=[{"do": "hold", "for_s": 9}])
    for latitude in (10, 20):
        host.run(host.time_s + 1.0)
        host.send(dialect().MAVLink_set_gps_global_origin_message(1, latitude, 20, 30))
    host.run(3.0)
    assert [m.latitude for m in host.received("GPS_GLOBAL_ORIGIN")] == [10]


def test_a_reboot_is_silent_starts_the_clock_again_and_forgets_intervals_and_origin() -> None:
    host = Host(9.0, reboot_s=[5.0])
    host.run(2.0)
    host.send(command(511, RAW_IMU, 200_000))
    host.run(9.0)
    arrivals = [arrival for arrival, _ in host.frames]
    assert max(np.diff(arrivals)) == pytest.approx(2e9, abs=0.1e9)
    assert host.received("RAW_IMU")[-1].time_usec == pytest.approx(4e6, abs=0.1e6)
    assert len(host.received("RAW_IMU")) > 100 * 2 + 5 * 3 + 100  # 100 Hz again after it
    assert "reboot" in host.events()
    assert not host.stack.quadrotor.crashed


def test_a_leg_has_a_trapezoidal_speed() -> None:
    """4 m at 1 m/s with 1 m/s^2: ramps of 0.5 m in 1 s, 3 m in 3 s."""
    assert trapezoid(4.0, 1.0, 0.0) == (0.0, 0.0, 5.0)
    assert trapezoid(4.0, 1.0, 1.0)[:2] == pytest.approx((0.5, 1.0))
    assert trapezoid(4.0, 1.0, 4.5)[:2] == pytest.approx((4.0 - 0.125, 0.5))
    assert trapezoid(4.0, 1.0, 9.0)[:2] == pytest.approx((4.0, 0.0))


def test_far_from_the_target_the_speed_grows_with_the_root_of_the_distance() -> None:
    assert root_limited(1.0, 1.0, 2.5) == pytest.approx(1.0)
    assert root_limited(10.0, 1.0, 2.5) == pytest.approx((2 * 2.5 * (10 - 1.25)) ** 0.5)


def test_without_that_bit_of_its_arming_checks_it_takes_off_on_gps_without_poses() -> None:
    take_off = [{"do": "take_off", "height_m": 4.0, "for_s": 30}]
    host = Host(14.0, on_ground=True, plan=take_off, check_visual_odometry=False)
    host.sends = lambda time_s: False
    host.run(14.0)
    assert "armed" in host.events()
    assert host.stack.quadrotor.state[2] == pytest.approx(-1.8 + 4.0, abs=1.5)
