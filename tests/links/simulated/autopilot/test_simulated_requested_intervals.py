"""Requested intervals of the simulated autopilot: ArduPilot's rules, and what passes."""

from __future__ import annotations

from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from links.simulated.autopilot.requested_intervals import ACCEPTED, DENIED, FAILED, RequestedIntervals

mavlink: Any = ardupilotmega
RAW_IMU, MS = 27, 1_000_000


def command(message_id: int, interval_us: float, third: float = 0.0) -> Any:
    return mavlink.MAVLink_command_long_message(1, 1, 511, 0, message_id, interval_us, third, 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("request_", "result"),
    [
        (command(RAW_IMU, 20_000), ACCEPTED),
        (command(RAW_IMU, 2_500), DENIED),  # 400 Hz
        (command(RAW_IMU, 20_000, third=1.0), DENIED),
        (command(12_345, 20_000), FAILED),
    ],
)
def test_requests_are_answered_by_ardupilots_rules(request_: Any, result: int):
    assert RequestedIntervals().on_command(request_) == result


def passed(intervals: RequestedIntervals, plan_ms: float, seconds: float = 10.0) -> int:
    return sum(intervals.passes(RAW_IMU, round(i * plan_ms * MS)) for i in range(round(1000 * seconds / plan_ms)))


def test_a_planned_message_passes_at_the_requested_rate_truncated_to_milliseconds():
    assert passed(RequestedIntervals(), 10.0) == 1000, "without a request everything passes"
    slow = RequestedIntervals()
    slow.on_command(command(RAW_IMU, 40_900))
    assert passed(slow, 10.0) == 250
    off = RequestedIntervals()
    off.on_command(command(RAW_IMU, -1))
    assert passed(off, 10.0) == 0
    off.on_command(command(RAW_IMU, 0))
    assert passed(off, 10.0) == 1000
