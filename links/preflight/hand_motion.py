"""Motions of the drone by hand: whether the autopilot measures the requested motion with the right sign.

Only this detects an autopilot with a rotated body frame, as by a wrong AHRS_ORIENTATION, because its messages are
consistent with each other.

Drone axes are x forward, y left, z up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from links.preflight.check_result import CheckResult, fail, ok
from stages.geometry.frames import Array64
from stages.messages import DroneAttitude, DroneOdometry

MIN_RAD = np.radians(15.0)
Rotated = DroneAttitude | DroneOdometry


def nose_down_rad(rotations: Array64) -> Array64:
    """Angle of the nose below the horizon, for rotations R_odom_drone (n, 3, 3)."""
    return np.arcsin(np.clip(-rotations[:, 2, 0], -1.0, 1.0))


def right_down_rad(rotations: Array64) -> Array64:
    """Angle of the right side below the horizon: the left axis rises."""
    return np.arcsin(np.clip(rotations[:, 2, 1], -1.0, 1.0))


def turned_left_rad(rotations: Array64) -> Array64:
    """Yaw since the first rotation, counter-clockwise seen from above."""
    return np.unwrap(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))


@dataclass(frozen=True, slots=True)
class HandMotion:
    """One requested motion."""

    instruction: str
    name: str
    measure: Callable[[Array64], Array64] | None  # increases with the motion; None: checked by the paths


MOTIONS = (
    HandMotion("Tip the drone's nose DOWN by about 30 degrees, then level it again.", "nose down", nose_down_rad),
    HandMotion("Tip its RIGHT side down by about 30 degrees, then level it again.", "right side down", right_down_rad),
    HandMotion(
        "Turn it to the LEFT by about 90 degrees (counter-clockwise seen from above).", "turn left", turned_left_rad
    ),
    HandMotion(
        "Move it in a circle of 3 m diameter in view of the LiDAR, and lift it by 1 m meanwhile.", "circle", None
    ),
)


def check_motion(motion: HandMotion, attitudes: Sequence[Rotated]) -> CheckResult:
    """Whether the attitudes during a motion show the requested motion, relative to the first attitude."""
    name = f"by hand: {motion.name}"
    assert motion.measure is not None
    if len(attitudes) < 2:
        return fail(name, "no attitude was received meanwhile: check the autopilot's link")
    rotations = np.array([m.R_odom_drone for m in attitudes])
    right, wrong = _peaks(motion.measure(rotations))
    if max(right, wrong) >= MIN_RAD:
        measured_deg = np.degrees(right if right >= wrong else -wrong)
        if right >= wrong:
            return ok(name, f"measured {measured_deg:.0f} deg")
        return fail(
            name, f"measured {measured_deg:.0f} deg, the opposite: check AHRS_ORIENTATION (PX4: SENS_BOARD_ROT)"
        )
    for other in MOTIONS:
        if other.measure is not None and other is not motion:
            peak = max(_peaks(other.measure(rotations)))
            if peak >= MIN_RAD:
                return fail(
                    name,
                    f"measured '{other.name}' or its opposite, {np.degrees(peak):.0f} deg, instead: check "
                    "AHRS_ORIENTATION (PX4: SENS_BOARD_ROT), and that the motion was as requested",
                )
    return fail(
        name, "no such motion measured: was it moved, and is this drone's autopilot connected? Or use --no-motion"
    )


def _peaks(angles_rad: Array64) -> tuple[float, float]:
    """Maximum increase and decrease of the angle from its first value."""
    return float(angles_rad.max() - angles_rad[0]), float(angles_rad[0] - angles_rad.min())
