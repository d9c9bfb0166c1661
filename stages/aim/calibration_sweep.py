"""Sweep for `grd calibrate`: back and forth over the whole travel, alternately slow and fast.

A wall that is observed in both directions determines the gear's backlash, and at two speeds the servo's clock offset;
see `stages/calibration/result.py`.

Source: ours, for P III.A.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import Field, model_validator

from flow.stage import Settings, Stage
from stages.aim.sweep_trajectory import SweepTrajectory
from stages.aim.vibrate import RPM_RADPS
from stages.geometry.frames import LidarMount
from stages.messages import ServoGoal, ServoState

Rpm = Annotated[float, Field(gt=0, le=120)]


class CalibrationSweepSettings(Settings):
    """Settings of `CalibrationSweep`."""

    mount: LidarMount  # poses of turntable and LiDAR, and the servo's zero, sign and errors
    travel_deg: tuple[float, float] = (0.0, 180.0)  # servo positions between which to sweep
    speeds_rpm: tuple[Rpm, ...] = Field((11.4, 45.0), min_length=1)  # each for one sweep forth and back, in turn

    @model_validator(mode="after")
    def _settings_agree(self) -> CalibrationSweepSettings:
        low, high = self.travel_deg
        if not low < high:
            raise ValueError("travel_deg must be two increasing angles")
        return self


class CalibrationSweep(Stage[CalibrationSweepSettings]):
    """Sweeps between the ends of the travel. A servo that stalls before an end reverses there."""

    def __init__(self, settings: CalibrationSweepSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._goals: int = 0  # sent so far
        low, high = self.settings.travel_deg
        self._sweep = SweepTrajectory(math.radians(low), math.radians(high))

    def on_servo(self, servo: ServoState) -> ServoGoal | None:
        """The other end once this one is reached, else None. No goal for a LiDAR that does not turn."""
        settings = self.settings
        if not settings.mount.turns:
            return None
        speed_radps = settings.speeds_rpm[self._goals // 2 % len(settings.speeds_rpm)] * RPM_RADPS
        goal = self._sweep.goal(servo.stamp_ns, servo.position_rad, speed_radps, None)
        if goal is None:
            return None
        self._goals += 1
        return ServoGoal(stamp_ns=servo.stamp_ns, position_rad=goal[0], speed_radps=goal[1])
