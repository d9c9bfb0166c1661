"""Sector of the servo's travel that a cue gives for the search, in turn with the whole travel.

The fan's middle plane has the normal n(angle) = Rz(angle) R_turntable_lidar e_z. The drone, at p with covariance P, is
within SIGMAS of the plane where

    | n . (p - p_lidar) | <= SIGMAS sqrt(n^T P n) + MARGIN_M

After `SECTOR_PASSES` passes of the sector without a track follows the whole travel, so that a wrong cue delays the
search but does not prevent it.

Source: ours, after search theory (Koopman, Search and Screening, 1946).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.geometry.frames import Array64, LidarMount

SIGMAS = 2.0
MARGIN_M = 1.0  # motion of the drone between two measurements
STEP_RAD = math.radians(1.0)
LEAST_RAD = math.radians(8.0)  # width of a sector: four spacings of a VLP-16's beams
MOST_SHARE = 0.7  # of the travel: a wider sector is the whole travel
SECTOR_PASSES, WHOLE_PASSES = 2, 2
OLDEST_NS = 1_500_000_000
CHANGED_RAD = math.radians(6.0)  # the sweep keeps its limits until they differ by more


@dataclass(slots=True, eq=False)
class SearchSector:
    """Chooses between the sector of the newest cue and the whole travel."""

    mount: LidarMount
    travel_rad: tuple[float, float]
    _source: str = ""  # of the newest cue
    _cue: tuple[int, Array64, Array64] | None = None  # stamp, position and covariance, frame vehicle
    _limits: tuple[float, float] | None = None
    _whole: bool = False
    _since_pass: int = 0

    def update(self, source: str, stamp_ns: int, xyz_vehicle_m: Array64, covariance_m2: Array64) -> None:
        """Newest position of the drone by a cue."""
        self._source, self._cue = source, (stamp_ns, xyz_vehicle_m, covariance_m2)

    def withdraw(self, source: str) -> None:
        """The cue of this source is not trusted."""
        if source == self._source:
            self._cue = None

    def limits(self, stamp_ns: int, passes: int) -> tuple[float, float]:
        """Servo positions [rad] to sweep between after so many passes of the sweep."""
        if self._cue is None or stamp_ns - self._cue[0] > OLDEST_NS:
            self._limits, self._whole, self._since_pass = None, False, passes
            return self.travel_rad
        if passes - self._since_pass >= (WHOLE_PASSES if self._whole else SECTOR_PASSES):
            self._whole, self._since_pass = not self._whole, passes
        found = sector_rad(self.mount, self.travel_rad, *self._cue[1:])
        if found is None or self._whole:
            self._limits = None
            return self.travel_rad
        before = self._limits
        if before is None or max(abs(found[0] - before[0]), abs(found[1] - before[1])) > CHANGED_RAD:
            self._limits = found
        return self._limits or found


def sector_rad(
    mount: LidarMount, travel_rad: tuple[float, float], xyz_vehicle_m: Array64, covariance_m2: Array64
) -> tuple[float, float] | None:
    """Servo positions (low, high) [rad] at which the drone may be near the fan's middle; None: nearly the whole travel.

    Of several such intervals, at both ends of the travel, the widest.
    """
    servo = np.arange(travel_rad[0], travel_rad[1] + STEP_RAD / 2, STEP_RAD)
    angle = mount.turntable_rad(servo)
    T, T_tl = mount.T_vehicle_turntable.matrix(), mount.T_turntable_lidar.matrix()
    p_turntable_m = T[:3, :3].T @ (xyz_vehicle_m - T[:3, 3])
    P = T[:3, :3].T @ covariance_m2 @ T[:3, :3]
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = T_tl[:3, 2]
    normal = np.column_stack([c * x - s * y, s * x + c * y, np.full(len(angle), z)])
    # the LiDAR's distance from the plane through the turntable's axis does not depend on the angle
    distance_m = np.abs(normal @ p_turntable_m - T_tl[:3, 2] @ T_tl[:3, 3])
    inside = distance_m <= SIGMAS * np.sqrt(np.einsum("ni,ij,nj->n", normal, P, normal)) + MARGIN_M
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(np.int64), [0]])))
    if not len(edges):
        return None
    first, end = max(edges.reshape(-1, 2).tolist(), key=lambda pair: pair[1] - pair[0])
    low, high = float(servo[first]), float(servo[end - 1])
    widen = max(LEAST_RAD - (high - low), 0.0) / 2
    low, high = max(low - widen, travel_rad[0]), min(high + widen, travel_rad[1])
    return None if high - low > MOST_SHARE * (travel_rad[1] - travel_rad[0]) else (low, high)
