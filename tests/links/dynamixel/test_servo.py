"""Recorded servo states."""

from __future__ import annotations

import json

import pytest

from flow.link import Record
from links.dynamixel import Servo

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
def test_what_is_no_state_is_counted_and_left_out(data):
    servo = Servo()
    assert servo.decode(record(data)) is None
    assert servo.refused == 1
