"""Recorded servo states."""

from __future__ import annotations

import json
import math

import pytest

from flow.link import Record
from links.dynamixel import Servo, wire
from links.dynamixel.readings import reading_record
from links.dynamixel.servo import goal_command
from stages.messages import ServoGoal

GOOD = {"position_rad": 1.5, "velocity_radps": -0.25, "goal_rad": 2.0, "error": 32}


def record(data: bytes) -> Record:
    return Record("/servo/state", arrival_ns=20, stamp_ns=10, data=data)


def test_a_state_keeps_its_own_time_and_every_field():
    state = Servo().decode(record(json.dumps(GOOD).encode()))
    assert state is not None
    assert (state.stamp_ns, state.position_rad, state.velocity_radps, state.goal_rad, state.error) == (
        10,
        1.5,
        -0.25,
        2.0,
        32,
    )


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xfe",
        b"[]",
        b"null",
        b"[" * 900,
        b'{"position_rad": 1}',
        json.dumps(GOOD | {"position_rad": float("nan")}).encode(),
        json.dumps(GOOD | {"velocity_radps": float("inf")}).encode(),
        json.dumps(GOOD | {"goal_rad": "far"}).encode(),
        json.dumps(GOOD | {"error": None}).encode(),
        json.dumps(GOOD | {"position_rad": 1e300}).encode(),
        json.dumps(GOOD | {"more": "x" * 2000}).encode(),
    ],
)
def test_a_record_without_a_valid_state_is_counted_and_skipped(data):
    servo = Servo()
    assert servo.decode(record(data)) is None
    assert servo.rejected == 1


def test_a_reading_is_stamped_in_the_middle_of_its_exchange_and_arrives_with_the_reply():
    reading = wire.Reading(0, 10_000_000, 1024, 10, 1030, 32)
    at_zero = reading_record("/servo/state", reading, host_ahead_ns=0, sequence=7)
    assert (at_zero.stamp_ns, at_zero.arrival_ns, at_zero.sequence, at_zero.topic) == (
        5_000_000,
        10_000_000,
        7,
        "/servo/state",
    )
    later = reading_record("/servo/state", reading, host_ahead_ns=1_748_773_230_000_000_000, sequence=7)
    assert later.stamp_ns == 1_748_773_230_005_000_000
    assert later.arrival_ns == 1_748_773_230_010_000_000
    state = Servo().decode(at_zero)
    assert (state.stamp_ns, state.error) == (5_000_000, 32)
    assert (state.position_rad, state.goal_rad) == pytest.approx((math.pi / 2, 1030 * math.tau / 4096))
    assert state.velocity_radps == pytest.approx(10 * 0.229 * math.tau / 60)


def goal(position_rad: float, speed_radps: float) -> ServoGoal:
    return ServoGoal(stamp_ns=0, position_rad=position_rad, speed_radps=speed_radps)


def test_a_goal_is_written_in_steps_and_units_of_0_229_rpm():
    command = goal_command(goal(math.pi, 11.4 * math.tau / 60))
    assert (command.position_ticks, command.velocity_units) == (2048, 50)
    assert command.position_rad == pytest.approx(math.pi)
    assert command.speed_radps == pytest.approx(11.45 * math.tau / 60)


def test_a_goal_stays_within_one_turn_and_never_means_no_speed_limit():
    assert goal_command(goal(-0.1, 0.0)).position_ticks == 0
    assert goal_command(goal(7.0, 1e3)).position_ticks == 4095
    assert goal_command(goal(0.0, 0.0)).velocity_units == 1
    assert goal_command(goal(0.0, 1e3)).velocity_units == 1023


def test_the_newest_goal_is_kept_and_taken_once():
    servo = Servo()
    assert servo.take_command() is None
    servo.on_goal(goal(1.0, 1.0))
    servo.on_goal(goal(2.0, 1.0))
    command = servo.take_command()
    assert command is not None
    assert command.position_rad == pytest.approx(2.0, abs=0.001)
    assert servo.take_command() is None
