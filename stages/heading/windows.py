"""Displacements of the drone by LiDAR and by its own odometry, in windows that do not overlap.

A window begins at one group of fixes and ends at a later one, as soon as the drone is at least `baseline_m` away and
this distance is well above the noise of the fixes. Each hypothesis rotates the displacement by odometry by its own yaw,
and with it moves the fixes of a group to a common time. Their median is used, so that one false fix has no effect.

Source: ours; DESIGN, Yaw branch: non-overlapping windows, baseline >= 0.4 m.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from stages.geometry.frames import Array64
from stages.heading.hypothesis_bank import DIRECTIONS, Displacement, turns
from stages.messages import DroneFix, VisualMotion
from stages.odometry.drone.trajectory import AutopilotTrajectory

HANDFUL = 3  # number of fixes in a group
HANDFUL_NS = 400_000_000
LONGEST_S = 20.0  # a drone that hardly moves starts a new window
CLEAR = 3.0  # least displacement, in sigmas of the fixes' noise
FIX_FLOOR_M = 0.04  # least sigma of the median of a group
STRAIGHT = 0.7  # straightness of a window by directions alone: net displacement over path length
COVERED = 0.8  # share of a window that images must cover
IMAGES_LATE_NS = 500_000_000  # longest wait of a long enough window for the images at its end
SLACK_M = 0.6  # a displacement by LiDAR longer than the baseline by this closes a window without odometry


@dataclass(frozen=True)
class _Fix:
    stamp_ns: int
    xyz_map_m: Array64
    covariance_m2: Array64  # (2, 2) map frame, horizontal
    own: tuple[Array64, int] | None  # position by odometry and its segment


@dataclass(frozen=True)
class _Handful:
    stamp_ns: int
    fixes: tuple[_Fix, ...]

    @property
    def covariance_m2(self) -> Array64:
        """(2, 2) of the median; errors of neighbouring fixes are correlated, three have the information of two."""
        mean = np.mean([f.covariance_m2 for f in self.fixes], axis=0)
        return mean / min(len(self.fixes), 2) + FIX_FLOOR_M**2 * np.eye(2)


class Windows:
    """Collects fixes and steps; `close_*` returns the displacement of the window, once it is long enough."""

    def __init__(self, baseline_m: float, hypotheses: int = DIRECTIONS) -> None:
        """`hypotheses`: number over the circle, as in the bank that is updated."""
        self._baseline_m = baseline_m
        self._R = turns(hypotheses)
        self._recent: deque[_Fix] = deque(maxlen=HANDFUL)
        self._start: _Handful | None = None
        self._waiting: _Handful | None = None  # end of a window whose images have not arrived
        self._track: int | None = None
        self._steps: deque[VisualMotion] = deque(maxlen=512)

    def restart(self) -> None:
        """Drop all fixes and the open window."""
        self._recent.clear()
        self._start = self._waiting = None

    def add_step(self, motion: VisualMotion) -> None:
        """Add a step of the visual odometry."""
        self._steps.append(motion)

    def add_fix(
        self, fix: DroneFix, R_map_vehicle: Array64, t_map_vehicle_m: Array64, own: AutopilotTrajectory
    ) -> None:
        """Add a fix with the pose of the vehicle at its time; another track restarts the window."""
        if fix.track_id != self._track or (self._recent and fix.stamp_ns <= self._recent[-1].stamp_ns):
            self.restart()
        self._track = fix.track_id
        covariance = R_map_vehicle @ fix.covariance_m2 @ R_map_vehicle.T
        self._recent.append(
            _Fix(
                fix.stamp_ns,
                R_map_vehicle @ fix.xyz_vehicle_m + t_map_vehicle_m,
                covariance[:2, :2],
                own.position(fix.stamp_ns),
            )
        )
        if self._start is None and len(self._recent) == HANDFUL:
            self._start = self._handful()

    def close_metric(self, R_map_odom: Array64, bearing_rad: float) -> Displacement | None:
        """The window by the autopilot's positions; R_map_odom is that of branch 0. None: not long enough."""
        start, end = self._ends()
        if start is None or end is None:
            return None
        segments = {f.own[1] if f.own else None for f in start.fixes + end.fixes}
        if len(segments) != 1 or None in segments:
            self._begin_at(end)
            return None
        anchor = odometry_m_of(start.fixes[0])
        own_m = [[(R_map_odom @ (odometry_m_of(f) - anchor))[:2] for f in h.fixes] for h in (start, end)]
        middle = [np.mean(t, axis=0) for t in own_m]
        odometry = middle[1] - middle[0]
        left = [  # of the fixes, less the displacement by odometry as each hypothesis rotates it
            np.median(np.array([f.xyz_map_m[:2] for f in h.fixes]) - np.array(t) @ np.swapaxes(self._R, 1, 2), axis=1)
            for h, t in zip((start, end), own_m, strict=True)
        ]
        lidar = left[1] - left[0] + self._R @ odometry
        noise = start.covariance_m2 + end.covariance_m2
        length, sigma = float(np.linalg.norm(odometry)), math.sqrt(0.5 * float(np.trace(noise)))
        seen = float(np.linalg.norm(lidar, axis=1).min())
        long = length >= max(self._baseline_m, CLEAR * sigma)
        if not long and seen < self._baseline_m + SLACK_M + CLEAR * sigma:
            return None
        self._begin_at(end)
        return Displacement(start.stamp_ns, end.stamp_ns, lidar, noise, odometry, bearing_rad, True)

    def close_bearing(self, R_map_drone: dict[int, Array64], bearing_rad: float) -> Displacement | None:
        """The window by directions between images; R_map_drone, by from_ns, is that of branch 0. None: not usable."""
        start, end = self._ends()
        if start is None or end is None:
            return None
        newest_ns, end = end.stamp_ns, self._waiting or end
        lidar_m = median_m(end) - median_m(start)
        noise = start.covariance_m2 + end.covariance_m2
        if float(np.linalg.norm(lidar_m)) < max(self._baseline_m, CLEAR * math.sqrt(0.5 * float(np.trace(noise)))):
            return None
        images_ns = self._steps[-1].stamp_ns if self._steps else 0
        if images_ns < end.stamp_ns and newest_ns - end.stamp_ns < IMAGES_LATE_NS:
            self._waiting = end
            return None
        self._begin_at(end)
        direction_sum, covered, direction_ns, sigma = np.zeros(3), 0.0, 0.0, 0.0
        for step, overlap in self._keys_steps(start.stamp_ns, end.stamp_ns):
            if step.from_ns not in R_map_drone:
                continue
            covered += overlap
            if step.direction_from is not None and step.direction_sigma_rad is not None:
                direction_sum += overlap * (R_map_drone[step.from_ns] @ step.direction_from)
                direction_ns += overlap
                sigma = max(sigma, step.direction_sigma_rad)
        flat = float(np.linalg.norm(direction_sum[:2]))
        if covered < COVERED * (end.stamp_ns - start.stamp_ns) or flat < STRAIGHT * max(direction_ns, 1.0):
            return None
        lidar = np.tile(lidar_m, (len(self._R), 1))
        return Displacement(
            start.stamp_ns, end.stamp_ns, lidar, noise, direction_sum[:2] / flat, math.hypot(sigma, bearing_rad), False
        )

    def _keys_steps(self, start_ns: int, end_ns: int) -> list[tuple[VisualMotion, int]]:
        """One step of each key image with the part of the window [ns] that it covers: the shortest that covers most."""
        best: dict[int, tuple[VisualMotion, int]] = {}
        for step in self._steps:  # the steps of a key come from short to long: each covers the ones before
            overlap = min(step.stamp_ns, end_ns) - max(step.from_ns, start_ns)
            if overlap > 0 and (step.from_ns not in best or overlap > best[step.from_ns][1]):
                best[step.from_ns] = step, overlap
        return list(best.values())

    def steps_since_start(self) -> list[int]:
        """from_ns of the steps that the open window may need."""
        if self._start is None:
            return []
        return [step.from_ns for step in self._steps if step.stamp_ns > self._start.stamp_ns]

    def _begin_at(self, handful: _Handful) -> None:
        """Start the next window."""
        self._start, self._waiting = handful, None

    def _handful(self) -> _Handful:
        fixes = tuple(self._recent)
        return _Handful(fixes[len(fixes) // 2].stamp_ns, fixes)

    def _ends(self) -> tuple[_Handful | None, _Handful | None]:
        """Start of the open window, and its end if there are enough new fixes close in time."""
        recent = self._recent
        if self._start is None or len(recent) < HANDFUL:
            return None, None
        if recent[0].stamp_ns <= self._start.fixes[-1].stamp_ns:
            return self._start, None
        if recent[-1].stamp_ns - recent[0].stamp_ns > HANDFUL_NS:
            return self._start, None
        if (recent[-1].stamp_ns - self._start.stamp_ns) * 1e-9 > LONGEST_S:
            self._begin_at(self._handful())
            return self._start, None
        return self._start, self._handful()


def odometry_m_of(fix: _Fix) -> Array64:
    """Position by odometry at a fix that has one."""
    assert fix.own is not None
    return fix.own[0]


def median_m(handful: _Handful) -> Array64:
    """Horizontal median (2,) of the positions."""
    return np.median([f.xyz_map_m[:2] for f in handful.fixes], axis=0)
