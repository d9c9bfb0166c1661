"""Hypothesis that a frame is the same as before an interruption: then the heading of before holds, propagated.

    restart of grd in flight          frame odom; the drone's state is propagated by the autopilot
    outage of the vehicle's motion    frame `map`; it is propagated by the drone's IMU (`map_outage.py`)

A LiDAR position z decides, and the angle a between the direction of flight and the prior's. With the prior turned by an
angle b about the vehicle, their likelihoods over those of any position within an area and of any direction are

    L_p(b) = N(z; prior turned by b, S) FRAME_AREA_M2
    L_v(b) = exp(k cos(a - b)) / I0(k),   k = |v| |v_prior| / sigma_v^2

A share s of the frames is another one, displaced by anything. After an outage half of these are turned about the
vehicle by any angle instead, as when an odometry restarts at its place. Of these b only those count that the vehicle's
own poses do not exclude:

    P = (1 - s) L_p(0) L_v(0) / ((1 - s) L_p(0) L_v(0) + s L_other),   L_other = 1 or (1 + mean_b L_p(b) L_v(b)) / 2

So a drone that hovers above a moving vehicle does not show that the frame is the same: turned it would be there, too.
For the heading turns by less than NEAR_RAD count as the same, and increase its sigma.

Another object than the drone may be anywhere within that area, but may fly in the same direction as the drone: the same
without L_v gives

    log ratio of the drone against another object = ln((1 - s) L_p(0) + s L_other)

The prior's errors are common to all positions, and its sigmas grow: the first ones decide, and later ones add nothing.

Source: ours; L_v: Mardia and Jupp, Directional Statistics (2000) (von Mises: a normal velocity, given its length).
"""

from __future__ import annotations

import math
from statistics import median
from typing import NamedTuple

import numpy as np

from stages.geometry.frames import Array64
from stages.heading.inertial_bank import NEAR_RAD
from stages.heading.inertial_heading import FREE_SIGMA_MPS
from stages.heading.odometry_heading import OdomYaw
from stages.messages import HeadingPrior

PRIOR_NS = 150_000_000  # between a prior and the LiDAR position with which it is used
FRAME_AREA_M2 = math.pi * 10.0**2  # a position in a displaced frame is somewhere within 10 m
FIRST = 5  # LiDAR positions whose median probability decides on the yaw of the frame: two may be outliers
HOLDS = 0.99  # probability from which the frame is the same
TURNS_RAD = np.radians(np.r_[0.0:180.0, -180.0:0.0])
TINY = np.finfo(float).tiny


class PriorHeading(NamedTuple):
    """Heading of the prior at a LiDAR position."""

    yaw_rad: float
    sigma_rad: float
    probability: float  # that it is the right one, to NEAR_RAD
    log_ratio: float  # of the drone against another object at the position


class SameFrame:
    """Compares LiDAR positions with priors of their times, until a heading is known."""

    def __init__(self, changed_frames: float, turn_rad: float) -> None:
        """Share of interruptions after which the frame is another one, and its largest turn about the vehicle."""
        self._share = changed_frames
        self._possible = np.cos(TURNS_RAD) >= math.cos(turn_rad)
        self._newest: HeadingPrior | None = None  # with which the newest LiDAR position was compared
        self._heading: PriorHeading | None = None  # by it
        self._used = False
        self._first: list[float] = []  # P that the prior holds at each of the FIRST positions of an object

    def restart(self) -> None:
        """Positions from now on may be those of another object."""
        self._first.clear()

    def add(
        self,
        prior: HeadingPrior | None,
        stamp_ns: int,
        xyz_map_m: Array64,
        covariance_m2: Array64,
        velocity_map_mps: Array64 | None,
        vehicle_map_m: Array64 | None,
    ) -> None:
        """Add a LiDAR position with a prior of its time, and the tracker's velocity if it is known.

        `vehicle_map_m`: the frame may be turned about this position; None: a restart of grd.
        """
        self._newest = self._heading = None
        if prior is None or abs(stamp_ns - prior.stamp_ns) > PRIOR_NS:
            return
        turns_rad = TURNS_RAD[:1] if vehicle_map_m is None else TURNS_RAD
        about_m = xyz_map_m if vehicle_map_m is None else vehicle_map_m
        by_position = _position_ratios(prior, stamp_ns, xyz_map_m, covariance_m2, about_m, turns_rad)
        by_both = by_position
        if velocity_map_mps is not None:
            by_both = by_position * _direction_ratios(prior, velocity_map_mps)[: len(turns_rad)]
        same, turned, displaced = self._weighted(by_both)
        total = same + float(turned.sum()) + displaced
        near = np.where(np.abs(turns_rad) < NEAR_RAD, turned, 0.0)
        holds = same + float(near.sum())
        sigma_rad = math.sqrt(prior.sigma_rad**2 + float(near @ turns_rad**2) / max(holds, TINY))
        any_frame = sum(float(np.sum(weight)) for weight in self._weighted(by_position))
        self._newest = prior
        self._heading = PriorHeading(prior.yaw_map_rad, sigma_rad, holds / total, math.log(any_frame))
        if len(self._first) < FIRST:
            self._first.append(same / total)

    def _weighted(self, ratios: Array64) -> tuple[float, Array64, float]:
        """Likelihood ratios times their shares: the same frame, turned ones (n,), displaced ones; `ratios` (n,)."""
        same = (1.0 - self._share) * float(ratios[0])
        if len(ratios) == 1:
            return same, np.zeros(1), self._share
        return same, self._share / 2 / len(ratios) * self._possible * ratios, self._share / 2

    def heading(self, decided: bool) -> PriorHeading | None:
        """Heading at the newest LiDAR position, once; None: none, or not needed any more."""
        self._used = self._used or decided
        if self._used or self._heading is None:
            return None
        self._used = True
        return self._heading

    def contradicts(self, yaw_rad: float) -> bool:
        """Whether a yaw of the body that is decided at the newest LiDAR position is another one than the prior's."""
        if self._newest is None:
            return False
        off_rad = abs(math.remainder(yaw_rad - self._newest.yaw_map_rad, 2 * math.pi))
        return off_rad > NEAR_RAD + 3.0 * self._newest.sigma_rad

    def odom_yaw(self, stamp_ns: int) -> OdomYaw | None:
        """Yaw of the autopilot's frame if the first LiDAR positions show that the frame is the same."""
        prior = self._newest
        if prior is None or len(self._first) < FIRST or median(self._first) <= HOLDS:
            return None
        if math.isnan(prior.yaw_map_odom_rad):
            return None
        return OdomYaw(stamp_ns, prior.yaw_map_odom_rad, prior.sigma_rad)


def _position_ratios(
    prior: HeadingPrior,
    stamp_ns: int,
    xyz_map_m: Array64,
    covariance_m2: Array64,
    about_m: Array64,
    turns_rad: Array64,
) -> Array64:
    """L_p (n,) at turns (n,) about a position."""
    S = covariance_m2[:2, :2] + prior.position_sigma_m**2 * np.eye(2)
    expected_m = prior.xyz_map_m + 1e-9 * (stamp_ns - prior.stamp_ns) * prior.velocity_map_mps
    relative_m = (expected_m - about_m)[:2]
    c, s = np.cos(turns_rad), np.sin(turns_rad)
    turned_m = np.column_stack([c * relative_m[0] - s * relative_m[1], s * relative_m[0] + c * relative_m[1]])
    off_m = (xyz_map_m - about_m)[:2] - turned_m
    chi2 = np.einsum("ni,ij,nj->n", off_m, np.linalg.inv(S), off_m)
    return FRAME_AREA_M2 * np.exp(-0.5 * chi2) / (2 * math.pi * math.sqrt(np.linalg.det(S)))


def _direction_ratios(prior: HeadingPrior, velocity_map_mps: Array64) -> Array64:
    """L_v at TURNS_RAD (n,)."""
    v, v_prior = velocity_map_mps[:2], prior.velocity_map_mps[:2]
    variance = FREE_SIGMA_MPS**2 + prior.velocity_sigma_mps**2
    k = math.hypot(*v) * math.hypot(*v_prior) / variance
    a = math.atan2(v[1], v[0]) - math.atan2(v_prior[1], v_prior[0])
    at_angle = np.exp(k * (np.cos(a - TURNS_RAD) - 1.0))
    return at_angle / at_angle.mean()  # the mean of exp(k cos) over all directions is I0(k)
