"""Error of the vehicle's reported velocity against what stands still in the LiDAR.

Two successive revolutions of the rotor measure the same walls. Under the reported motion their points lie on one
surface; with an error w of the velocity along the vehicle's axis x, a point is off the surface by

    r = -(n . x) w dt

with the surface's normal n and the time dt between both measurements. w is estimated from the surfaces that face the
direction of travel (|n . x| > FACING), by Huber's weights, in SECTORS sectors of the revolution. Most of the sectors
with an estimate, and at least two, must agree: a vehicle that passes is only in some of them.

Nothing is known on a road between walls parallel to it, in an open field, and among trees; nor with another LiDAR than
one of 16 beams 2 deg apart (VLP-16, XT16).

Source: ours; Huber weights: P. J. Huber, "Robust Estimation of a Location Parameter", 1964.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.odometry.scan_residuals import LASERS, LOWEST_DEG, SPACING_DEG, scan_residuals
from stages.messages import SweptPulses

EVERY = 4  # of the firings
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
FAN_RAD = math.radians(-2.0 * LOWEST_DEG)  # between the outermost beams
SAME_FAN_RAD = math.radians(0.5 * SPACING_DEG)
KEPT_NS = 500_000_000  # of slices and revolutions that wait for a pose


Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class VelocityError:
    """Reported minus true velocity along the vehicle's axis x, from one revolution."""

    stamp_ns: int
    error_mps: float
    sigma_mps: float
    speed_mps: float  # reported


@dataclass(frozen=True, slots=True)
class _Revolution:
    stamp_ns: Integers  # (f,)
    xyz_m: Array64  # (f, 16, 3) in frame map, by the reported motion
    range_m: Array64  # (f, 16)
    origin_m: Array64  # (f, 3)
    axis: Array64  # (f, 3) spin axis, towards the highest laser
    middle: Array64  # (f, 3) middle of the fan
    step_rad: float  # turn of the rotor per firing
    forward: Array64  # (3,) axis x of the vehicle


class _Posed(NamedTuple):
    """A slice and the reported T_map_vehicle, R (3, 3) and t (3,), at its first and last pulse."""

    pulses: SweptPulses
    first: tuple[Array64, Array64]
    last: tuple[Array64, Array64]


class StaticScan:
    """Compares each revolution with the one before."""

    def __init__(self) -> None:
        self._slices: deque[_Posed] = deque()
        self._turned_rad = 0.0  # of the rotor, by the slices
        self._before: _Revolution | None = None

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
        firings = len(pulses.range_m) // LASERS
        if firings < 2 or firings * LASERS != len(pulses.range_m) or not math.isfinite(pulses.turntable_rad):
            return None
        if self._slices and pulses.stamp_ns - self._slices[-1].pulses.stamp_ns > KEPT_NS:
            self.restart()
        directions = pulses.direction_vehicle.reshape(firings, LASERS, 3)
        if int(pulses.laser.max()) != LASERS - 1 or abs(_fan_rad(directions[0]) - FAN_RAD) > SAME_FAN_RAD:
            return None
        begin, end = (directions[at].astype(np.float64).mean(axis=0) for at in (0, -1))
        cosine = float(begin @ end / (np.linalg.norm(begin) * np.linalg.norm(end)))
        self._turned_rad += math.acos(min(max(cosine, -1.0), 1.0)) * firings / (firings - 1)
        self._slices.append(_Posed(pulses, first, last))
        if self._turned_rad < 2 * math.pi:
            return None
        revolution = _revolution(list(self._slices))
        self._slices.clear()
        self._turned_rad = 0.0
        before, self._before = self._before, revolution
        return None if before is None else velocity_error(before, revolution)


def _fan_rad(directions: NDArray[np.float32]) -> float:
    """Largest angle between two of the beams (n, 3)."""
    return math.acos(min(max(float((directions @ directions.T).min()), -1.0), 1.0))


def _in_map(posed: _Posed) -> tuple[Array64, Array64]:
    """Directions (f, 16, 3) and origins (f, 3) of a slice's firings in frame map, by poses interpolated linearly."""
    stamp_ns = posed.pulses.point_stamp_ns[::LASERS]
    share = ((stamp_ns - stamp_ns[0]) / max(int(posed.pulses.point_stamp_ns[-1] - stamp_ns[0]), 1))[:, None]
    (R_0, t_0), (R_1, t_1) = posed.first, posed.last
    R = R_0 + share[..., None] * (R_1 - R_0)
    directions = posed.pulses.direction_vehicle.reshape(-1, LASERS, 3).astype(np.float64) @ R.transpose(0, 2, 1)
    return directions, R @ np.array(posed.pulses.origin_vehicle_m) + t_0 + share * (t_1 - t_0)


def _revolution(slices: list[_Posed]) -> _Revolution:
    turned, origins = zip(*map(_in_map, slices), strict=True)
    directions, origin_m = np.concatenate(turned), np.concatenate(origins)
    range_m = np.concatenate([posed.pulses.range_m for posed in slices]).reshape(-1, LASERS).astype(np.float64)
    stamp_ns = np.concatenate([posed.pulses.point_stamp_ns[::LASERS] for posed in slices])
    order, axis = _by_elevation(directions)
    directions, range_m = np.ascontiguousarray(directions[:, order]), np.ascontiguousarray(range_m[:, order])
    middle = directions[:, LASERS // 2 - 1] + directions[:, LASERS // 2]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    sines = np.einsum("ij,ij->i", np.cross(middle[:-1], middle[1:]), axis[:-1])
    return _Revolution(
        stamp_ns=stamp_ns,
        xyz_m=origin_m[:, None] + directions * range_m[..., None],
        range_m=range_m,
        origin_m=origin_m,
        axis=axis,
        middle=middle,
        step_rad=float(np.median(np.arcsin(sines))),
        forward=slices[-1].last[0][:, 0],
    )


def _by_elevation(directions: Array64) -> tuple[Integers, Array64]:
    """Order of the lasers by elevation, and the spin axis (f, 3) per firing, which is nearest to the highest one."""
    ends = directions - directions.mean(axis=1, keepdims=True)
    spread = ends[0]
    first = np.linalg.svd(spread)[2][0]  # the lasers of a firing lie in the plane of fan and axis
    order = np.argsort(spread @ first).astype(np.int64)
    axis = directions[:, order[-1]] - directions[:, order[0]]
    return order, axis / np.linalg.norm(axis, axis=1, keepdims=True)


def velocity_error(before: _Revolution, now: _Revolution) -> VelocityError | None:
    """Velocity error between two revolutions; None: not observable, or the sectors disagree."""
    if before.step_rad == 0.0:
        return None
    rows = scan_residuals(
        before.xyz_m,
        before.range_m,
        before.origin_m,
        before.axis,
        before.middle,
        before.step_rad,
        now.xyz_m,
        now.range_m,
        EVERY,
        LEAST_RANGE_M,
    )
    facing = rows[:, 1:4] @ now.forward
    used = np.abs(facing) > FACING
    rows, facing = rows[used], facing[used]
    new = rows[:, 4].astype(np.int64)
    seconds = (now.stamp_ns[new] - before.stamp_ns[rows[:, 5].astype(np.int64)]) * 1e-9
    sector = new * SECTORS // len(now.stamp_ns)
    slope_s = -facing * seconds
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
        stamp_ns=int(now.stamp_ns[-1]),
        error_mps=error_mps,
        sigma_mps=math.hypot(float(weights.sum() ** -0.5), SURFACE_MPS),
        speed_mps=travelled_m / max((now.stamp_ns[-1] - before.stamp_ns[-1]) * 1e-9, 1e-3),
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
