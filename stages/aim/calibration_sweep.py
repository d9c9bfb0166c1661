"""Aim: there and back over the whole travel, slowly and fast by turns. What `grd calibrate` asks for.

Seen on the way there and on the way back a wall tells the gear's play, at two speeds the servo's clock; see
`stages/calibration/verdict.py`.

Source: ours, for P III.A.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import Field, PrivateAttr

from flow.stage import Stage
from stages.aim.sweeping import Sweeping
from stages.aim.vibrate import RPM_RADPS
from stages.geometry import LidarMount
from stages.messages import ServoGoal, ServoState

Rpm = Annotated[float, Field(gt=0, le=120)]


class CalibrationSweep(Stage):
    """To each end of the travel in turn; a servo that comes no nearer, at a limit or in a stall, turns round there."""

    mount: LidarMount
    travel_deg: tuple[float, float] = (0.0, 180.0)  # servo positions
    speeds_rpm: tuple[Rpm, ...] = Field((11.4, 45.0), min_length=1)  # each for a way there and back

    _sweeping: Sweeping = PrivateAttr()
    _ways: int = PrivateAttr(default=0)

    def model_post_init(self, context: Any, /) -> None:
        low, high = self.travel_deg
        if not low < high:
            raise ValueError("travel_deg must be two growing angles")
        self._sweeping = Sweeping(math.radians(low), math.radians(high))

    def on_servo(self, servo: ServoState) -> ServoGoal | None:
        """The other end once this one is reached, else None. Never a goal for a LiDAR bolted down."""
        if not self.mount.turns:
            return None
        radps = self.speeds_rpm[self._ways // 2 % len(self.speeds_rpm)] * RPM_RADPS
        goal = self._sweeping.goal(servo.stamp_ns, servo.position_rad, radps, None)
        if goal is None:
            return None
        self._ways += 1
        return ServoGoal(stamp_ns=servo.stamp_ns, position_rad=goal[0], speed_radps=goal[1])
