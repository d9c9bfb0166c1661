"""Preflight checks of the servo on states made by hand."""

from __future__ import annotations

import json
import math

import pytest

from flow.link import Record
from links.dynamixel import Servo
from links.dynamixel.checks import servo_checks
from links.preflight.check_result import Level
from tests.links.preflight.observed import BEGIN_NS, by_name, levels, observe


def states(count=500, *, position_deg=90.0, error=0, step_ns=4_000_000):
    data = {"position_rad": math.radians(position_deg), "velocity_radps": 0.0, "goal_rad": 0.0, "error": error}
    at_ns = [BEGIN_NS + k * step_ns for k in range(count)]
    return [Record("/servo/state", at, at - 500_000, json.dumps(data).encode()) for at in at_ns]


HEALTH = {"reads": 500, "connected": 1, "voltage_mv": 12_000, "temperature_c": 35}


def test_a_healthy_servo_passes():
    found = levels(servo_checks(observe(Servo(), states(), counters=HEALTH)))
    assert found == {"replies": "ok", "position": "ok", "errors": "ok", "exchanges": "ok", "supply": "ok"}


@pytest.mark.parametrize(
    ("records", "counters", "check", "expected_text"),
    [
        (states(step_ns=50_000_000), {}, "replies", "20 replies/s"),
        (states(position_deg=200.0), {}, "position", "outside limits_deg 0 to 180"),
        (states(error=0x20), {}, "errors", "overload in 500 of 500"),
        (states(), {"connected": 0}, "exchanges", "has no torque"),
        (states(), {"voltage_mv": 9_000}, "supply", "9.0 V"),
        (states(), {"temperature_c": 79}, "supply", "79 deg C"),
    ],
)
def test_a_servo_that_is_not_ready_fails(records, counters, check, expected_text):
    found = by_name(servo_checks(observe(Servo(), records, counters=HEALTH | counters)))[check]
    assert found.level is Level.FAIL
    assert expected_text in found.sentence


def test_a_silent_servo_fails_and_damaged_replies_are_a_warning():
    source = observe(Servo(), states(), counters=HEALTH, end_ns=BEGIN_NS + 5_000_000_000)
    assert "no reply for 3.0 s" in by_name(servo_checks(source))["replies"].sentence
    damaged = observe(Servo(), states(), counters=HEALTH | {"damaged": 20})
    assert by_name(servo_checks(damaged))["exchanges"].level is Level.WARNING
    slow = observe(Servo(), states(step_ns=8_000_000), counters=HEALTH)
    assert by_name(servo_checks(slow))["replies"].level is Level.WARNING


def test_an_absent_servo_reports_the_status_of_its_link():
    (result,) = servo_checks(observe(Servo(), [], status="/dev/ttyUSB0: the servo does not reply"))
    assert (result.level, result.sentence) == (Level.FAIL, "/dev/ttyUSB0: the servo does not reply")
    (result,) = servo_checks(observe(Servo(), [Record("/servo/state", 1, 1, b"{}")]))
    assert "1 records without a valid state arrived" in result.sentence
