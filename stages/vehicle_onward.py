"""A vehicle past its last word: on as it went, for a while, and less sure the longer nobody tells.

    off by   a t^2 / 2 in place,   alpha t^2 / 2 in its turn        t since the last word

Its speed is that of a tenth of a second or more: words that arrive together would make a parked vehicle race.
Three go on past a word, each as far as an error of its own costs:

    VehicleTrail (trail.py)     TRAIL_S, straight on; USUAL. Asked at every slice, and the next word, which comes soon,
                                takes the error back
    VehicleMotionChoice (ego)   JOINT_S, along its bend; UNTOLD. Another source is laid on there: the error stays
    VehicleEgo (ego)            to the next picture, straight on; UNTOLD, and a turn at any usual rate: how it turned is
                                what its pictures would have told

A word that is farther off than HARD lets it be is false (stages/fuse/motions.py).

Source: ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.messages import VehicleMotion
from stages.rotation import exp_rotation, log_rotation

TRAIL_S = 0.3
JOINT_S = 1.0
LEAST_SPAN_NS = 100_000_000  # of the last motion, over which its speed is taken
MOST_SPAN_NS = 1_000_000_000


@dataclass(frozen=True)
class MayChange:
    """How hard a vehicle may speed up, brake or swerve while nobody tells."""

    acceleration_mps2: float
    turn_radps2: float

    def place_m(self, seconds: float) -> float:
        """How far that takes it from where it would be."""
        return 0.5 * self.acceleration_mps2 * seconds**2

    def turn_rad(self, seconds: float) -> float:
        """And how far it turns it."""
        return 0.5 * self.turn_radps2 * seconds**2


USUAL = MayChange(2.0, 0.2)  # one sigma, in traffic, from one word to the next
UNTOLD = MayChange(3.0, 0.5)  # one sigma, over a gap in which anything may begin
HARD = MayChange(6.0, 1.5)  # no vehicle on the road does much more: full braking, a swerve


def along_its_bend(told: list[VehicleMotion], stamp_ns: int) -> VehicleMotion:
    """Where the vehicle is some time after the last word (`told`, oldest first), less sure as UNTOLD says.

    Its speed and turn, in its own axes, are those over the last tenth of a second or more; after JOINT_S it is taken to
    stand where it is then, and what it is unsure by grows on.
    """
    last = told[-1]
    untold_s = (stamp_ns - last.stamp_ns) * 1e-9
    spans_ns = ((last.stamp_ns - m.stamp_ns, m) for m in reversed(told))
    span_ns, before = next(((span, m) for span, m in spans_ns if span >= LEAST_SPAN_NS), (0, last))
    share = min(untold_s, JOINT_S) / (span_ns * 1e-9) if 0 < span_ns <= MOST_SPAN_NS else 0.0
    R = last.R_start_vehicle
    turn = log_rotation(np.ascontiguousarray(before.R_start_vehicle.T @ R))
    way_m = exp_rotation(-0.5 * turn) @ before.R_start_vehicle.T @ (last.xyz_start_m - before.xyz_start_m)  # own axes
    unsure = np.diag([UNTOLD.turn_rad(untold_s) ** 2] * 3 + [UNTOLD.place_m(untold_s) ** 2] * 3)
    return VehicleMotion(
        stamp_ns=stamp_ns,
        xyz_start_m=last.xyz_start_m + R @ exp_rotation(0.5 * share * turn) @ (share * way_m),
        R_start_vehicle=R @ exp_rotation(share * turn),
        covariance=None if last.covariance is None else last.covariance + unsure,
    )
