"""Frozen vehicle odometry: poses that stay behind what the hardest braking would still have covered.

From a speed v a vehicle that brakes with a covers within t seconds at least

    v t - a t^2 / 2     for t <= v / a,     v^2 / (2 a) afterwards

v is the mean speed of an interval before, less what the hardest braking takes within half of it. Poses that cover less,
by more than a tolerance, do not come from a vehicle on its wheels: the source repeats a pose, or its wheels are locked.
The tolerance contains three sigma of the source's noise, which is measured: how far each pose is from the line between
its neighbours. A slow vehicle can stop within the tolerance, so nothing is detected below about 2.5 m/s, and a
parked vehicle never.

Source: ours; 9 m/s^2: full braking on dry asphalt, friction 0.9 (R. Rajamani, Vehicle Dynamics and Control, ch. 13).
"""

from __future__ import annotations

import math
from collections import deque

from stages.geometry.frames import Array64
from stages.sums import sum_in_order

BRAKING_MPS2 = 9.0
TOLERANCE_M = 0.1
LATE_S = 0.01  # constant error of timestamps
NOISE_SIGMAS = 3.0
NOISE_SHARE = 0.05  # of a pose in the measured noise
LARGEST, FINEST_M = 9.0, 0.005  # one pose counts at most as LARGEST times the noise, and FINEST_M: a stop is no noise
SPEED_NS = 100_000_000  # shortest interval over which a speed is averaged
LOOK_BACK_NS = 300_000_000  # from a pose to the one whose speed is tested
KEPT_NS = 600_000_000
MOVED_M = 0.1  # a source that moves by this much after it was detected is no longer frozen


Point = tuple[float, float, float]


class ImpossibleStop:
    """Tests the positions of one source, in one start frame."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, Point]] = deque()  # stamp, position
        self._frozen_m: Point | None = None
        self._noise_m2 = 0.0  # variance of a position, sum over the axes

    def is_frozen_at(self, xyz_m: Array64) -> bool:
        """Whether the source is frozen and still at this position."""
        frozen_m = self._frozen_m
        return frozen_m is not None and math.dist(xyz_m, frozen_m) <= MOVED_M

    def restart(self) -> None:
        """Forget all positions: the source has a new start frame."""
        self._poses.clear()
        self._frozen_m = None

    def add(self, stamp_ns: int, xyz_m: Array64) -> int | None:
        """Add a position, newer than the last and not of a frozen source.

        Returns the stamp of the last credible position when the source has just frozen.
        """
        if self._frozen_m is not None:
            self.restart()
        poses, point = self._poses, (float(xyz_m[0]), float(xyz_m[1]), float(xyz_m[2]))
        poses.append((stamp_ns, point))
        while stamp_ns - poses[0][0] > KEPT_NS:
            poses.popleft()
        self._measure_noise()
        credible_ns = self._last_credible_ns()
        if credible_ns is not None:
            self._frozen_m = point
        return credible_ns

    def _measure_noise(self) -> None:
        if len(self._poses) < 3:
            return
        (t0, x0), (t1, x1), (t2, x2) = self._poses[-3], self._poses[-2], self._poses[-1]
        share = (t1 - t0) / (t2 - t0)
        off_m2 = sum_in_order((b - a - share * (c - a)) ** 2 for a, b, c in zip(x0, x1, x2, strict=True))
        variance_m2 = off_m2 / (1.0 + share**2 + (1.0 - share) ** 2)
        largest_m2 = LARGEST * self._noise_m2 + FINEST_M**2
        self._noise_m2 += NOISE_SHARE * (min(variance_m2, largest_m2) - self._noise_m2)

    def _last_credible_ns(self) -> int | None:
        poses = list(self._poses)
        now_ns, now_m = poses[-1]
        before = len(poses) - 1
        for at in range(len(poses) - 2, 0, -1):
            then_ns, then_m = poses[at]
            if now_ns - then_ns > LOOK_BACK_NS:
                break
            before = min(before, at)
            while before >= 0 and then_ns - poses[before][0] < SPEED_NS:
                before -= 1
            if before < 0:
                break
            span_s, seconds = (then_ns - poses[before][0]) * 1e-9, (now_ns - then_ns) * 1e-9
            mean_mps = math.dist(then_m, poses[before][1]) / span_s
            speed_mps = max(mean_mps - 0.5 * BRAKING_MPS2 * span_s, 0.0)
            noise_m = NOISE_SIGMAS * math.sqrt(self._noise_m2) * (1.0 + math.sqrt(2.0) * seconds / span_s)
            least_m = least_path_m(speed_mps, seconds) - TOLERANCE_M - LATE_S * mean_mps - noise_m
            if math.dist(now_m, then_m) < least_m:
                return then_ns
        return None


def least_path_m(speed_mps: float, seconds: float) -> float:
    """Path [m] that a vehicle covers at least within a time, braking as hard as it can."""
    braked_s = min(seconds, speed_mps / BRAKING_MPS2)
    return speed_mps * braked_s - 0.5 * BRAKING_MPS2 * braked_s**2
