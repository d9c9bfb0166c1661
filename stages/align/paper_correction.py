"""Correction of yaw by motion: the directions of flight by LiDAR and by the drone's camera must agree about Z.

    f_hat = R_G R_GD0 dt_DD(i, j)          the camera's direction of motion (5-point), under the rotation so far
    f     = t_D(j) - t_D(i),   t_D = R_G t_GD + t_G                                     displacement by LiDAR
    j - i = 14 images, |f| >= 1 m; the last 7 of each, all within 30 deg of their sum, are summed
    R_f   = rotation about Z that takes XY(sum f_hat) to XY(sum f)
    R_GD  = R_G^-1 R_f R_G R_GD0

The camera does not measure length: f_hat has the length of f. Steps of the odometry shorter than 14 images are chained,
each with its length by LiDAR. R_G and t_G are the vehicle's odometry; without it the vehicle is assumed stationary. A
sum steeper than 60 deg has no usable heading about Z, so there is no correction (ours).

Source: P V.E, V.C; DESIGN, The paper's formulas. Interpolation between fixes is ours.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.geometry.frames import Array64
from stages.geometry.trajectory import VehicleTrajectory
from stages.kernels.geometry.so3 import nearest_rotation
from stages.messages import DroneFix, VehicleMotion, VisualMotion

KEPT = 256  # images, fixes, motions
FIX_GAP_NS = 500_000_000  # no interpolation between fixes with a larger gap
WAITS_NS = 1_000_000_000  # longest wait for the fix after an image
LEVEL_AT_LEAST = 0.5  # least horizontal part of a sum


@dataclass(frozen=True, slots=True)
class CorrectionRule:
    """Parameters of the correction in the paper."""

    images_apart: int = 14  # j - i
    shortest_m: float = 1.0  # |f|
    last: int = 7
    cone_rad: float = math.radians(30.0)


class MotionCorrection:
    """Collects fixes, motions and rotations; `turn_rad` is R_f's angle when the last seven agree."""

    def __init__(self, rule: CorrectionRule) -> None:
        self._rule = rule
        self.trail = VehicleTrajectory()
        self._fixes: deque[tuple[int, Array64]] = deque(maxlen=KEPT)
        self._track_id: int | None = None
        self._images: deque[int] = deque(maxlen=KEPT)  # stamps of the drone's
        self._rotations: dict[int, Array64] = {}  # R_GD0 at the drone's images
        self._motions: dict[int, VisualMotion] = {}  # by the later image
        self._waiting: deque[VisualMotion] = deque(maxlen=KEPT)
        self._pairs: deque[tuple[Array64, Array64]] = deque(maxlen=rule.last)  # f_hat, f
        self._has_new_pair = False  # since the last call of turn_rad

    def add_fix(self, fix: DroneFix) -> None:
        """Add a LiDAR position; another track restarts, a fix that is not newer is ignored."""
        if fix.track_id != self._track_id:
            self._fixes.clear()
            self._track_id = fix.track_id
        if not self._fixes or fix.stamp_ns > self._fixes[-1][0]:
            self._fixes.append((fix.stamp_ns, fix.xyz_vehicle_m))

    def add_vehicle(self, motion: VehicleMotion) -> None:
        """Add a pose of the vehicle."""
        self.trail.add(motion)

    def add_motion(self, motion: VisualMotion) -> None:
        """Add the motion of the drone between two images."""
        self._motions[motion.stamp_ns] = motion
        _drop_oldest(self._motions)
        self._waiting.append(motion)

    def add_image(self, stamp_ns: int, R_vehicle_drone: Array64 | None) -> None:
        """Add an image of the drone with R_GD0 at its time; None: not known yet."""
        if not self._images or stamp_ns > self._images[-1]:
            self._images.append(stamp_ns)
        if R_vehicle_drone is not None:
            self._rotations[stamp_ns] = R_vehicle_drone
            _drop_oldest(self._rotations)

    def restart(self) -> None:
        """Drop the pairs that were computed with a wrong rotation."""
        self._pairs.clear()
        self._rotations.clear()

    def turn_rad(self) -> float | None:
        """Angle of R_f [rad]; None: too little motion, the pairs disagree, or none is new since the last call."""
        self._pair_motions()
        has_new_pair, self._has_new_pair = self._has_new_pair, False
        if not has_new_pair or len(self._pairs) < self._rule.last:
            return None
        f_hat, f = (np.stack(side) for side in zip(*self._pairs, strict=True))
        if not (self._agree(f_hat) and self._agree(f)):
            return None
        return heading_change_rad(f_hat.sum(axis=0), f.sum(axis=0))

    def _agree(self, vectors: Array64) -> bool:
        total = vectors.sum(axis=0)
        size = np.linalg.norm(vectors, axis=1) * np.linalg.norm(total)
        return bool((vectors @ total >= math.cos(self._rule.cone_rad) * size).all())

    def _pair_motions(self) -> None:
        """Pair all motions whose later image is known and precedes a fix; the others wait for WAITS_NS."""
        fixed_ns = self._fixes[-1][0] if self._fixes else 0
        paired_ns = self._images[-1] if self._images else 0
        while self._waiting:
            motion = self._waiting[0]
            late = max(fixed_ns, paired_ns) - motion.stamp_ns > WAITS_NS
            if min(fixed_ns, paired_ns) < motion.stamp_ns and not late:
                return
            self._waiting.popleft()
            pair = self._pair(motion)
            if pair is not None:
                self._pairs.append(pair)
                self._has_new_pair = True

    def _pair(self, motion: VisualMotion) -> tuple[Array64, Array64] | None:
        """(f_hat, f) of the chain of motions that ends with this one; None: unknown, or too short."""
        chain = self._chain(motion)
        if chain is None:
            return None
        first_ns, positions = chain[0].from_ns, [self._position(chain[0].from_ns)]
        positions += [self._position(step.stamp_ns) for step in chain]
        known = [position for position in positions if position is not None]
        R_GD0 = self._rotations.get(first_ns)
        if len(known) < len(positions) or R_GD0 is None:
            return None
        f = known[-1] - known[0]
        if float(np.linalg.norm(f)) < self._rule.shortest_m:
            return None
        dt, turned = np.zeros(3), np.eye(3)  # R_i_k
        for step, start, end in zip(chain, known[:-1], known[1:], strict=True):
            if step.direction_from is not None:
                dt += turned @ step.direction_from * float(np.linalg.norm(end - start))
            turned = nearest_rotation(turned @ step.R_from_to)
        length = float(np.linalg.norm(dt))
        if length < 1e-6:
            return None
        f_hat = self.trail.at(first_ns)[0] @ R_GD0 @ dt
        return f_hat * float(np.linalg.norm(f)) / length, f

    def _chain(self, motion: VisualMotion) -> list[VisualMotion] | None:
        """Consecutive motions over `images_apart` images of the drone; None: one is missing."""
        chain = [motion]
        while self._images_between(chain[0].from_ns, motion.stamp_ns) < self._rule.images_apart:
            before = self._motions.get(chain[0].from_ns)
            if before is None or before.from_ns >= before.stamp_ns:
                return None
            chain.insert(0, before)
        return chain

    def _images_between(self, from_ns: int, to_ns: int) -> int:
        """j - i of the images at two times."""
        return bisect_right(self._images, to_ns) - bisect_right(self._images, from_ns)

    def _position(self, stamp_ns: int) -> Array64 | None:
        """t_D (3,) = R_G t_GD + t_G, interpolated between two fixes; None: no fixes near enough."""
        after = bisect_left(self._fixes, stamp_ns, key=lambda entry: entry[0])
        if after == len(self._fixes):
            return None
        later_ns, later = self._fixes[after]
        if later_ns == stamp_ns:
            t_GD = later
        elif after == 0 or later_ns - self._fixes[after - 1][0] > FIX_GAP_NS:
            return None
        else:
            earlier_ns, earlier = self._fixes[after - 1]
            t_GD = earlier + (stamp_ns - earlier_ns) / (later_ns - earlier_ns) * (later - earlier)
        R_G, t_G = self.trail.at(stamp_ns)
        return R_G @ t_GD + t_G


def heading_change_rad(f_hat: Array64, f: Array64) -> float | None:
    """Angle about Z from XY(f_hat) to XY(f), (-pi, pi]; None where either is too steep."""
    for vector in (f_hat, f):
        if math.hypot(vector[0], vector[1]) < LEVEL_AT_LEAST * float(np.linalg.norm(vector)):
            return None
    return math.atan2(f_hat[0] * f[1] - f_hat[1] * f[0], f_hat[0] * f[0] + f_hat[1] * f[1])


def _drop_oldest(kept: dict[int, Any]) -> None:
    while len(kept) > KEPT:
        del kept[next(iter(kept))]
