"""Error of the vehicle's reported velocity against what stands still in the LiDAR.

Two successive revolutions of the rotor measure the same walls. Under the reported motion their points lie on one
surface; with an error w of the velocity along the vehicle's axis x, a point is off the surface by

    r = -(n . x) w dt

with the surface's normal n and the time dt between both measurements. w is estimated from the surfaces that face the
direction of travel (|n . x| > FACING), by Huber's weights, in SECTORS sectors of the revolution. Most of the sectors
with an estimate, and at least two, must agree: a vehicle that passes is only in some of them.

Up to LASERS of the lasers are used, evenly spaced about the middle of the fan: the effort is about the same with every
model. Nothing is known on a road between walls parallel to it, in an open field, and among trees.

Source: ours; Huber weights: P. J. Huber, "Robust Estimation of a Location Parameter", 1964.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stages.geometry.frames import Array64
from stages.geometry.rig_lidar import RigLidar
from stages.kernels.odometry.revolution import Poses, Revolution, revolution_in_map
from stages.kernels.odometry.scan_residuals import scan_residuals
from stages.messages import SweptPulses

LASERS, WIDTH_RAD = 16, math.radians(30.0)  # at most: 2 deg apart, so that the neighbours of a cell are on one surface
EVERY = 4  # of the columns
LEAST_RANGE_M = 3.5  # nearer returns are from the vehicle itself
FACING = 0.4
SECTORS, LEAST_SECTORS = 16, 2
LEAST_ROWS = 12  # in a sector
HUBER_M = 0.05
ITERATIONS = 8
INLIER_M, INLIERS = 0.06, 0.7  # share of the rows that must fit
ROW_SIGMA_M = 0.02  # smallest sigma of a distance
SURFACE_MPS = 0.1  # error of the estimate by surfaces that are no planes, one sigma
AGREE_SIGMAS, AGREE_MPS, AGREE_SHARE = 3.0, 0.2, 0.7  # difference of a sector from the median; share that agrees
KEPT_NS = 500_000_000  # of slices and revolutions that wait for a pose


@dataclass(frozen=True, slots=True)
class VelocityError:
    """Reported minus true velocity along the vehicle's axis x, from one revolution."""

    stamp_ns: int
    error_mps: float
    sigma_mps: float
    speed_mps: float  # reported


class Fan:
    """The k lasers that are used, of the `lasers` of a unit, by elevation."""

    def __init__(self, unit: RigLidar) -> None:
        elevation_rad = np.array(unit.elevation_rad)
        self.lasers, order = len(elevation_rad), np.argsort(elevation_rad)
        low, high = min(unit.elevation_rad), max(unit.elevation_rad)
        middle, half = 0.5 * (high + low), 0.5 * min(high - low, WIDTH_RAD)
        evenly_rad = np.linspace(middle - half, middle + half, LASERS)
        nearest = np.abs(elevation_rad[order] - evenly_rad[:, None]).argmin(axis=1)
        self.used = order[np.unique(nearest)]
        elevation_rad = elevation_rad[self.used]
        self.between_rad = 0.5 * (elevation_rad[1:] + elevation_rad[:-1])
        azimuth_rad = np.array(unit.azimuth_offset_rad)[self.used]
        self.azimuth_rad = azimuth_rad - 0.5 * (azimuth_rad.max() + azimuth_rad.min())
        # (2, k): by beams of one azimuth, cos w radial + sin w axis, the direction of elevation 0 and the spin axis
        self.weights = np.linalg.pinv(np.column_stack((np.cos(elevation_rad), np.sin(elevation_rad))))


class PosedSlice(NamedTuple):
    """A slice and the reported T_map_vehicle, R (3, 3) and t (3,), at its first and last pulse."""

    pulses: SweptPulses
    first: tuple[Array64, Array64]
    last: tuple[Array64, Array64]


class StaticScan:
    """Compares each revolution with the one before."""

    def __init__(self, unit: RigLidar) -> None:
        self._fan = Fan(unit)
        self._slices: deque[PosedSlice] = deque()
        self._turned_rad = 0.0  # of the rotor, by the slices
        self._before: Revolution | None = None

    def restart(self) -> None:
        """Forget everything: the motion has a new start frame."""
        self._slices.clear()
        self._turned_rad, self._before = 0.0, None

    def add(
        self, pulses: SweptPulses, first: tuple[Array64, Array64], last: tuple[Array64, Array64]
    ) -> VelocityError | None:
        """Add a slice with the reported poses, R and t, at its first and last pulse.

        Returns the velocity error at a revolution's end, if observable.
        """
        fan = self._fan
        firings = len(pulses.range_m) // fan.lasers
        if firings < 2 or firings * fan.lasers != len(pulses.range_m):  # empty, or of another LiDAR
            return None
        if self._slices and pulses.stamp_ns - self._slices[-1].pulses.stamp_ns > KEPT_NS:
            self.restart()
        directions = pulses.direction_vehicle.reshape(firings, fan.lasers, 3)
        begin, end = (fan.weights[0] @ directions[at, fan.used] for at in (0, -1))
        cosine = float(begin @ end / (np.linalg.norm(begin) * np.linalg.norm(end)))
        self._turned_rad += math.acos(min(max(cosine, -1.0), 1.0)) * firings / (firings - 1)
        self._slices.append(PosedSlice(pulses, first, last))
        if self._turned_rad < 2 * math.pi:
            return None
        revolution = revolution_of(fan, list(self._slices), self._turned_rad)
        self._slices.clear()
        self._turned_rad = 0.0
        before, self._before = self._before, revolution
        return None if before is None else velocity_error(before, revolution, fan.between_rad, last[0][:, 0])


def revolution_of(fan: Fan, slices: list[PosedSlice], turned_rad: float) -> Revolution:
    """The slices' firings as columns of one azimuth."""
    direction, range_m, stamp_ns = (
        np.concatenate([getattr(posed.pulses, name) for posed in slices])
        for name in ("direction_vehicle", "range_m", "point_stamp_ns")
    )
    firings = len(range_m) // fan.lasers
    begin = np.cumsum([0, *(len(posed.pulses.range_m) // fan.lasers for posed in slices)])
    ends = zip(*((*posed.first, *posed.last, np.array(posed.pulses.origin_vehicle_m)) for posed in slices), strict=True)
    step_rad = turned_rad / firings
    shift = np.rint(fan.azimuth_rad / step_rad).astype(np.int64)
    return revolution_in_map(
        direction.reshape(firings, fan.lasers, 3),
        range_m.reshape(firings, fan.lasers),
        stamp_ns.reshape(firings, fan.lasers),
        begin,
        Poses(*map(np.stack, ends)),
        fan.used,
        shift,
        fan.weights,
        step_rad,
    )


def velocity_error(before: Revolution, now: Revolution, between_rad: Array64, forward: Array64) -> VelocityError | None:
    """Velocity error between two revolutions; None: not observable, or the sectors disagree.

    `between_rad`: as in `scan_residuals`; `forward`: axis x of the vehicle, frame map.
    """
    rows = scan_residuals(before, now, between_rad, EVERY, LEAST_RANGE_M)
    facing = rows[:, 1:4] @ forward
    used = np.abs(facing) > FACING
    rows, facing = rows[used], facing[used]
    slope_s = -facing * rows[:, 4]
    sector = rows[:, 5].astype(np.int64) * SECTORS // len(now.range_m)
    estimates = [_huber(rows[sector == k, 0], slope_s[sector == k]) for k in range(SECTORS)]
    velocity, sigma = np.array([estimate for estimate in estimates if estimate is not None]).reshape(-1, 2).T
    if len(velocity) < LEAST_SECTORS:
        return None
    agree = np.abs(velocity - np.median(velocity)) < AGREE_MPS + AGREE_SIGMAS * sigma
    if np.count_nonzero(agree) < max(LEAST_SECTORS, AGREE_SHARE * len(velocity)):
        return None
    weights = sigma[agree] ** -2.0
    error_mps = -float(weights @ velocity[agree] / weights.sum())
    travelled_m = float(np.linalg.norm(now.origin_m[-1] - before.origin_m[-1]))
    return VelocityError(
        stamp_ns=int(now.stamp_ns[-1, -1]),
        error_mps=error_mps,
        sigma_mps=math.hypot(float(weights.sum() ** -0.5), SURFACE_MPS),
        speed_mps=travelled_m / max((now.stamp_ns[-1, -1] - before.stamp_ns[-1, -1]) * 1e-9, 1e-3),
    )


def _huber(distance_m: Array64, slope_s: Array64) -> tuple[float, float] | None:
    """Velocity and its sigma from distance = slope velocity; None: too few rows, or they do not fit."""
    if len(distance_m) < LEAST_ROWS:
        return None
    velocity, information, weights = 0.0, 0.0, np.ones(len(distance_m))
    for _ in range(ITERATIONS):
        information = float(weights @ slope_s**2)
        velocity = float(weights @ (slope_s * distance_m)) / information
        left_m = np.abs(distance_m - slope_s * velocity)
        weights = np.minimum(1.0, HUBER_M / np.maximum(left_m, 1e-9))
    left_m = np.abs(distance_m - slope_s * velocity)
    if float(np.mean(left_m < INLIER_M)) < INLIERS:
        return None
    row_sigma_m = max(1.4826 * float(np.median(left_m)), ROW_SIGMA_M)
    return velocity, row_sigma_m / math.sqrt(information)
