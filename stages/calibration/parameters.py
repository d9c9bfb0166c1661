"""What a calibration may find, in what units people read it, and how sure it must be to be told.

Source: ours. Floors are from simulated scenes. The limits are what matters at the drone: 0.05 deg is 26 mm at 30 m,
0.2 ms at 57 rpm the same at 20 m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from stages.calibration.servo_mount import ORDERS

DEG = math.pi / 180


@dataclass(frozen=True)
class Parameter:
    """One number. Inside it is in rad, m or s; `unit` and `per_unit` are for people."""

    name: str
    what: str
    unit: str
    per_unit: float  # inside value of one `unit`
    expected: float  # [unit] how far off a rig may be, one sigma, before anything is seen
    limit: float  # [unit] a larger sigma is refused
    floor: float = 0.0  # [unit] one sigma of what walls that are no planes leave, however long one looks


PARAMETERS: tuple[Parameter, ...] = (
    Parameter("tilt_x", "LiDAR's tilt about the turntable's x", "deg", DEG, 1.0, 0.05, 0.0005),
    Parameter("tilt_y", "LiDAR's tilt about the turntable's y", "deg", DEG, 1.0, 0.05, 0.0005),
    Parameter("axis_x", "LiDAR's place from the servo's axis, x", "mm", 1e-3, 30.0, 5.0, 0.7),
    Parameter("axis_y", "LiDAR's place from the servo's axis, y", "mm", 1e-3, 30.0, 5.0, 0.7),
    *(
        Parameter(f"{part[:3]}_{order}", f"encoder's error, {part} of order {order}", "deg", DEG, 0.5, 0.05, 0.003)
        for order in ORDERS
        for part in ("sine", "cosine")
    ),
    Parameter("play", "play of the gear, end to end", "deg", DEG, 0.5, 0.05, 0.002),
    Parameter("time", "servo's time offset", "ms", 1e-3, 20.0, 0.2, 0.01),
    Parameter("zero", "servo's zero", "deg", DEG, 5.0, 0.05),
)
