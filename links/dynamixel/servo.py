"""The servo as a link: states in, one JSON object per exchange, and goals out in the servo's units.

Live, a separate process communicates with the servo (`links.dynamixel.worker`); a state's stamp is the middle of the
exchange. A goal beyond the soft limits, or faster than the speed limit, is clamped and counted. In replay nothing is
sent: the recorded states are used. In closed loop the simulated servo executes `take_command`.

Source: recording format in recordings/README.md (/servo/state). Units: ROBOTIS e-manual, MX-28AR(2.0), see
links/dynamixel/mx28.py (goal position 4096 steps a turn, profile velocity in units of 0.229 rpm, 0 means no limit).
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from pydantic import Field, model_validator

from flow.counters import Counters
from flow.link import PolledRecords, Record, Source, SourceSettings
from links.dynamixel import wire
from links.dynamixel.drive import DriveSettings
from links.dynamixel.mx28 import (
    NO_LOAD_RPM,
    STEPS_PER_TURN,
    TICK_RAD,
    VELOCITY_UNIT_RADPS,
    VELOCITY_UNIT_RPM,
    named_errors,
)
from links.dynamixel.readings import Readings, ServoHealth
from stages.messages import ServoGoal, ServoState

MAX_STATE_BYTES = 1_000

Baud = Literal[57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000]


@dataclass(frozen=True, slots=True)
class GoalCommand:
    """Values of the registers Goal Position and Profile Velocity."""

    position_ticks: int  # 0..4095, position control mode
    velocity_units: int  # 1..1023

    @property
    def position_rad(self) -> float:
        """The goal after rounding to the servo's units."""
        return self.position_ticks * TICK_RAD

    @property
    def speed_radps(self) -> float:
        """The speed after rounding to the servo's units."""
        return self.velocity_units * VELOCITY_UNIT_RADPS


class ServoSettings(SourceSettings):
    """Settings of `Servo`."""

    topic: str = "/servo/state"
    port: str = "/dev/ttyUSB0"  # better a persistent name: /dev/serial/by-id/...
    baud: Baud = 1_000_000
    servo_id: int = Field(1, ge=0, le=252)
    rate_hz: float = Field(250.0, ge=10, le=500)  # block reads
    limits_deg: tuple[float, float] = (0.0, 180.0)  # soft limits of goals, in the servo's own angle
    speed_limit_rpm: float = Field(NO_LOAD_RPM, ge=1, le=200)  # an MX-28 reaches 55 rpm at 12 V
    goal_slack_s: float = Field(0.5, gt=0, le=10)  # a goal not reached this long after its expected travel time: stop
    watchdog_s: float = Field(0.1, ge=0.02, le=2.5)  # the servo stops by itself after this time without a request
    reply_timeout_s: float = Field(0.02, ge=0.002, le=0.1)
    start_timeout_s: float = Field(3.0, gt=0, le=60)  # until the first reply; later interruptions may last for any time
    write_settings: bool = False  # correct the servo's EEPROM (return delay, modes) instead of raising an error
    reboot: bool = True  # a servo that has shut down, for example after overload

    @model_validator(mode="after")
    def _settings_agree(self) -> ServoSettings:
        low, high = self.limits_deg
        if self.watchdog_s * self.rate_hz < 4:
            raise ValueError(
                "watchdog_s: must be at least four periods of rate_hz, or it stops a servo that is read in time"
            )
        if not 0.0 <= low < high <= 360.0:
            raise ValueError("limits_deg: must be two increasing angles within 0..360, one turn of the servo")
        return self


class Servo(Source[ServoSettings]):
    """The turntable's servo. A record without a valid state is counted in `rejected` and skipped."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"goal"})
    silent_after_s: ClassVar[float | None] = (
        2.0  # the process recovers from faults by itself, without records meanwhile
    )
    polled: ClassVar[bool] = True

    def __init__(self, settings: ServoSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._counts: Counter[str] = Counter()
        self._rejected: int = 0
        self._pending: GoalCommand | None = None
        self._readings: Readings | None = None
        self._health = ServoHealth()

    @property
    def rejected(self) -> int:
        """Number of records without a valid servo state."""
        return self._rejected

    @property
    def counters(self) -> Counters:
        """Totals since the start, and the newest `connected`, voltage and temperature."""
        totals, own = self._health.counters, dict(self._counts)
        totals = {**totals, **own, "goals_lost": totals["goals_lost"] + own.get("goals_lost", 0)}
        return Counters(totals, {"no servo state": self._rejected})

    @property
    def status(self) -> str | None:
        """See Link: that the servo has shut down or does not reply, after it had been set up."""
        health = self._health
        if self._readings is None or not health.is_lost:
            return None
        why = f"has shut down ({named_errors(health.error)})" if health.error else "does not reply, or lost its setup"
        action = (
            "it is set up again automatically"
            if self.settings.reboot or not health.error
            else "it needs a reboot (`reboot: false`)"
        )
        return f"the servo {why} and does not move: {action}; check its supply, its cable, and the load on its axis"

    def decode(self, record: Record) -> ServoState | None:
        """The state in `{"position_rad": 1.2, "velocity_radps": 0.0, "goal_rad": 1.3, "error": 0}`; None: invalid."""
        try:
            return parse_state(record.stamp_ns, record.data)
        except ValueError:
            self._rejected += 1
            return None

    def on_goal(self, goal: ServoGoal) -> None:
        """Live: send a goal at once, clamped to the limits. Otherwise keep the newest for `take_command`."""
        readings = self._readings
        if readings is None:
            self._pending = goal_command(goal)
            self._counts[NOT_LIVE] += 1
        elif not (math.isfinite(goal.position_rad) and math.isfinite(goal.speed_radps)):
            self._counts["goals rejected: not finite"] += 1
        elif not readings.send(self._within_limits(goal)):
            self._counts["goals_lost"] += 1

    def upstream_lost(self, port: str) -> str | None:
        """See Link: the aim stage has stopped; stop the servo instead of finishing its travel."""
        readings = self._readings
        if readings is None:
            return None
        self._counts["stops: no aim stage"] += 1
        return "the servo is stopped" if readings.send(wire.Stop()) else "the servo could not be stopped"

    def take_command(self) -> GoalCommand | None:
        """The newest goal that was not taken yet; None: none."""
        command, self._pending = self._pending, None
        return command

    @contextmanager
    def listen(self) -> Iterator[PolledRecords]:
        """Start the servo process: `with servo.listen() as records`; the end of the context stops the servo.

        Raises LinkError when the servo does not reply, or must not be driven. The process recovers from later faults
        and counts them; no records come meanwhile. When the records are not consumed for 0.5 s the servo is stopped.
        """
        self._readings = readings = Readings(self.settings.topic, self._drive_settings(), self._health)
        try:
            yield readings
        finally:
            self._readings = None
            readings.close()

    def _within_limits(self, goal: ServoGoal) -> wire.Goal:
        """The packet of a goal, clamped to the limits; a clamped goal is counted."""
        low, high = (math.radians(angle) for angle in self.settings.limits_deg)
        if not low - 0.5 * TICK_RAD <= goal.position_rad <= high + 0.5 * TICK_RAD:
            self._counts["goals clamped to limits_deg"] += 1
        low_ticks, high_ticks = self._limit_ticks()
        command = goal_command(goal)
        max_units = self._max_velocity_units()
        self._counts["goals clamped to speed_limit_rpm"] += command.velocity_units > max_units
        return wire.Goal(
            min(max(command.position_ticks, low_ticks), high_ticks), min(command.velocity_units, max_units)
        )

    def _limit_ticks(self) -> tuple[int, int]:
        low, high = (math.radians(angle) / TICK_RAD for angle in self.settings.limits_deg)
        return math.ceil(low - 1e-6), min(math.floor(high + 1e-6), STEPS_PER_TURN - 1)

    def _max_velocity_units(self) -> int:
        return max(math.floor(self.settings.speed_limit_rpm / VELOCITY_UNIT_RPM), 1)

    def _drive_settings(self) -> DriveSettings:
        settings = self.settings
        return DriveSettings(
            port=settings.port,
            servo_id=settings.servo_id,
            baud=settings.baud,
            limit_ticks=self._limit_ticks(),
            max_velocity_units=self._max_velocity_units(),
            watchdog_ms=round(1e3 * settings.watchdog_s),
            reply_timeout_ms=1e3 * settings.reply_timeout_s,
            goal_slack_ms=1e3 * settings.goal_slack_s,
            rate_hz=settings.rate_hz,
            start_s=settings.start_timeout_s,
            write_settings=settings.write_settings,
            reboot=settings.reboot,
        )


NOT_LIVE = "goals while not live"


def goal_command(goal: ServoGoal) -> GoalCommand:
    """A goal in the servo's units, within one turn; the speed is at least 1 unit, because 0 means no limit."""
    ticks = min(max(round(goal.position_rad / TICK_RAD), 0), 4095)
    return GoalCommand(ticks, min(max(round(goal.speed_radps / VELOCITY_UNIT_RADPS), 1), 1023))


def parse_state(stamp_ns: int, data: bytes) -> ServoState:
    """Parse one recorded state. Raises ValueError for invalid JSON and for missing or non-finite fields."""
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
