"""Yaw of the drone's body by the autopilot's own odometry, as evidence with an outlier share.

    z_i = c + Rz(psi) x_i + e_i

z: LiDAR positions (map), x: the autopilot's positions (odom): psi is the yaw of `odom` in `map`, known within metres
of flight. A fit with a scale, a = |a| exp(i psi), shows the error of the odometry: it is as large across a as along
it, where a is 1. The body's yaw is psi plus the yaw of R_odom_drone, less the error of the autopilot's compass: its
velocity by GPS is right while its attitude may be turned. No motion of the odometry alone shows that error, so it stays
an uncertainty however long the drone flies:

    p(yaw) = (1 - o) N(yaw; psi + yaw_odom, sigma_psi^2 + sigma_c^2) + o / 2 pi

The autopilot uses positions together with its attitude. Axes that differ from those of its attitude by the error of its
compass suit it less, but are parallel to those of its own positions. While psi is not sharp, the axes are those of the
attitude, by the yaw of the body that grd measures, if psi excludes a wrong compass at two sigmas.

Source: ours; Horn, JOSA A 4(4) (1987) for the fit.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from stages.geometry.frames import Array64, heading_rad
from stages.heading.inertial_bank import YawMixture

APART_NS = 150_000_000
WINDOW_NS = 10_000_000_000
LEAST_POINTS, LEAST_M = 8, 1.0
FIX_FLOOR_M = 0.05
DRIFT_MPS = 0.12  # error of the odometry's velocity, constant over the window, one axis
WANDER_M, WANDER_S = 0.1, 2.0  # of its position, by the noise of GPS, one axis, and time constant
WORST_CHI2 = 3.0  # of the fit, for each degree of freedom
LENGTH_SLACK = 0.35  # displacements that differ more are not of one motion
CURRENT_NS = 3_000_000_000
SHARP_RAD = math.radians(2.0)  # sigma of psi below which the axes are those of the motion
WRONG_COMPASS_RAD = math.radians(20.0)  # as between ArduPilot's estimators: ATTITUDE_CHECK_THRESH_YAW_RAD
YAW_DRIFT_RADPS = math.radians(2.0) / 60  # heading drift of both odometries: autopilots and links, degrees per minute


@dataclass(frozen=True)
class OdomYaw:
    """Yaw of frame `odom` in `map` when it was measured, R_map_odom = Rz(yaw), one sigma."""

    stamp_ns: int
    yaw_rad: float
    sigma_rad: float

    def sigma_at(self, stamp_ns: int) -> float:
        """Sigma at a later time [rad], with the drift since."""
        return math.hypot(self.sigma_rad, YAW_DRIFT_RADPS * (stamp_ns - self.stamp_ns) * 1e-9)

    def agrees(self, other: OdomYaw) -> bool:
        """Whether a later measurement agrees."""
        sigma = math.hypot(self.sigma_at(other.stamp_ns), other.sigma_rad)
        return abs(math.remainder(other.yaw_rad - self.yaw_rad, 2 * math.pi)) < 4.0 * sigma


@dataclass(frozen=True)
class YawEvidence:
    """A yaw of the body with the share of compasses that are wrong by any angle."""

    yaw_rad: float
    sigma_rad: float
    outlier_share: float

    def applied(self, prior: YawMixture) -> YawMixture:
        """A mixture with this evidence: each part as if the compass were right, and as if it were wrong."""
        s2 = self.sigma_rad**2 + prior.variance_rad2
        off = np.remainder(self.yaw_rad - prior.yaw_rad + math.pi, 2 * math.pi) - math.pi
        density = np.exp(-0.5 * off**2 / s2) * np.sqrt(2 * math.pi / s2)  # relative to a uniform one
        gain = prior.variance_rad2 / s2
        weight = np.concatenate([(1.0 - self.outlier_share) * density, np.full(len(off), self.outlier_share)])
        weight *= np.tile(prior.weight, 2)
        return YawMixture(
            np.concatenate([prior.yaw_rad + gain * off, prior.yaw_rad]),
            np.concatenate([(1.0 - gain) * prior.variance_rad2, prior.variance_rad2]),
            weight / weight.sum(),
        )


class OdometryHeading:
    """Collects LiDAR positions with the autopilot's; one segment of odometry at a time."""

    def __init__(self, compass_sigma_rad: float, compass_outliers: float) -> None:
        """Error of the autopilot's yaw, and the share of autopilots whose yaw is wrong by any angle."""
        self._compass_sigma_rad, self._outliers = compass_sigma_rad, compass_outliers
        self._points: deque[tuple[int, Array64, float, Array64]] = deque()
        self._segment: int | None = None
        self._fit: OdomYaw | None = None  # of the present window
        self._by_attitude: OdomYaw | None = None  # by the body's yaw and the autopilot's attitude
        self.odom_yaw: OdomYaw | None = None  # the most certain so far; it stays when the autopilot's odometry ends
        self.confirmed = False  # whether the object that is followed has moved as the odometry

    def restart(self) -> None:
        """Drop everything: another frame `map` or `odom`, or another object."""
        self._points.clear()
        self._fit, self._by_attitude, self.odom_yaw, self.confirmed = None, None, None, False

    def on_found(self) -> None:
        """An object is found that may be another drone: its motion has to confirm the yaw again."""
        self._points.clear()
        self._fit, self.confirmed = None, False

    def start(self, known: OdomYaw | None) -> None:
        """Take a yaw that an earlier run knew; None: nothing."""
        if known is not None:
            self.odom_yaw, self.confirmed = known, True

    def add(self, stamp_ns: int, xyz_map_m: Array64, variance_m2: float, xyz_odom_m: Array64, segment: int) -> None:
        """A LiDAR position (map) and the autopilot's position then; variance of one horizontal axis."""
        if segment != self._segment:
            self.restart()
        self._segment = segment
        points = self._points
        if points and stamp_ns - points[-1][0] < APART_NS:
            return
        points.append((stamp_ns, xyz_map_m[:2], variance_m2, xyz_odom_m[:2]))
        while points[0][0] < stamp_ns - WINDOW_NS:
            points.popleft()
        self._fit = self._measured(stamp_ns)
        if self._fit is not None:
            self._keep(self._fit)

    def _keep(self, new: OdomYaw) -> None:
        kept = self.odom_yaw
        if kept is not None and not kept.agrees(new):
            self.restart()
            return
        self.confirmed = True
        if kept is None or new.sigma_rad <= kept.sigma_at(new.stamp_ns):
            self.odom_yaw = new

    def add_attitude(self, measured: OdomYaw) -> None:
        """The yaw of the axes of the autopilot's attitude in `map`, by the yaw of the body in `map`."""
        kept = self._by_attitude
        if kept is None or measured.sigma_rad <= kept.sigma_at(measured.stamp_ns):
            self._by_attitude = measured

    @property
    def axes(self) -> OdomYaw | None:
        """Yaw of the autopilot's axes in `map`: by motion, or by its attitude if that is sharper and agrees."""
        motion, attitude = self.odom_yaw, self._by_attitude
        if motion is None or attitude is None:
            return motion
        motion_rad = motion.sigma_at(attitude.stamp_ns)
        if motion_rad <= max(SHARP_RAD, attitude.sigma_rad):
            return motion
        off_rad = abs(math.remainder(attitude.yaw_rad - motion.yaw_rad, 2 * math.pi))
        compass_is_right = off_rad + 2.0 * math.hypot(motion_rad, attitude.sigma_rad) < WRONG_COMPASS_RAD
        return attitude if compass_is_right else motion

    def evidence(self, stamp_ns: int, R_odom_drone: Array64) -> YawEvidence | None:
        """Yaw of the body at a time with the autopilot's attitude then; None: the motion does not show it."""
        fit = self._fit
        if fit is None or not self._points or stamp_ns - fit.stamp_ns > CURRENT_NS:
            return None
        sigma = math.hypot(fit.sigma_rad, self._compass_sigma_rad)
        return YawEvidence(fit.yaw_rad + heading_rad(R_odom_drone), sigma, self._outliers)

    def _measured(self, stamp_ns: int) -> OdomYaw | None:
        """Yaw of `odom` in `map` by the displacements of the window; None: they do not show it."""
        points = self._points
        if len(points) < LEAST_POINTS:
            return None
        t = np.array([p[0] - points[0][0] for p in points]) * 1e-9
        z, x = np.array([p[1] for p in points]), np.array([p[3] for p in points])
        variance = np.array([p[2] for p in points]) + FIX_FLOOR_M**2
        wander = WANDER_M**2 * np.exp(-np.abs(t[:, None] - t) / WANDER_S)
        inverse = np.linalg.inv(np.diag(variance) + wander + DRIFT_MPS**2 * np.outer(t, t))
        ones = inverse.sum(axis=1)
        W = inverse - np.outer(ones, ones) / ones.sum()
        Wx = W @ x
        precision = float((x * Wx).sum())
        if precision * LEAST_M**2 < 1.0 or float(np.ptp(x, axis=0).max()) < LEAST_M:
            return None
        z_level, x_level = z[:, 0] + 1j * z[:, 1], x[:, 0] + 1j * x[:, 1]
        a: complex = np.vdot(W @ x_level, z_level).item() / precision
        left = z_level - z_level.mean() - a * (x_level - x_level.mean())
        chi2 = float(left.real @ W @ left.real + left.imag @ W @ left.imag)
        if abs(abs(a) - 1.0) > LENGTH_SLACK or chi2 > WORST_CHI2 * 2 * (len(points) - 2):
            return None
        sigma = max(1.0 / math.sqrt(precision), abs(abs(a) - 1.0))  # the error of a, seen along it, is as large across
        return OdomYaw(stamp_ns, math.atan2(a.imag, a.real), sigma)
