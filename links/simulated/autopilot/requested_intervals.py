"""Message intervals that a station requested, by ArduPilot's rules, applied to a plan of messages at fixed rates.

A message is sent at most at its requested rate; the plan limits the rate from above. As ArduPilot does, the interval is
truncated to whole milliseconds, a rate above 0.8 of the main loop's is denied, and a message that is not known fails.

Source: ArduPilot GCS_MAVLINK::set_message_interval and cap_message_interval, libraries/GCS_MAVLink/GCS_Common.cpp;
https://github.com/ArduPilot/ardupilot/pull/34145.
"""

from __future__ import annotations

from typing import Any

SET_MESSAGE_INTERVAL = 511  # MAV_CMD
ACCEPTED, DENIED, FAILED = 0, 2, 4  # MAV_RESULT
FASTEST_HZ = 0.8 * 400  # of the main loop's rate
EARLY = 0.9  # a planned message is sent when this share of the interval has passed: plan and interval beat otherwise
KNOWN = (26, 27, 30, 32, 105, 193, 230, 331)  # IMU, attitude, position, estimator, odometry


class RequestedIntervals:
    """Requested intervals by message id; a message without a request passes."""

    def __init__(self) -> None:
        self._interval_ns: dict[int, int] = {}
        self._sent_ns: dict[int, int] = {}

    def on_command(self, command: Any) -> int:
        """MAV_RESULT of a MAV_CMD_SET_MESSAGE_INTERVAL."""
        message_id, interval_us = round(command.param1), command.param2
        if command.param3 != 0 or 0 < interval_us < 1e6 / FASTEST_HZ:
            return DENIED
        if message_id not in KNOWN:
            return FAILED
        if interval_us == 0:  # the default rate
            self._interval_ns.pop(message_id, None)
        else:
            self._interval_ns[message_id] = int(interval_us / 1000) * 1_000_000 if interval_us > 0 else -1
        return ACCEPTED

    def requested(self, message_id: int) -> bool:
        """Whether a station requested the message."""
        return self._interval_ns.get(message_id, -1) > 0

    def passes(self, message_id: int, now_ns: int) -> bool:
        """Whether a planned message is sent now."""
        interval_ns = self._interval_ns.get(message_id)
        if interval_ns is None:
            return True
        if interval_ns < 0 or now_ns - self._sent_ns.get(message_id, -interval_ns) < EARLY * interval_ns:
            return False
        self._sent_ns[message_id] = now_ns
        return True
