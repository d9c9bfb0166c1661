"""Yaw between frame map and east-north-up: R_map_enu = Rz(yaw), by the vehicle's GNSS and odometry.

    heading    yaw = yaw of the vehicle in map - its yaw by two antennas or a compass
    course     yaw = direction of a displacement in map - direction of the same displacement by GNSS

The slow error of GNSS cancels in a displacement; what is left is noise: sigma = sqrt(2) noise / baseline. The more
precise of the two is used. Headings do not average: the error of a compass or of an antenna baseline is constant. The
odometry's yaw drifts after a measurement: sigma grows with its age, and after KEPT_NS it is not used.

Source: ours. KEPT_NS, LEAST_BASELINE_M and SCALE are chosen; the drift is an assumption about the vehicle's odometry.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from stages.geometry.frames import Array64

KEPT_NS = 60_000_000_000  # of positions and headings: the slow error of GNSS changes within minutes
LEAST_BASELINE_M = 5.0
SCALE = 0.05  # of the odometry's distance, at most
ODOMETRY_SIGMA_RAD = math.radians(1.0)  # yaw of the odometry over a baseline: its drift of 0.5 to 1 deg a minute
DRIFT_RADPS = ODOMETRY_SIGMA_RAD / 60.0


class MapNorth:
    """Newest estimate of the yaw of east-north-up in frame map."""

    def __init__(self, noise_m: float) -> None:
        """`noise_m`: one sigma of a GNSS position on one axis, without its slow error."""
        self._noise_m = noise_m
        self._positions: deque[tuple[int, Array64, Array64]] = deque(maxlen=600)  # stamp, map (2,), enu (2,)
        self._heading: tuple[int, float, float] | None = None  # stamp, yaw, one sigma

    def reset(self) -> None:
        """Frame map has changed."""
        self._positions.clear()
        self._heading = None

    def add_heading(self, stamp_ns: int, yaw_map_rad: float, yaw_enu_rad: float, sigma_rad: float) -> None:
        """The vehicle's yaw in both frames."""
        self._heading = stamp_ns, math.remainder(yaw_map_rad - yaw_enu_rad, math.tau), sigma_rad

    def add_position(self, stamp_ns: int, xy_map_m: Array64, xy_enu_m: Array64) -> None:
        """The vehicle's horizontal position (2,) in both frames."""
        positions = self._positions
        if positions and float(np.linalg.norm(xy_map_m - positions[-1][1])) < 0.2 * LEAST_BASELINE_M:
            return
        positions.append((stamp_ns, xy_map_m, xy_enu_m))
        while stamp_ns - positions[0][0] > KEPT_NS:
            positions.popleft()

    def yaw(self, stamp_ns: int) -> tuple[float, float] | None:
        """(yaw, one sigma) [rad] at a time; None: neither a recent heading nor a recent displacement."""
        known: list[tuple[float, float]] = []
        for measured in (self._heading, self._course()):
            if measured is None or (age_ns := max(stamp_ns - measured[0], 0)) > KEPT_NS:
                continue
            known.append((measured[1], math.hypot(measured[2], DRIFT_RADPS * age_ns * 1e-9)))
        return min(known, key=lambda estimate: estimate[1]) if known else None

    def _course(self) -> tuple[int, float, float] | None:
        """Stamp, yaw and one sigma by the longest displacement."""
        if len(self._positions) < 2:
            return None
        to_ns, to_map_m, to_enu_m = self._positions[-1]
        _, from_map_m, from_enu_m = max(self._positions, key=lambda p: float(np.linalg.norm(to_map_m - p[1])))
        d_map, d_enu = to_map_m - from_map_m, to_enu_m - from_enu_m
        map_m, enu_m = math.hypot(*d_map), math.hypot(*d_enu)
        baseline_m = min(map_m, enu_m)
        if baseline_m < LEAST_BASELINE_M or abs(map_m - enu_m) > 5.0 * self._noise_m + SCALE * map_m:
            return None  # too short, or one of the two has jumped
        yaw = math.remainder(math.atan2(d_map[1], d_map[0]) - math.atan2(d_enu[1], d_enu[0]), math.tau)
        return to_ns, yaw, math.hypot(math.sqrt(2.0) * self._noise_m / baseline_m, ODOMETRY_SIGMA_RAD)
