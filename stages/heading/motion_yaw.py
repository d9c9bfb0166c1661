"""Yaw of frame `odom` in `map` by the drone's motion, measured by LiDAR and by its odometry.

    z_i = c + s Rz(psi) p_i + e_i,   a = s (cos psi, sin psi)      horizontally

p: positions by the autopilot (odom), z: fixes (map). c and a are linear; e has the noise of the fixes and the drift of
both odometries, correlated over the window, with equal covariance on both axes. So generalised least squares gives a
with covariance I / Lambda, and the likelihood over the circle is exp(Lambda |a| cos(psi - peak)): one peak, whose
sharpness grows with the displacement. It weights hypotheses over the circle. No yaw is published
    while the drone has not moved: sigma is large
    where LiDAR and odometry do not measure the same motion: lengths (|a| is not 1), heights or paths disagree
    while a yaw farther than 45 deg from the peak has more than 1/1000 of the peak's likelihood, or P within 45 deg of
    the peak is below 0.999

Source: DESIGN, Yaw branch; Horn, JOSA A 4(4) (1987) for the complex number; ours.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from stages.fuse.settings import FuseErrors
from stages.geometry.frames import Array64, rotation_z
from stages.heading.yaw_fit import Yaw

APART_NS = 400_000_000  # between the fixes used: their errors are correlated for that long
WINDOW_NS = 30_000_000_000
LEAST, MOST = 6, 48  # points
MIN_TO_CONFIRM = 4  # points: least number for a fit, or to compare a given yaw with
LEAST_M = 1.0  # of displacement
FLOOR_M = 0.05  # least sigma of a fix
SCALE = 0.03  # relative error of length, by the scales of both odometries
BEND = 0.01  # share of a displacement by the heading errors of both odometries
HEIGHT_WALK_M = 0.08  # per sqrt(s)
COARSE_RAD = math.radians(11.5)  # largest sigma of a coarse yaw
FALSE_SHARE = 0.2  # largest share of false points
BANK_RAD = 2 * math.pi / 72 * np.arange(72)
NEAR_RAD = math.radians(45.0)
MAX_ALTERNATIVE_ODDS = 1e-3
CONFIRMED_NS = 5_000_000_000  # age up to which the motion confirms a yaw
ALIKE, SLACK_RAD = 3.0, math.radians(5.0)


@dataclass(frozen=True)
class Point:
    """One fix and the position by the autopilot at its time."""

    stamp_ns: int
    xyz_map_m: Array64
    variance_m2: float  # horizontal, one axis
    xyz_odom_m: Array64
    segment: int


@dataclass(frozen=True)
class YawLikelihood:
    """Likelihood over the circle, exp(sharpness (cos(yaw - peak) - 1)); it may be flat."""

    stamp_ns: int
    peak_rad: float
    sharpness: float

    def alternatives_odds(self, yaw_rad: float) -> float:
        """Odds of the three other branches of a yaw together, relative to the yaw itself."""
        quarters = yaw_rad - self.peak_rad + 0.5 * math.pi * np.arange(1, 4)
        return float(np.exp(self.sharpness * (np.cos(quarters) - math.cos(yaw_rad - self.peak_rad))).sum())


@dataclass(frozen=True)
class YawFit:
    """Result of fitting a yaw to the points."""

    reason: str
    likelihood: YawLikelihood | None = None  # None: too few points, or both do not measure the same motion
    yaw: Yaw | None = None  # None: not determined


class MotionYaw:
    """Collects points of one track and one segment of frame odom, and fits the yaw."""

    def __init__(self, errors: FuseErrors, sigma_rad: float) -> None:
        """`sigma_rad`: largest sigma of a published yaw."""
        self._errors, self._sigma_rad = errors, sigma_rad
        self._points: deque[Point] = deque(maxlen=MOST)
        self._fit = YawFit("no motion of the drone measured yet")

    @property
    def yaw(self) -> Yaw | None:
        """The yaw with at most `sigma_rad`."""
        yaw = self._fit.yaw
        return yaw if yaw is not None and yaw.sigma_rad <= self._sigma_rad else None

    @property
    def coarse_yaw(self) -> Yaw | None:
        """The yaw with at most COARSE_RAD: enough to reject another branch."""
        return self._fit.yaw

    @property
    def reason(self) -> str:
        """Why there is no yaw, or its accuracy."""
        return self._fit.reason

    def confirms(self, stamp_ns: int, yaw_rad: float, sigma_rad: float) -> bool:
        """Whether recent motion agrees with a yaw and with none of its other branches."""
        likelihood = self._fit.likelihood
        if likelihood is None or likelihood.sharpness <= 0.0 or abs(stamp_ns - likelihood.stamp_ns) > CONFIRMED_NS:
            return False
        off = abs(math.remainder(yaw_rad - likelihood.peak_rad, 2 * math.pi))
        near = off <= ALIKE * math.hypot(1.0 / math.sqrt(likelihood.sharpness), sigma_rad) + SLACK_RAD
        return near and likelihood.alternatives_odds(yaw_rad) <= MAX_ALTERNATIVE_ODDS

    def fits(self, yaw: Yaw) -> bool | None:
        """Whether the tracked object moves, or hovers, as the autopilot reports, with this yaw.

        None: too few points.
        """
        points = tuple(self._points)
        return None if len(points) < MIN_TO_CONFIRM else moves_with(points, yaw, self._errors)

    def restart(self) -> None:
        """Drop all points."""
        self._points.clear()
        self._fit = YawFit("collecting its motion")

    def add(self, point: Point) -> bool:
        """Add a point; True: the yaw was fitted again."""
        points = self._points
        if points and (point.segment != points[-1].segment or point.stamp_ns < points[-1].stamp_ns):
            self.restart()
        if points and point.stamp_ns - points[-1].stamp_ns < APART_NS:
            return False
        points.append(point)
        while points[0].stamp_ns < point.stamp_ns - WINDOW_NS:
            points.popleft()
        self._fit = weigh(tuple(points), self._errors)
        return True


def weigh(points: tuple[Point, ...], errors: FuseErrors) -> YawFit:
    """Fit the yaw to the points; without a yaw, `reason` states why."""
    few = YawFit(f"{len(points)} LiDAR positions with an autopilot position, {LEAST} are needed")
    if len(points) < MIN_TO_CONFIRM:
        return few
    t = np.array([(p.stamp_ns - points[0].stamp_ns) * 1e-9 for p in points])
    z, own = np.array([p.xyz_map_m for p in points]), np.array([p.xyz_odom_m for p in points])
    moved_m = float(np.linalg.norm(own[:, :2] - own[0, :2], axis=1).max())
    if moved_m < LEAST_M:
        return YawFit(f"the drone has moved {moved_m:.1f} m, too little to determine its heading")
    variance = np.array([p.variance_m2 for p in points]) + FLOOR_M**2
    false: list[int] = []
    while True:
        rows = np.delete(np.arange(len(points)), false)
        level = level_covariance(t[rows], own[rows, :2], variance[rows], errors)
        height = np.diag(variance[rows]) + HEIGHT_WALK_M**2 * np.minimum.outer(t[rows], t[rows])
        a, precision, misfit, worst = fit(z[rows, :2], own[rows, :2], level)
        rise = z[rows, 2] - own[rows, 2]
        high = _about_mean(rise, height)
        n = len(rows)
        if misfit <= chi2_999(2 * n - 4) and high <= chi2_999(n - 1):
            break
        if len(false) >= FALSE_SHARE * len(points) or n <= LEAST:
            return YawFit("the tracked object does not move as the autopilot reports")
        off = int(np.argmax(np.abs(rise - np.median(rise)) / np.sqrt(variance[rows]))) if misfit < high else worst
        false.append(int(rows[off]))
    if precision <= 0.0:  # all remaining points have the same position
        return YawFit("the autopilot's positions contain no motion")
    length = float(np.linalg.norm(a))
    sigma = 1.0 / (math.sqrt(precision) * max(length, 1e-6))
    if abs(length - 1.0) > 3.3 * math.hypot(SCALE, 1.0 / math.sqrt(precision)):
        return YawFit(f"the LiDAR measures {length:.2f} of the displacement that the autopilot reports")
    peak, nearest, odds = bank(a, precision)
    likelihood = YawLikelihood(points[-1].stamp_ns, peak, precision * length)
    if len(points) < LEAST:
        return YawFit(few.reason, likelihood)
    if sigma > COARSE_RAD:
        return YawFit(f"heading by motion too uncertain: {moved_m:.1f} m moved", likelihood)
    if nearest < 1 - MAX_ALTERNATIVE_ODDS or odds > MAX_ALTERNATIVE_ODDS:
        return YawFit(f"several headings fit its motion: P {nearest:.3f}", likelihood)
    reason = f"heading by motion {math.degrees(peak):.0f} deg, sigma {math.degrees(sigma):.1f}, {moved_m:.1f} m moved"
    return YawFit(reason, likelihood, Yaw(points[-1].stamp_ns, peak, sigma**2))


def moves_with(points: tuple[Point, ...], yaw: Yaw, errors: FuseErrors) -> bool:
    """Whether the points match the displacements by the autopilot, rotated by a yaw."""
    t = np.array([(p.stamp_ns - points[0].stamp_ns) * 1e-9 for p in points])
    variance = np.array([p.variance_m2 for p in points]) + FLOOR_M**2
    z, own = np.array([p.xyz_map_m for p in points]), np.array([p.xyz_odom_m for p in points])
    displacement = own[:, :2] - own[0, :2]
    level = level_covariance(t, own[:, :2], variance, errors) + yaw.sigma_at(points[-1].stamp_ns) ** 2 * (
        displacement @ displacement.T
    )
    left = z[:, :2] - own[:, :2] @ rotation_z(yaw.yaw_rad)[:2, :2].T
    height = np.diag(variance) + HEIGHT_WALK_M**2 * np.minimum.outer(t, t)
    aside = _about_mean(left[:, 0], level) + _about_mean(left[:, 1], level)
    high = _about_mean(z[:, 2] - own[:, 2], height)
    return aside <= chi2_999(2 * len(points) - 2) and high <= chi2_999(len(points) - 1)


def bank(a: Array64, precision: float) -> tuple[float, float, float]:
    """Peak [rad], probability of the yaws within 45 deg of it, and the likelihood ratio of the best one beyond."""
    weight = np.exp(precision * float(np.linalg.norm(a)) * (np.cos(BANK_RAD) - 1.0))
    near = np.minimum(BANK_RAD, 2 * math.pi - BANK_RAD) <= NEAR_RAD
    return math.atan2(a[1], a[0]), float(weight[near].sum() / weight.sum()), float(weight[~near].max())


def level_covariance(t_s: Array64, odometry_m_of: Array64, variance_m2: Array64, errors: FuseErrors) -> Array64:
    """(n, n) of e on one axis: fixes, integral of a Gauss-Markov drift, random walk, heading errors.

    Of the integral x of v with E[v v'] = s^2 exp(-|d| / T): E[x_a x_b] = s^2 T^2 (2 m / T - 1 + exp(-a / T) +
    exp(-b / T) - exp(-|a - b| / T)), m = min(a, b).
    """
    T = errors.drift_time_s
    first = np.minimum.outer(t_s, t_s)
    fade = np.exp(-t_s / T)
    drift = 2 * first / T - 1 + fade[:, None] + fade[None, :] - np.exp(-np.abs(np.subtract.outer(t_s, t_s)) / T)
    displacement = odometry_m_of - odometry_m_of[0]
    turned = BEND**2 * 0.5 * (displacement @ displacement.T)
    random_walk = errors.walk_m_per_sqrt_s**2 * first
    return np.diag(variance_m2) + (errors.drift_mps * T) ** 2 * drift + random_walk + turned


def fit(z_m: Array64, odometry_m_of: Array64, covariance_m2: Array64) -> tuple[Array64, float, float, int]:
    """a (2,), Lambda, the misfit (chi-square, 2 n - 4 degrees of freedom) and the point that fits worst."""
    inverse = np.linalg.inv(covariance_m2)
    ones = inverse.sum(axis=1)
    W = inverse - np.outer(ones, ones) / ones.sum()  # c integrated out
    Wp, Wz = W @ odometry_m_of, W @ z_m
    precision = float((odometry_m_of * Wp).sum())
    a = np.zeros(2)
    if precision > 0.0:
        a[0] = (odometry_m_of * Wz).sum() / precision
        a[1] = (odometry_m_of[:, 0] * Wz[:, 1] - odometry_m_of[:, 1] * Wz[:, 0]).sum() / precision
    left = np.empty_like(z_m)
    left[:, 0] = z_m[:, 0] - a[0] * odometry_m_of[:, 0] + a[1] * odometry_m_of[:, 1]
    left[:, 1] = z_m[:, 1] - a[1] * odometry_m_of[:, 0] - a[0] * odometry_m_of[:, 1]
    Wl = W @ left
    misfit = float((left * Wl).sum())
    off = (Wl**2).sum(axis=1) / np.maximum(np.diag(W), 1e-12)  # each point against all others
    worst = int(np.argmax(off))
    return a, precision, misfit, worst


def _about_mean(values: Array64, covariance: Array64) -> float:
    W = np.linalg.inv(covariance)
    ones = W.sum(axis=1)
    mean = float(ones @ values) / float(ones.sum())
    left = values - mean
    return float(left @ W @ left)


def chi2_999(dof: int) -> float:
    """99.9 % point by Wilson and Hilferty (1931), accurate to 2 % from 3 degrees of freedom on."""
    share = 2.0 / (9.0 * dof)
    return dof * (1.0 - share + 3.0902 * math.sqrt(share)) ** 3
