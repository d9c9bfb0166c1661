"""Aim: there and back over the whole travel, slowly and fast by turns. What `grd calibrate` asks for.

Seen on the way there and on the way back a wall tells the gear's play, at two speeds the servo's clock; see
`stages/calibration/result.py`.

Source: ours, for P III.A.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import Field, model_validator

from flow.stage import Settings, Stage
from stages.aim.sweeping import Sweeping
from stages.aim.vibrate import RPM_RADPS
from stages.geometry.frames import LidarMount
from stages.messages import ServoGoal, ServoState

Rpm = Annotated[float, Field(gt=0, le=120)]


class CalibrationSweepSettings(Settings):
    """Settings of `CalibrationSweep`."""

    mount: LidarMount
    travel_deg: tuple[float, float] = (0.0, 180.0)  # servo positions
    speeds_rpm: tuple[Rpm, ...] = Field((11.4, 45.0), min_length=1)  # each for a way there and back

    @model_validator(mode="after")
    def _settings_agree(self) -> CalibrationSweepSettings:
        low, high = self.travel_deg
        if not low < high:
            raise ValueError("travel_deg must be two growing angles")
        return self


class CalibrationSweep(Stage[CalibrationSweepSettings]):
    """To each end of the travel in turn; a servo that comes no nearer, at a limit or in a stall, turns round there."""

    def __init__(self, settings: CalibrationSweepSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._ways: int = 0
        low, high = self.settings.travel_deg
        self._sweeping = Sweeping(math.radians(low), math.radians(high))

    def on_servo(self, servo: ServoState) -> ServoGoal | None:
        """The other end once this one is reached, else None. Never a goal for a LiDAR bolted down."""
        settings = self.settings
        if not settings.mount.turns:
            return None
        radps = settings.speeds_rpm[self._ways // 2 % len(settings.speeds_rpm)] * RPM_RADPS
        goal = self._sweeping.goal(servo.stamp_ns, servo.position_rad, radps, None)
        if goal is None:
            return None
        self._ways += 1
        return ServoGoal(stamp_ns=servo.stamp_ns, position_rad=goal[0], speed_radps=goal[1])
