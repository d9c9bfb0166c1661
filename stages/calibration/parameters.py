"""Parameters of a calibration: display units, prior sigmas, and the limits of sigma for acceptance.

Source: ours. Floors are from simulated scenes. The limits follow from the error at the drone: 0.05 deg is 26 mm at
30 m, and so is 0.2 ms at 57 rpm at 20 m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from stages.calibration.servo_mount import ORDERS

DEG = math.pi / 180


@dataclass(frozen=True)
class Parameter:
    """One parameter, in rad, m or s internally; `unit` and `per_unit` are for display."""

    name: str
    what: str
    unit: str
    per_unit: float  # SI value of one `unit`
    expected: float  # [unit] prior sigma of the rig's value
    limit: float  # [unit] a larger sigma is rejected
    floor: float = 0.0  # [unit] systematic sigma from walls that are not planes


PARAMETERS: tuple[Parameter, ...] = (
    Parameter("tilt_x", "LiDAR's tilt about the turntable's x", "deg", DEG, 1.0, 0.05, 0.0005),
    Parameter("tilt_y", "LiDAR's tilt about the turntable's y", "deg", DEG, 1.0, 0.05, 0.0005),
    Parameter("axis_x", "LiDAR's offset from the servo's axis, x", "mm", 1e-3, 30.0, 5.0, 0.7),
    Parameter("axis_y", "LiDAR's offset from the servo's axis, y", "mm", 1e-3, 30.0, 5.0, 0.7),
    *(
        Parameter(f"{part[:3]}_{order}", f"encoder's error, {part} of order {order}", "deg", DEG, 0.5, 0.05, 0.003)
        for order in ORDERS
        for part in ("sine", "cosine")
    ),
    Parameter("play", "play of the gear, end to end", "deg", DEG, 0.5, 0.05, 0.002),
    Parameter("time", "servo's time offset", "ms", 1e-3, 20.0, 0.2, 0.01),
    Parameter("zero", "servo's zero", "deg", DEG, 5.0, 0.05),
)
