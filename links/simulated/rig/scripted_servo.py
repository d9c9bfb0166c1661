"""The script of the servo: it sweeps from end to end, then vibrates about the drone or about given azimuths.

Source: P III.A (sweep at 11.4 rpm over 180 deg) and P III.C (vibration at 57.2 rpm, +-5 deg). With `follow_drone` the
script aims at the true azimuth, with latency and a random error: it replaces the method's aiming. The script reads the
servo only, so a slow servo makes it longer.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from flow.stage import StrictModel
from links.simulated.sensors.servo import RPM_RADPS

ARRIVED_RAD = np.radians(0.5)  # distance from the goal at which the script reverses


class SweepSegment(StrictModel):
    """Turn from one end of the travel to the other, `times` times."""

    do: Literal["sweep"] = "sweep"
    times: int = Field(default=1, ge=1)
    speed_rpm: float = Field(default=11.4, gt=0)
    ends_deg: tuple[float, float] = (0.0, 180.0)


class VibrateSegment(StrictModel):
    """Swing about an azimuth: that of the drone, or of a table (t_s since the start of the segment, azimuth_deg)."""

    do: Literal["vibrate"] = "vibrate"
    duration_s: float = Field(gt=0)
    half_angle_deg: float = Field(default=5.0, gt=0, le=90)
    speed_rpm: float = Field(default=57.2, gt=0)
    follow_drone: bool = False
    azimuth_table: tuple[tuple[float, float], ...] = ()
    aim_latency_s: float = Field(default=0.15, ge=0)
    aim_error_deg: float = Field(default=0.7, ge=0)  # one sigma, drawn for every swing

    @model_validator(mode="after")
    def _one_aim(self) -> Self:
        if self.follow_drone == bool(self.azimuth_table):
            raise ValueError("vibrate: give either follow_drone: true or an azimuth_table")
        times = [t for t, _ in self.azimuth_table]
        if any(b <= a for a, b in pairwise(times)):
            raise ValueError("vibrate.azimuth_table: times must increase")
        return self


Segment = Annotated[SweepSegment | VibrateSegment, Field(discriminator="do")]


class ServoScript:
    """Executes the segments of the script; after the last one it leaves the servo alone."""

    def __init__(
        self, script: tuple[Segment, ...], drone_servo_rad: Callable[[float], float] | None, seed: int
    ) -> None:
        """drone_servo_rad: servo angle that puts the drone in the scan plane at a time [s]; None without a drone."""
        self._script = list(script)
        self._drone_servo_rad = drone_servo_rad
        self._rng = np.random.default_rng([seed, 4])
        self._goal_rad: float | None = None
        self._start_s = 0.0
        self._swings = 0

    def decide(self, time_s: float, position_rad: float) -> tuple[float, float] | None:
        """See `servo.ServoCommander`."""
        if self._script and self._is_finished(time_s, position_rad):
            self._script.pop(0)
            self._goal_rad, self._start_s, self._swings = None, time_s, 0
        if not self._script or (self._goal_rad is not None and not self._has_arrived(position_rad)):
            return None
        segment = self._script[0]
        if isinstance(segment, SweepSegment):
            ends = np.radians(segment.ends_deg)
            if self._swings == 0 and abs(position_rad - ends[1]) < abs(position_rad - ends[0]):
                ends = ends[::-1]
            goal_rad = float(ends[(self._swings + 1) % 2])
        else:
            side = 1 if self._swings % 2 == 0 else -1
            goal_rad = self._aim(segment, time_s) + side * float(np.radians(segment.half_angle_deg))
        self._swings += 1
        self._goal_rad = goal_rad
        return goal_rad, segment.speed_rpm * RPM_RADPS

    def _has_arrived(self, position_rad: float) -> bool:
        return self._goal_rad is not None and abs(position_rad - self._goal_rad) < ARRIVED_RAD

    def _is_finished(self, time_s: float, position_rad: float) -> bool:
        segment = self._script[0]
        if isinstance(segment, SweepSegment):
            return self._swings >= segment.times and self._has_arrived(position_rad)
        return time_s - self._start_s >= segment.duration_s

    def _aim(self, segment: VibrateSegment, time_s: float) -> float:
        if not segment.follow_drone:
            table = np.array(segment.azimuth_table)
            return float(np.radians(np.interp(time_s - self._start_s, table[:, 0], table[:, 1])))
        if self._drone_servo_rad is None:
            raise LookupError("follow_drone needs a drone")
        error = float(np.radians(segment.aim_error_deg) * self._rng.normal())
        return self._drone_servo_rad(time_s - segment.aim_latency_s) + error
