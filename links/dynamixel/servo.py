"""The servo as a link: its states come in, one JSON object per exchange, and goals go out in its own units.

In replay nothing goes out: the recorded states are used. In closed loop the simulated servo obeys `take_command`.

Source: ours; recording format in recordings/README.md (/servo/state). Units: ROBOTIS e-manual, MX-28AR(2.0), control
table, https://emanual.robotis.com/docs/en/dxl/mx/mx-28-2/ (goal position 4096 steps a turn, profile velocity in units
of 0.229 rpm, where 0 would mean no limit).
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any, ClassVar

from pydantic import PrivateAttr

from flow.link import Record, Source
from stages.messages import ServoGoal, ServoState

MAX_STATE_BYTES = 1_000
TICK_RAD = math.tau / 4096
VELOCITY_UNIT_RADPS = 0.229 * math.tau / 60


@dataclass(frozen=True, slots=True)
class GoalCommand:
    """What is written to the servo: its registers Goal Position and Profile Velocity."""

    position_ticks: int  # 0..4095, position control mode
    velocity_units: int  # 1..1023

    @property
    def position_rad(self) -> float:
        """The goal that the servo understands."""
        return self.position_ticks * TICK_RAD

    @property
    def speed_radps(self) -> float:
        """The speed that the servo understands."""
        return self.velocity_units * VELOCITY_UNIT_RADPS


class Servo(Source):
    """States of the turntable's servo, and goals to it. An unreadable state is counted in `refused` and left out."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"goal"})

    topic: str = "/servo/state"
    _refused: int = PrivateAttr(default=0)
    _waiting: GoalCommand | None = PrivateAttr(default=None)

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

    def on_goal(self, goal: ServoGoal) -> None:
        """The goal waits until the line to the servo is free; a newer one takes its place."""
        self._waiting = goal_command(goal)

    def take_command(self) -> GoalCommand | None:
        """The newest goal not yet sent, once."""
        command, self._waiting = self._waiting, None
        return command


def goal_command(goal: ServoGoal) -> GoalCommand:
    """A goal in the servo's units: the nearest step of one turn, and the nearest speed but never 0, its 'no limit'."""
    ticks = min(max(round(goal.position_rad / TICK_RAD), 0), 4095)
    return GoalCommand(ticks, min(max(round(goal.speed_radps / VELOCITY_UNIT_RADPS), 1), 1023))


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
