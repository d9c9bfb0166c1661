"""The drone moved by hand as a person is told: does the autopilot say the same motion, with the right sign?

Only this finds an autopilot whose whole body frame is turned, as by AHRS_ORIENTATION: its messages agree with each
other all the same.

Source: ours; drone axes are x forward, y left, z up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from links.preflight.verdict import Verdict, fail, ok
from stages.geometry.frames import Array64
from stages.messages import DroneAttitude, DroneOdometry

ENOUGH_RAD = np.radians(15.0)
Rotated = DroneAttitude | DroneOdometry


def nose_down_rad(rotations: Array64) -> Array64:
    """How far the nose points below the horizon, for rotations R_odom_drone (n, 3, 3)."""
    return np.arcsin(np.clip(-rotations[:, 2, 0], -1.0, 1.0))


def right_down_rad(rotations: Array64) -> Array64:
    """How far the right side points below the horizon: the left axis rises."""
    return np.arcsin(np.clip(rotations[:, 2, 1], -1.0, 1.0))


def turned_left_rad(rotations: Array64) -> Array64:
    """How far it has turned left since the first, counter-clockwise seen from above."""
    return np.unwrap(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))


@dataclass(frozen=True, slots=True)
class Step:
    """One motion that is asked for."""

    ask: str
    what: str
    measure: Callable[[Array64], Array64] | None  # grows with the motion; None: judged by the paths


STEPS = (
    Step("Tip the drone's nose DOWN by about 30 degrees, then level it again.", "nose down", nose_down_rad),
    Step("Tip its RIGHT side down by about 30 degrees, then level it again.", "right side down", right_down_rad),
    Step("Turn it to the LEFT by about 90 degrees (counter-clockwise seen from above).", "turn left", turned_left_rad),
    Step("Carry it in a circle 3 m across where the LiDAR sees it, and lift it by 1 m on the way.", "carry", None),
)


def hand_check(step: Step, rotated: Sequence[Rotated]) -> Verdict:
    """Whether the attitudes during a step tell the motion that was asked for, against where they began."""
    name = f"by hand: {step.what}"
    assert step.measure is not None
    if len(rotated) < 2:
        return fail(name, "no attitude came meanwhile: check the autopilot's link")
    rotations = np.array([m.R_odom_drone for m in rotated])
    right, wrong = _peaks(step.measure(rotations))
    if max(right, wrong) >= ENOUGH_RAD:
        told = np.degrees(right if right >= wrong else -wrong)
        if right >= wrong:
            return ok(name, f"it told {told:.0f} deg")
        return fail(name, f"it told {told:.0f} deg, the opposite: check AHRS_ORIENTATION (PX4: SENS_BOARD_ROT)")
    for other in STEPS:
        if other.measure is not None and other is not step:
            peak = max(_peaks(other.measure(rotations)))
            if peak >= ENOUGH_RAD:
                return fail(
                    name,
                    f"it told '{other.what}' or its opposite, {np.degrees(peak):.0f} deg, instead: check "
                    "AHRS_ORIENTATION (PX4: SENS_BOARD_ROT), and that you did as told",
                )
    return fail(name, "it told no such motion: was it moved, and is this drone's autopilot connected? Or --no-motion")


def _peaks(angles_rad: Array64) -> tuple[float, float]:
    """How far the angle went up and down from where it began."""
    return float(angles_rad.max() - angles_rad[0]), float(angles_rad[0] - angles_rad.min())
