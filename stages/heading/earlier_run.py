"""Heading of an earlier run of grd, after a restart in flight: one hypothesis, and the yaw of the autopilot's frame.

It holds if the autopilot's frame has not changed meanwhile. A LiDAR position at the distance d from the prior's
decides, with the share s of changed frames, whose positions are anywhere within an area:

    P = (1 - s) N(d; S) / ((1 - s) N(d; S) + s / FRAME_AREA_M2)

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.geometry.se3 import mahalanobis2
from stages.heading.odometry_heading import OdomYaw
from stages.messages import HeadingPrior

PRIOR_NS = 150_000_000  # between a prior and the LiDAR position with which it is used
FRAME_AREA_M2 = math.pi * 10.0**2  # a position in a changed frame is somewhere within 10 m
AGREEING = 5  # LiDAR positions in a row that have to agree with the prior for the yaw of the frame
HOLDS = 0.99  # probability from which one agrees


class EarlierRun:
    """The newest prior, until a heading is known in this run."""

    def __init__(self, changed_frames: float) -> None:
        """`changed_frames`: share of restarts while the autopilot changes its frame."""
        self._share = changed_frames
        self.prior: HeadingPrior | None = None
        self._used = False
        self._agreeing = 0

    def heading(
        self, stamp_ns: int, xyz_map_m: Array64, covariance_m2: Array64, decided: bool
    ) -> tuple[float, float, float] | None:
        """Yaw and sigma [rad] and the probability that they hold, once; None: none, or not needed any more."""
        self._used = self._used or decided
        holds = self._probability(stamp_ns, xyz_map_m, covariance_m2)
        if self._used or self.prior is None or holds is None:
            return None
        self._used = True
        return self.prior.yaw_map_rad, self.prior.sigma_rad, holds

    def odom_yaw(self, stamp_ns: int, xyz_map_m: Array64, covariance_m2: Array64) -> OdomYaw | None:
        """Yaw of the autopilot's frame when enough LiDAR positions in a row agree with the prior's position."""
        holds = self._probability(stamp_ns, xyz_map_m, covariance_m2)
        self._agreeing = self._agreeing + 1 if holds is not None and holds > HOLDS else 0
        if self._agreeing < AGREEING or self.prior is None:
            return None
        return OdomYaw(stamp_ns, self.prior.yaw_map_odom_rad, self.prior.sigma_rad)

    def _probability(self, stamp_ns: int, xyz_map_m: Array64, covariance_m2: Array64) -> float | None:
        """Probability that the prior holds, by a LiDAR position; None: there is no prior of that time."""
        prior = self.prior
        if prior is None or abs(stamp_ns - prior.stamp_ns) > PRIOR_NS:
            return None
        S = covariance_m2[:2, :2] + prior.position_sigma_m**2 * np.eye(2)
        off_m = (xyz_map_m - prior.xyz_map_m)[:2]
        density = math.exp(-0.5 * mahalanobis2(off_m, S)) / (2 * math.pi * math.sqrt(np.linalg.det(S)))
        kept = (1.0 - self._share) * density
        return kept / (kept + self._share / FRAME_AREA_M2)
