"""Servo states as a source: one JSON object per exchange with the servo, stamped mid-exchange.

Source: ours; recording format in recordings/README.md (/servo/state).
"""

from __future__ import annotations

import json
from typing import Any

from pydantic import PrivateAttr

from flow.link import Record, Source
from stages.messages import ServoState

MAX_STATE_BYTES = 1_000


class Servo(Source):
    """States of the turntable's servo. An unreadable state is counted in `refused` and left out."""

    topic: str = "/servo/state"
    _refused: int = PrivateAttr(default=0)

    @property
    def refused(self) -> int:
        """Records that held no servo state."""
        return self._refused

    def decode(self, record: Record) -> ServoState | None:
        """A message of `{"position_rad": 1.2, "velocity_radps": 0.0, "goal_rad": 1.3, "error": 0}`, else None."""
        try:
            return parse_state(record.stamp_ns, record.data)
        except ValueError:
            self._refused += 1
            return None


def parse_state(stamp_ns: int, data: bytes) -> ServoState:
    """One recorded state. Raises ValueError when it is no JSON object, or a field is missing or no finite number."""
    if len(data) > MAX_STATE_BYTES:
        raise ValueError(f"a servo state of {len(data)} bytes")
    try:
        fields: Any = json.loads(data)
        numbers = [float(fields[name]) for name in ("position_rad", "velocity_radps", "goal_rad")]
        error = int(fields["error"])
    except (TypeError, KeyError, OverflowError, RecursionError) as problem:
        raise ValueError(f"no servo state: {problem!r}") from None
    if not all(abs(number) < 1e6 for number in numbers):  # NaN compares false
        raise ValueError(f"a servo state with the numbers {numbers}")
    return ServoState(
        stamp_ns=stamp_ns, position_rad=numbers[0], velocity_radps=numbers[1], goal_rad=numbers[2], error=error
    )
