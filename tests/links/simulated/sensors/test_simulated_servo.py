"""The servo within its motor's limits, its encoder, and the script that commands it."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from pydantic import ValidationError

from links.simulated.rig.scripted_servo import ServoScript, SweepSegment, VibrateSegment
from links.simulated.sensors.servo import RPM_RADPS, TICK_RAD, GearTrain, Servo, ServoBus, ServoSettings

START_NS = 1_748_773_230_000_000_000


def _bus(*script, drone=None, shift_ns: int = 0, **settings) -> ServoBus:
    return ServoBus(ServoSettings(**settings), ServoScript(script, drone, 1), START_NS, shift_ns, 1)


def _run(bus: ServoBus, seconds: float):
    records = bus.advance(START_NS + round(seconds * 1e9))
    times = np.arange(0.0, seconds, 1e-3)
    return records, times, bus.position_rad(START_NS + np.rint(times * 1e9).astype(np.int64))


def test_a_profile_keeps_to_speed_and_acceleration_and_stops_at_the_goal() -> None:
    servo = Servo(ServoSettings(acceleration_limit_degps2=2000.0))
    servo.command(math.radians(90.0), 20 * RPM_RADPS)
    positions, speeds = [], []
    for _ in range(1500):
        servo.step(1e-3)
        positions.append(servo.position_rad)
        speeds.append(servo.velocity_radps)
    assert max(speeds) == pytest.approx(20 * RPM_RADPS)
    assert np.abs(np.diff([0.0, *speeds])).max() <= math.radians(2000.0) * 1e-3 * (1 + 1e-9)
    assert positions[-1] == pytest.approx(math.radians(90.0), abs=TICK_RAD)
    assert max(positions) < math.radians(90.0) + TICK_RAD


def test_no_command_makes_it_faster_than_its_motor_or_leave_its_travel() -> None:
    bus = _bus(SweepSegment(speed_rpm=57.2, ends_deg=(0.0, 300.0)))
    _, _, position = _run(bus, 2.0)
    assert np.diff(position).max() / 1e-3 == pytest.approx(55 * RPM_RADPS, rel=1e-3)
    assert position.max() < math.radians(180.0) + TICK_RAD


def test_a_sweep_at_11_4_rpm_takes_2_63_s() -> None:
    _, times, position = _run(_bus(SweepSegment(times=2)), 5.6)
    assert times[np.argmax(position > math.radians(179.0))] == pytest.approx(179.0 / (11.4 * 6), abs=0.03)
    assert position.max() == pytest.approx(math.pi, abs=math.radians(0.6))
    assert position[-1] == pytest.approx(0.0, abs=math.radians(0.6))


def test_vibration_swings_five_degrees_about_the_table_slower_than_commanded() -> None:
    vibrate = VibrateSegment(duration_s=5.0, azimuth_table=((0.0, 40.0),))
    _, times, position = _run(_bus(vibrate), 2.0)
    settled = np.degrees(position[times > 0.5])
    assert settled.max() == pytest.approx(45.0, abs=0.6)
    assert settled.min() == pytest.approx(35.0, abs=0.6)
    turns = np.count_nonzero(np.diff(np.sign(np.diff(settled))))
    swing_s = 1.5 / turns
    assert swing_s > 2 * math.sqrt(math.radians(10.0) / math.radians(6000.0)) - 0.01  # acceleration bound, not 29 ms


def test_following_aims_at_the_drone_before_the_latency() -> None:
    query_s = []

    def drone(time_s: float) -> float:
        query_s.append(time_s)
        return math.radians(60.0)

    _, times, position = _run(
        _bus(VibrateSegment(duration_s=5.0, follow_drone=True, aim_error_deg=0.0), drone=drone), 1.5
    )
    assert np.degrees(position[times > 0.7]).mean() == pytest.approx(60.0, abs=1.0)
    assert query_s[0] < -0.1


def test_readings_are_whole_encoder_steps_near_the_truth_at_their_stamp() -> None:
    bus = _bus(SweepSegment())
    records, _, _ = _run(bus, 2.0)
    states = [json.loads(r.data) for r in records]
    ticks = np.array([s["position_rad"] for s in states]) / TICK_RAD
    np.testing.assert_allclose(ticks, np.rint(ticks), atol=1e-5)
    true = bus.position_rad(np.array([r.stamp_ns for r in records]))
    error_deg = np.degrees(np.array([s["position_rad"] for s in states]) - true)
    assert np.abs(error_deg).max() < 0.044 + 68.4 * 0.0002  # half a step, and the sample is not quite mid-exchange
    assert abs(error_deg.mean()) < 0.01
    assert all(r.arrival_ns > r.stamp_ns for r in records)
    assert 1e9 / np.diff([r.stamp_ns for r in records]).mean() == pytest.approx(200.0, rel=0.01)
    assert {s["error"] for s in states} == {0}


def test_a_clock_error_moves_the_stamps_only() -> None:
    plain, _, _ = _run(_bus(SweepSegment()), 0.5)
    early, _, _ = _run(_bus(SweepSegment(), shift_ns=1_000_000), 0.5)
    assert [a.stamp_ns - b.stamp_ns for a, b in zip(plain, early, strict=True)] == [1_000_000] * len(plain)
    assert [a.data for a in plain] == [b.data for b in early]


def test_without_a_script_it_does_not_move() -> None:
    _, _, position = _run(_bus(start_deg=30.0), 0.3)
    np.testing.assert_allclose(position, math.radians(30.0))


def test_a_vibration_needs_exactly_one_aim() -> None:
    for wrong in ({}, {"follow_drone": True, "azimuth_table": ((0.0, 1.0),)}):
        with pytest.raises(ValidationError, match="give either follow_drone: true or an azimuth_table"):
            VibrateSegment(duration_s=1.0, **wrong)


def test_backlash_holds_the_turntable_until_the_shaft_moves_it() -> None:
    gear_train = GearTrain(ServoSettings(backlash_deg=0.4), 1)
    degrees = [0.0, 0.1, 0.3, 5.0, 4.9, 4.6, 4.5, 0.0]
    seen = [math.degrees(gear_train.follow(math.radians(d))) for d in degrees]
    assert seen == pytest.approx([0.0, 0.0, 0.1, 4.8, 4.8, 4.8, 4.7, 0.2])


def test_without_errors_turntable_and_encoder_agree() -> None:
    bus = _bus(SweepSegment())
    _, times, position = _run(bus, 1.0)
    np.testing.assert_array_equal(bus.output_rad(START_NS + np.rint(times * 1e9).astype(np.int64)), position)


def test_the_encoders_error_is_harmonic_with_its_peak_and_drawn_by_seed() -> None:
    around = np.linspace(0, 2 * math.pi, 3601)
    shapes = []
    for seed in (1, 2):
        gear_train = GearTrain(ServoSettings(encoder_error_deg=0.5), seed)
        error = np.degrees([gear_train.encoder_error_rad(p) for p in around])
        spectrum = np.abs(np.fft.rfft(error[:-1])) / 1800
        assert 0.3 < np.abs(error).max() <= 0.5 + 1e-9
        assert spectrum[1] + spectrum[2] == pytest.approx(0.5)
        assert spectrum[[0, 3, 4]].max() < 1e-9
        shapes.append(error)
        position = 1.0
        assert gear_train.follow(position) == pytest.approx(position - gear_train.encoder_error_rad(position))
    assert np.abs(shapes[0] - shapes[1]).max() > 0.1


def test_a_command_is_executed_its_latency_after_it_was_sent_and_in_order() -> None:
    bus = _bus(command_latency_s=0.030, command_jitter_s=0.004)
    bus.command(START_NS + 100_000_000, math.radians(90.0), 1.0)
    bus.command(START_NS + 101_000_000, math.radians(20.0), 1.0)
    bus.command(START_NS + 300_000_000, math.radians(40.0), 1.0)
    records, times, position = _run(bus, 0.6)
    began_s = times[np.argmax(position > 1e-6)]
    assert 0.129 < began_s < 0.150
    goals = np.degrees([json.loads(r.data)["goal_rad"] for r in records])
    changes = goals[np.append(0, np.nonzero(np.diff(goals))[0] + 1)]
    assert changes[-2:] == pytest.approx([20.0, 40.0], abs=0.05)
    assert 90.0 not in np.round(changes[-2:])


def test_a_reading_takes_at_least_its_latency() -> None:
    slow, _, _ = _run(_bus(read_latency_s=0.003, read_latency_jitter_s=0.0, read_jitter_s=0.0), 0.2)
    assert {round((r.arrival_ns - r.stamp_ns) * 1e-6, 3) for r in slow} == {1.5}
