"""The servo live: the servo process, the real SDK, and the emulated servo on a pty, healthy and with every fault."""

from __future__ import annotations

import itertools
import json
import math
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from pydantic import ValidationError

from flow.link import LinkError, PolledRecords
from links.clock import host_time
from links.dynamixel import Servo, mx28
from links.simulated.sensors.dynamixel_emulator import DynamixelEmulator
from links.simulated.sensors.servo import ServoSettings
from stages.messages import ServoGoal

RPM = math.tau / 60
PATIENCE_S = 20.0


@pytest.fixture
def emulator():
    with DynamixelEmulator(ServoSettings(travel_deg=(0.0, 360.0), start_deg=90.0)) as servo:
        yield servo


def live(emulator, **config):
    return Servo(port=str(emulator.path), **config)


def goal(position_deg, speed_rpm=20.0):
    return ServoGoal(stamp_ns=0, position_rad=math.radians(position_deg), speed_radps=speed_rpm * RPM)


def until(records, wanted):
    """The states up to and including the first one for which `wanted` is true."""
    states, deadline_s = [], time.monotonic() + PATIENCE_S
    for record in records:
        states.append(json.loads(record.data))
        if wanted(states[-1]):
            return states
        assert time.monotonic() < deadline_s, f"not within {PATIENCE_S} s; last: {states[-1]}"
    raise AssertionError("the records ended")


def eventually(wanted):
    deadline_s = time.monotonic() + PATIENCE_S
    while not wanted():
        assert time.monotonic() < deadline_s
        time.sleep(0.005)


def at(position_deg):
    return lambda state: abs(math.degrees(state["position_rad"]) - position_deg) < 0.2


def travel(servo, records, position_deg, speed_rpm):
    """(record, state) until the servo is there; a goal that was dropped on a busy machine is sent again."""
    deadline_s = time.monotonic() + PATIENCE_S
    for number, record in enumerate(records):
        state = servo.decode(record)
        if number % 20 == 0 and abs(state.goal_rad - math.radians(position_deg)) > mx28.TICK_RAD:
            servo.on_goal(goal(position_deg, speed_rpm))
        yield record, state
        if at(position_deg)({"position_rad": state.position_rad}):
            return
        assert time.monotonic() < deadline_s, f"not within {PATIENCE_S} s; last: {state}; {servo.counters}"


def test_states_are_stamped_when_the_servo_was_at_that_position(emulator):
    servo = live(emulator)
    host_ahead_ns = host_time.now_ns() - time.monotonic_ns()
    with servo.listen() as records:
        assert isinstance(records, PolledRecords)
        moving = []
        for record, state in travel(servo, records, 150, 20):
            assert record.topic == "/servo/state"
            assert record.stamp_ns < record.arrival_ns
            truth = emulator.position_rad(np.array([record.stamp_ns - host_ahead_ns]))[0]
            if abs(state.velocity_radps) > 1.5:
                moving.append(state.position_rad - truth)
    assert len(moving) > 20
    assert abs(np.median(moving)) < 2 * mx28.TICK_RAD  # 20 rpm is 1.4 ticks a millisecond
    assert state.goal_rad == pytest.approx(math.radians(150), abs=mx28.TICK_RAD)


def test_with_late_replies_a_stamp_is_still_in_the_middle_of_the_exchange(emulator):
    """The emulated servo measures at the request and replies 8 ms later: 2 stamp - arrival is the request time."""
    emulator.late(0.008, 100_000)
    servo = live(emulator, rate_hz=80.0)
    host_ahead_ns = host_time.now_ns() - time.monotonic_ns()
    errors_ticks, half_ms = [], []
    with servo.listen() as records:
        for record, state in travel(servo, records, 175, 20):
            request_ns = 2 * record.stamp_ns - record.arrival_ns - host_ahead_ns
            truth = emulator.position_rad(np.array([request_ns]))[0]
            if abs(state.velocity_radps) > 1.5:
                errors_ticks.append((state.position_rad - truth) / mx28.TICK_RAD)
                half_ms.append(1e-6 * (record.arrival_ns - record.stamp_ns))
    assert len(errors_ticks) > 10
    assert np.median(half_ms) > 4
    assert abs(np.median(errors_ticks)) < 3  # a stamp at the request would be off by 11 ticks, 1.4 in each millisecond


def test_the_servo_is_read_at_least_200_times_per_second(emulator):
    """By default, with goals in between. On a busy machine not always: the best of three windows counts."""
    servo, rates_hz = live(emulator), []
    with servo.listen() as records:
        next(records)
        while len(rates_hz) < 3 and max(rates_hz, default=0.0) < 200.0:
            stamps = []
            for record in itertools.islice(records, 500):
                stamps.append(record.stamp_ns)
                if len(stamps) % 5 == 0:
                    servo.on_goal(goal(100 + len(stamps) % 10))
            rates_hz.append(1e9 / np.median(np.diff(stamps)))
    assert max(rates_hz) >= 200.0, rates_hz


def test_a_healthy_servo_has_no_status_from_start_to_end(emulator):
    servo = live(emulator, watchdog_s=2.5)  # a busy machine may be late
    statuses = [servo.status]
    with servo.listen() as records:
        statuses.append(servo.status)
        next(records)
        servo.on_goal(goal(120, 40))
        until(records, lambda state: statuses.append(servo.status) or at(120)(state))
        until(records, lambda _: statuses.append(servo.status) or servo.counters["reads"] > 200)
    assert {*statuses, servo.status} == {None}


def test_the_newest_goal_is_reached_at_its_speed(emulator):
    servo = live(emulator)
    with servo.listen() as records:
        next(records)
        servo.on_goal(goal(10, 5))
        servo.on_goal(goal(120, 30))
        states = until(records, at(120))
    assert max(s["velocity_radps"] for s in states) == pytest.approx(30 * RPM, rel=0.02)
    assert servo.counters["goals_sent"] + servo.counters["goals_lost"] <= 2


def test_without_the_aim_stage_the_servo_stops_in_mid_sweep_and_follows_the_next_goal(emulator):
    servo = live(emulator)
    assert servo.upstream_lost("goal") is None, "it is not live yet"
    with servo.listen() as records:
        next(records)
        servo.on_goal(goal(170, 10))
        until(records, lambda state: math.degrees(state["position_rad"]) > 100)
        assert servo.upstream_lost("goal") == "the servo is stopped"
        stopped = until(records, lambda state: math.degrees(state["goal_rad"]) < 165)[-1]
        until(records, lambda state: abs(state["velocity_radps"]) < 0.01)
        assert math.degrees(emulator.position_rad(np.array([time.monotonic_ns()]))[0]) < 160
        assert math.degrees(stopped["goal_rad"]) < 160
        assert servo.counters["stops: no aim stage"] == 1
        servo.on_goal(goal(60, 40))
        until(records, at(60))


def test_a_goal_beyond_the_soft_limits_is_clamped_and_counted(emulator):
    servo = live(emulator, limits_deg=(60.0, 110.0))
    with servo.listen() as records:
        next(records)
        servo.on_goal(goal(175, 40))
        states = until(records, at(110))
        servo.on_goal(goal(-20, 40))
        states += until(records, at(60))
    assert servo.counters["goals clamped to limits_deg"] == 2
    assert all(math.radians(59.8) < s["goal_rad"] < math.radians(110.1) for s in states)


def test_a_goal_faster_than_the_servo_is_clamped_and_counted(emulator):
    servo = live(emulator)
    with servo.listen() as records:
        next(records)
        servo.on_goal(goal(120, 57.2))
        until(records, at(120))
    assert emulator.get(mx28.PROFILE_VELOCITY) == 240  # 54.96 rpm
    assert servo.counters["goals clamped to speed_limit_rpm"] == 1


def test_a_goal_that_is_not_finite_moves_nothing(emulator):
    servo = live(emulator)
    with servo.listen() as records:
        next(records)
        servo.on_goal(ServoGoal(stamp_ns=0, position_rad=math.nan, speed_radps=1.0))
        servo.on_goal(ServoGoal(stamp_ns=0, position_rad=1.0, speed_radps=math.inf))
        assert {next(records).data for _ in range(20)} == {next(records).data}
    assert servo.counters["goals rejected: not finite"] == 2


def test_leaving_the_context_stops_a_moving_servo(emulator):
    servo = live(emulator, watchdog_s=2.5)  # which is too slow to have done it
    with servo.listen() as records:
        next(records)
        servo.on_goal(goal(170, 10))
        until(records, lambda s: math.degrees(s["position_rad"]) > 95)
    stopped_deg = emulator.get(mx28.GOAL_POSITION) * 360 / 4096
    assert emulator.get(mx28.BUS_WATCHDOG) != mx28.WATCHDOG_TRIPPED
    assert 95 < stopped_deg < 140
    assert emulator.get(mx28.TORQUE_ENABLE) == 1  # it holds
    before = servo.counters
    servo.on_goal(goal(20))
    assert servo.counters["goals while not live"] == before.get("goals while not live", 0) + 1


def test_a_goal_that_is_not_reached_in_time_is_abandoned(emulator):
    servo = live(emulator, goal_slack_s=0.1)
    with servo.listen() as records:
        next(records)
        emulator.stall()
        servo.on_goal(goal(100, 55))
        until(records, lambda s: s["goal_rad"] > math.radians(99))
        states = until(records, lambda s: s["goal_rad"] < math.radians(91))
        assert at(90)(states[-1])
        emulator.free()
        states = [json.loads(next(records).data) for _ in range(50)]
        until(records, lambda _: servo.counters["goals_expired"] == 1)
    assert all(at(90)(s) for s in states)  # it does not go on when it could


def test_a_goal_that_was_reached_in_time_is_kept_after_its_time(emulator):
    servo = live(emulator, goal_slack_s=0.1)
    with servo.listen() as records:
        next(records)
        servo.on_goal(goal(100, 55))
        until(records, at(100))
        states = [json.loads(next(records).data) for _ in range(100)]  # 0.4 s
        until(records, lambda _: servo.counters["reads"] > 100)
    assert all(at(100)(s) for s in states)
    assert {round(s["goal_rad"] / mx28.TICK_RAD) for s in states} == {round(math.radians(100) / mx28.TICK_RAD)}
    assert servo.counters["goals_expired"] == 0


def test_a_newer_goal_has_its_own_time(emulator):
    servo = live(emulator, goal_slack_s=1.0)
    with servo.listen() as records:
        next(records)
        emulator.stall()
        for position_deg in (100, 101, 100, 101):  # each shortly before the previous one would be abandoned
            servo.on_goal(goal(position_deg, 55))
            states = [json.loads(next(records).data) for _ in range(150)]  # 0.6 s
            assert math.degrees(states[-1]["goal_rad"]) == pytest.approx(position_deg, abs=0.1)
        assert servo.counters["goals_expired"] == 0
        until(records, lambda s: s["goal_rad"] < math.radians(91))


def test_after_an_overload_the_servo_is_rebooted_and_set_up_and_its_angle_is_read_meanwhile(emulator):
    servo = live(emulator)
    with servo.listen() as records:
        next(records)
        emulator.stall(overload_s=0.05)
        servo.on_goal(goal(120))
        assert servo.status is None
        until(records, lambda s: s["error"] == mx28.OVERLOAD)
        until(
            records, lambda _: "has shut down (overload) and does not move: it is set up again" in (servo.status or "")
        )
        emulator.free()
        states = until(records, lambda s: s["error"] == 0)
        until(records, lambda _: servo.counters["connected"] == 1)
        assert servo.status is None
        assert at(90)(states[-1])  # the previous goal does not return
        servo.on_goal(goal(120))
        until(records, at(120))
    assert servo.counters["reboots"] >= 1
    assert servo.counters["set_ups"] == 2


def test_with_reboot_disabled_the_servo_stays_down_and_this_is_reported(emulator):
    servo = live(emulator, reboot=False)
    with servo.listen() as records:
        next(records)
        emulator.overload()
        until(records, lambda s: s["error"] == mx28.OVERLOAD)
        until(records, lambda _: servo.counters["connected"] == 0)
        assert "it needs a reboot (`reboot: false`)" in (servo.status or "")
        servo.on_goal(goal(120))
        states = until(records, lambda _: servo.counters["goals_lost"] == 1)
    assert at(90)(states[-1])
    assert servo.counters["reboots"] == 0
    assert emulator.get(mx28.TORQUE_ENABLE) == 0


def test_an_error_without_shutdown_is_reported_and_the_servo_still_moves(emulator):
    servo = live(emulator)
    with servo.listen() as records:
        next(records)
        emulator.overload(0x01)  # input voltage; causes no shutdown with the factory setting
        until(records, lambda s: s["error"] == 0x01)
        servo.on_goal(goal(120))
        assert until(records, at(120))[-1]["error"] == 0x01
        emulator.torque_off()
        until(records, lambda _: servo.counters["set_ups"] == 2)
        servo.on_goal(goal(90))
        until(records, at(90))
    assert servo.counters["reboots"] == 0


@pytest.mark.parametrize(
    ("fault", "counter"),
    [
        (lambda e: e.torque_off(), "torque_losses"),
        (lambda e: e.power_cycle(), "no_reply"),
        (lambda e: e.set(mx28.BUS_WATCHDOG, mx28.WATCHDOG_TRIPPED), "watchdog_stops"),
    ],
    ids=["torque off", "power cycle", "watchdog"],
)
def test_a_servo_without_torque_is_set_up_again_at_its_position(emulator, fault, counter):
    servo = live(emulator)
    with servo.listen() as records:
        next(records)
        servo.on_goal(goal(170, 10))
        until(records, lambda s: math.degrees(s["position_rad"]) > 93)
        fault(emulator)
        states = until(records, lambda _: servo.counters["set_ups"] == 2 and servo.counters["connected"] == 1)
        assert math.degrees(states[-1]["goal_rad"]) < 110  # it stops; the old goal is dropped
        servo.on_goal(goal(60, 40))
        until(records, at(60))
        assert emulator.get(mx28.BUS_WATCHDOG) == 5
    assert servo.counters[counter] >= 1


def test_an_unplugged_and_replugged_cable_is_found_again(emulator):
    servo = live(emulator)
    with servo.listen() as records:
        next(records)
        servo.on_goal(goal(170, 10))
        until(records, lambda s: math.degrees(s["position_rad"]) > 93)
        emulator.unplug()
        eventually(lambda: emulator.get(mx28.BUS_WATCHDOG) == mx28.WATCHDOG_TRIPPED)  # it stopped by itself
        emulator.plug_in()
        states = until(records, lambda _: servo.counters["set_ups"] == 2)
        assert math.degrees(states[-1]["position_rad"]) < 120
        servo.on_goal(goal(60, 40))
        until(records, at(60))
    assert servo.counters["unplugged"] >= 1


@pytest.mark.parametrize(
    ("fault", "counter"),
    [
        (lambda e: e.bad_crc(3), "damaged"),
        (lambda e: e.hold_back(), "wrong"),
        (lambda e: e.short_data(3), "wrong"),
        (lambda e: e.false_position(3000, 1), "implausible"),
        (lambda e: e.garbage(b"\xff\xff\xfd\x00\x01\x07\x00\x55" + bytes(7), 3), "damaged"),
    ],
    ids=["crc", "late", "short", "false_position", "garbage"],
)
def test_corrupted_replies_are_counted_and_give_no_wrong_angle(emulator, fault, counter):
    servo = live(emulator)
    with servo.listen() as records:
        next(records)
        fault(emulator)
        states = until(records, lambda _: servo.counters[counter] >= 1)
        states += [json.loads(next(records).data) for _ in range(30)]
    assert all(at(90)(s) for s in states)
    assert servo.counters["set_ups"] == 1


def test_a_confirmed_jump_is_accepted(emulator):
    servo = live(emulator)
    with servo.listen() as records:
        next(records)
        emulator.false_position(3000, 400)
        until(records, lambda s: s["position_rad"] > 4)
        until(records, lambda _: servo.counters["implausible"] >= 1)


def test_when_the_servo_process_is_killed_the_watchdog_stops_the_servo_and_a_new_process_starts(emulator):
    servo = live(emulator)
    with servo.listen() as records:
        next(records)
        servo.on_goal(goal(170, 5))
        until(records, lambda s: math.degrees(s["position_rad"]) > 93)
        os.kill(servo._readings.process.pid, signal.SIGKILL)
        eventually(lambda: emulator.get(mx28.BUS_WATCHDOG) == mx28.WATCHDOG_TRIPPED)
        states = until(records, lambda _: servo.counters["process restarts"] == 1)
        assert math.degrees(states[-1]["position_rad"]) < 110
        servo.on_goal(goal(60, 40))
        until(records, at(60))


PARENT = """
import sys
from links.dynamixel import Servo
from stages.messages import ServoGoal
servo = Servo(port=sys.argv[1], watchdog_s=2.5)
with servo.listen() as records:
    for number, record in enumerate(records):
        if number % 100 == 0:  # a loaded machine may lose a goal
            servo.on_goal(ServoGoal(stamp_ns=0, position_rad=3.0, speed_radps=0.5))
        if servo.decode(record).position_rad > 1.65:
            print(servo._readings.process.pid, flush=True)
            break
    for record in records:
        pass
"""


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "Z" not in open(f"/proc/{pid}/stat").read().rsplit(")", 1)[1].split()[0]


def test_when_the_parent_is_killed_the_servo_is_stopped_and_its_process_ends(emulator):
    parent = subprocess.Popen([sys.executable, "-c", PARENT, str(emulator.path)], stdout=subprocess.PIPE, text=True)
    with parent:
        worker = int(parent.stdout.readline())
        parent.kill()
    eventually(lambda: not alive(worker))
    assert emulator.get(mx28.BUS_WATCHDOG) != mx28.WATCHDOG_TRIPPED
    goal_deg = emulator.get(mx28.GOAL_POSITION) * 360 / 4096
    assert 94 < goal_deg < 130
    eventually(lambda: abs(math.degrees(emulator.position_rad(np.array([time.monotonic_ns()]))[0]) - goal_deg) < 0.2)


def test_when_the_parent_is_silent_the_servo_is_stopped(emulator):
    parent = subprocess.Popen([sys.executable, "-c", PARENT, str(emulator.path)], stdout=subprocess.PIPE, text=True)
    with parent:
        worker = int(parent.stdout.readline())
        parent.send_signal(signal.SIGSTOP)
        try:
            eventually(lambda: emulator.get(mx28.GOAL_POSITION) * 360 / 4096 < 150)
            assert emulator.get(mx28.BUS_WATCHDOG) != mx28.WATCHDOG_TRIPPED
            assert alive(worker)
        finally:
            parent.kill()  # a stopped process, too
    assert emulator.get(mx28.GOAL_POSITION) * 360 / 4096 > 94


def test_a_parent_that_does_not_receive_is_counted_and_followed_again(emulator):
    servo = live(emulator)
    with servo.listen() as records:
        next(records)
        servo.on_goal(goal(170, 5))
        time.sleep(1.2)
        until(records, lambda _: servo.counters["parent_silent"] == 1)
        servo.on_goal(goal(120, 20))
        assert until(records, at(120))
        time.sleep(1.2)  # no goal is active
        until(records, lambda _: servo.counters["reads"] > 0)
        for _ in range(100):
            next(records)
    assert servo.counters["parent_silent"] == 1


def error_text(servo):
    with pytest.raises(LinkError) as caught, servo.listen() as records:
        next(records)
    return str(caught.value)


@pytest.mark.parametrize(
    ("register", "value", "expected_text"),
    [
        (mx28.MODEL_NUMBER, 29, "model number 29.*1.0 firmware.*DYNAMIXEL Wizard"),
        (mx28.FIRMWARE_VERSION, 37, "firmware is version 37; version 38 is needed"),
        (mx28.RETURN_DELAY_TIME, 250, r"Return Delay Time \(9\) is 250, not 0.*write_settings: true"),
        (mx28.OPERATING_MODE, 4, r"Operating Mode \(11\) is 4, not 3"),
        (mx28.DRIVE_MODE, 4, r"Drive Mode \(10\) is 4, not 0"),
        (mx28.VELOCITY_LIMIT, 239, r"Velocity Limit \(44\) is 239, not 240.*lower `speed_limit_rpm`"),
        (mx28.MAX_POSITION_LIMIT, 1500, r"Max Position Limit \(48\) is 1500, not 2048"),
    ],
)
def test_a_servo_that_must_not_be_driven_is_an_error_that_names_the_setting(emulator, register, value, expected_text):
    emulator.set(register, value)
    servo = live(emulator)
    with pytest.raises(LinkError, match=expected_text), servo.listen() as records:
        until(records, lambda _: False)  # on a busy machine it is read before its settings are checked
    assert emulator.get(mx28.TORQUE_ENABLE) == 0


@pytest.mark.parametrize("start_deg", [-2.6, 185.0, 357.4])
def test_a_servo_outside_its_limits_gets_no_torque(start_deg: float):
    """Just below 0 deg it would count from 360 deg, and turn back by that."""
    with DynamixelEmulator(ServoSettings(travel_deg=(0.0, 360.0), start_deg=start_deg)) as emulator:
        with pytest.raises(LinkError, match="outside limits_deg 0 to 180"), live(emulator).listen() as records:
            until(records, lambda _: False)
        assert emulator.get(mx28.TORQUE_ENABLE) == 0


def test_a_servo_that_holds_its_position_just_below_0_deg_is_driven():
    """As after a restart of the process: it has torque, and goes on counting."""
    with DynamixelEmulator(ServoSettings(travel_deg=(0.0, 360.0), start_deg=-0.2)) as emulator:
        emulator.set(mx28.TORQUE_ENABLE, 1)
        with live(emulator).listen() as records:
            until(records, lambda _: emulator.get(mx28.BUS_WATCHDOG) > 0)


def test_with_write_settings_the_settings_are_corrected_and_kept(emulator):
    emulator.set(mx28.RETURN_DELAY_TIME, 250)
    emulator.set(mx28.OPERATING_MODE, 4)
    emulator.set(mx28.VELOCITY_LIMIT, 230)
    emulator.set(mx28.TORQUE_ENABLE, 1)  # the previous run was killed
    with live(emulator, write_settings=True).listen() as records:
        next(records)
    assert emulator.get(mx28.RETURN_DELAY_TIME) == 0
    assert emulator.get(mx28.OPERATING_MODE) == 3
    assert emulator.get(mx28.VELOCITY_LIMIT) == 240


def test_no_servo_and_no_port_are_errors_that_name_what_to_check(emulator, tmp_path):
    expected_text = error_text(live(emulator, servo_id=7, start_timeout_s=0.2))
    assert "the servo with id 7 does not reply at 1000000 baud" in expected_text
    assert "Is it powered (12 V) and wired" in expected_text
    expected_text = error_text(Servo(port=str(tmp_path / "none"), start_timeout_s=0.2))
    assert "cannot open" in expected_text
    assert "Is the USB adapter plugged in" in expected_text


@pytest.mark.parametrize(
    "setting",
    [
        {"limits_deg": (90.0, 90.0)},
        {"limits_deg": (-1.0, 90.0)},
        {"limits_deg": (0.0, 361.0)},
        {"baud": 9600},
        {"rate_hz": 5},
        {"servo_id": 253},
        {"watchdog_s": 3},
        {"watchdog_s": 0.1, "rate_hz": 20},
        {"goal_slack_s": 0},
        {"typo": 1},
    ],
)
def test_impossible_settings_are_errors(setting):
    with pytest.raises(ValidationError):
        Servo(**setting)
