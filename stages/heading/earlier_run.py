"""Heading of an earlier run of grd, after a restart in flight: one hypothesis, and the yaw of the autopilot's frame.

The same after an outage of the vehicle's motion, with the drone's own state before (`map_outage.py`). It holds if the
autopilot's frame, or frame `map`, has not changed meanwhile. A LiDAR position at the distance d from the prior's
decides, with the share s of changed frames, whose positions are anywhere within an area. So does the direction of
flight at the angle a from the prior's: in a changed frame it is any.

    L_p = N(d; S) FRAME_AREA_M2,   L_v = exp(k cos a) / I0(k),   k = |v| |v_prior| / sigma_v^2
    P = (1 - s) L_p L_v / ((1 - s) L_p L_v + s)

Another object than the drone may be anywhere within that area, too, but may fly in the same direction as the drone:

    log ratio of the drone against another object = ln((1 - s) L_p + s)

Source: ours; L_v: Mardia and Jupp, Directional Statistics (2000) (von Mises: a normal velocity, given its length).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stages.geometry.frames import Array64
from stages.geometry.se3 import mahalanobis2
from stages.heading.inertial_heading import FREE_SIGMA_MPS
from stages.heading.odometry_heading import OdomYaw
from stages.messages import HeadingPrior

PRIOR_NS = 150_000_000  # between a prior and the LiDAR position with which it is used
FRAME_AREA_M2 = math.pi * 10.0**2  # a position in a changed frame is somewhere within 10 m
AGREEING = 5  # LiDAR positions in a row that have to agree with the prior for the yaw of the frame
HOLDS = 0.99  # probability from which one agrees
ALL_COSINES = np.cos(np.linspace(0.0, 2 * math.pi, 360, endpoint=False))


class EarlierHeading(NamedTuple):
    """Heading of the earlier run at a LiDAR position."""

    yaw_rad: float
    sigma_rad: float
    probability: float  # that it holds
    log_ratio: float  # of the drone against another object at the position


class EarlierRun:
    """The newest prior, until a heading is known in this run."""

    def __init__(self, changed_frames: float) -> None:
        """`changed_frames`: share of restarts while the autopilot changes its frame."""
        self._share = changed_frames
        self.prior: HeadingPrior | None = None
        self._at_fix: tuple[HeadingPrior, float, float] | None = None  # prior, P that it holds, log ratio
        self._used = False
        self._agreeing = 0

    def add(self, stamp_ns: int, xyz_map_m: Array64, covariance_m2: Array64, velocity_map_mps: Array64 | None) -> None:
        """Add a LiDAR position, and the tracker's velocity if it is known."""
        prior, self._at_fix = self.prior, None
        if prior is not None and abs(stamp_ns - prior.stamp_ns) <= PRIOR_NS:
            near = (1.0 - self._share) * _position_ratio(prior, stamp_ns, xyz_map_m, covariance_m2)
            holds = near if velocity_map_mps is None else near * _direction_ratio(prior, velocity_map_mps)
            self._at_fix = prior, holds / (holds + self._share), math.log(near + self._share)
        agrees = self._at_fix is not None and self._at_fix[1] > HOLDS
        self._agreeing = self._agreeing + 1 if agrees else 0

    def heading(self, decided: bool) -> EarlierHeading | None:
        """Heading at the newest LiDAR position, once; None: none, or not needed any more."""
        self._used = self._used or decided
        if self._used or self._at_fix is None:
            return None
        self._used = True
        prior, holds, log_ratio = self._at_fix
        return EarlierHeading(prior.yaw_map_rad, prior.sigma_rad, holds, log_ratio)

    @property
    def confirmed(self) -> bool:
        """Whether enough LiDAR positions in a row agree with the prior."""
        return self._agreeing >= AGREEING

    def odom_yaw(self, stamp_ns: int) -> OdomYaw | None:
        """Yaw of the autopilot's frame when enough LiDAR positions in a row agree with the prior."""
        if not self.confirmed or self._at_fix is None:
            return None
        prior = self._at_fix[0]
        if math.isnan(prior.yaw_map_odom_rad):
            return None
        return OdomYaw(stamp_ns, prior.yaw_map_odom_rad, prior.sigma_rad)


def _position_ratio(prior: HeadingPrior, stamp_ns: int, xyz_map_m: Array64, covariance_m2: Array64) -> float:
    """Density of a LiDAR position if the prior holds, over that of any within FRAME_AREA_M2."""
    S = covariance_m2[:2, :2] + prior.position_sigma_m**2 * np.eye(2)
    off_m = xyz_map_m - prior.xyz_map_m - 1e-9 * (stamp_ns - prior.stamp_ns) * prior.velocity_map_mps
    density = math.exp(-0.5 * mahalanobis2(off_m[:2], S)) / (2 * math.pi * math.sqrt(np.linalg.det(S)))
    return FRAME_AREA_M2 * density


def _direction_ratio(prior: HeadingPrior, velocity_map_mps: Array64) -> float:
    """Density of the horizontal direction of flight if the prior holds, over that of any direction."""
    v, v_prior = velocity_map_mps[:2], prior.velocity_map_mps[:2]
    variance = FREE_SIGMA_MPS**2 + prior.velocity_sigma_mps**2
    k = math.hypot(*v) * math.hypot(*v_prior) / variance
    mean = float(np.exp(k * (ALL_COSINES - 1.0)).mean())  # I0(k) exp(-k)
    return math.exp(float(v @ v_prior) / variance - k) / mean
