"""Hypothesis bank of the yaw branches: probabilities of the four branches, and of none being right.

The evidence is a displacement of the drone measured twice: by LiDAR in the map frame, and by the drone's odometry,
rotated by each branch k. The evidence of window w for branch k is

    metric     e = d_lidar - Rz(k 90 deg) d_odometry = T b_k + noise,   (1 - o) N(e; T b_k, S) + o / area
    bearing    a = angle from Rz(k 90 deg) d_odometry to d_lidar,
               (1 - o - m) N(a; 0, s) + m N(a; 180 deg, s) + o / 2 pi

The drift of an odometry is correlated over seconds: b_k is the drift velocity that branch k would need, a Gauss-Markov
process estimated by one Kalman filter per branch. A branch with an error of 90 deg needs a drift of 1.4 times the
velocity of the flight, so windows of slow flight together give little evidence. `o` is the share of outliers (a false
fix), `m` that of reversed directions. None of the four is right in two cases. If the LiDAR follows another object, all
directions of d_lidar are equally likely, with the length of the odometry or any other. If the streets were matched at a
wrong angle, a yaw between the branches explains all windows, without the large steady drift that a branch would need.

Source: ours; DESIGN, Yaw branch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from stages.geometry.frames import Array64

NONE = 4  # index of "none of them" in a bank's probabilities
DIRECTIONS = (
    16  # hypotheses over the circle: each fourth is a branch, those between are streets matched at a wrong angle
)
MISALIGNED_SHARE = 0.02  # share of the initial `none` in the hypotheses between the branches; the rest is `none`


class BranchSettings(BaseModel):
    """Error model of the evidence."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    baseline_m: float = Field(default=0.4, gt=0)  # shorter displacements are not used
    metric_outliers: float = Field(default=0.1, gt=0, lt=1)
    bearing_outliers: float = Field(default=0.3, gt=0, lt=1)
    bearing_reversed: float = Field(default=0.1, gt=0, lt=1)
    drift_mps: float = Field(default=0.12, gt=0)  # velocity error of drone's and vehicle's odometry together, one axis
    drift_time_s: float = Field(default=20.0, gt=0)
    scale: float = Field(default=0.05, ge=0)  # relative error of the length of a displacement
    bearing_floor_deg: float = Field(default=9.0, gt=0)
    none_right: float = Field(default=0.05, gt=0, lt=1)  # prior probability that none of the branches is right
    least_windows: int = Field(default=3, ge=1)  # two may agree by chance; with fewer, no branch is RESOLVED
    leak_per_s: float = Field(default=1e-6, ge=0)  # rate at which a known branch returns to the prior


def turns_rad(count: int) -> Array64:
    """Angles (count,) over the circle, from 0 on."""
    return 2 * math.pi / count * np.arange(count, dtype=np.float64)


def turns(count: int) -> Array64:
    """Rotations (count, 2, 2) by `turns_rad`."""
    return np.array([[[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]] for a in turns_rad(count)])


@dataclass(frozen=True)
class Displacement:
    """Horizontal displacement of the drone in one window, by LiDAR and by odometry under branch 0; map frame."""

    start_ns: int
    end_ns: int
    lidar_m: Array64  # (h, 2) for each hypothesis: fixes are averaged along its displacement by odometry
    lidar_m2: Array64  # (2, 2) covariance
    odometry_m: Array64  # (2,) by branch 0; of unknown length when `metric` is false
    bearing_rad: float  # error of the odometry's direction, turned by branch 0
    metric: bool

    @property
    def seconds(self) -> float:
        """Duration."""
        return (self.end_ns - self.start_ns) * 1e-9


class HypothesisBank:
    """Probabilities of the four branches, counted from a tracked yaw, and of none of them."""

    def __init__(self, settings: BranchSettings, hypotheses: int = DIRECTIONS) -> None:
        """`hypotheses`: number over the circle, a multiple of 4."""
        self.settings = settings
        self._turns_rad, self._R = turns_rad(hypotheses), turns(hypotheses)
        self._branches = np.arange(0, hypotheses, hypotheses // 4)
        self.windows = 0  # of evidence since the last reset
        self._last_ns: int | None = None
        self.reset()

    def reset(self, none_right: float | None = None) -> None:
        """Reset to the prior; `none_right`: probability that none is right."""
        self._weight = self._first(self.settings.none_right if none_right is None else none_right)
        self.windows = 0
        self._drift_mps = np.zeros((len(self._R), 2))
        self._drift_m2ps2 = np.tile(np.eye(2) * self.settings.drift_mps**2, (len(self._R), 1, 1))
        self._drift_ns: int | None = None

    def _first(self, none: float) -> Array64:
        """Prior weights (h + 1,): the hypotheses over the circle, then `none`; `none` is their prior probability."""
        weight = np.full(len(self._R) + 1, MISALIGNED_SHARE * none / (len(self._R) - 4))
        weight[self._branches] = (1 - none) / 4
        weight[-1] = (1 - MISALIGNED_SHARE) * none
        return weight

    @property
    def probability(self) -> Array64:
        """Probabilities (5,) of the four branches, and that none of them is right."""
        branches = self._weight[self._branches]
        return np.append(branches, max(1.0 - branches.sum(), 0.0))

    def best(self, current: int) -> int:
        """The most probable branch; `current` on a tie."""
        p = self._weight[self._branches]
        return current if p[current] >= p.max() * (1 - 1e-9) else int(np.argmax(p))

    def resolved(self, branch: int, probability: float) -> bool:
        """Whether motion gives a branch more than that probability."""
        return self.windows >= self.settings.least_windows and bool(self.probability[branch] > probability)

    def pass_time(self, stamp_ns: int) -> None:
        """Leak towards the prior: a known branch may be lost unnoticed."""
        if self._last_ns is not None and stamp_ns > self._last_ns:
            self.mix(1.0 - math.exp(-self.settings.leak_per_s * (stamp_ns - self._last_ns) * 1e-9))
        self._last_ns = stamp_ns if self._last_ns is None else max(stamp_ns, self._last_ns)

    def mix(self, share: float) -> None:
        """Mix with the prior by this share."""
        self._weight = (1 - share) * self._weight + share * self._first(self.settings.none_right)

    def slip(self, weights: Array64) -> None:
        """Shift the branches by `weights` (4,), the probabilities that the true branch is now k + m."""
        h = len(self._R)
        circle = self._weight[:h]
        self._weight[:h] = sum(float(w) * np.roll(circle, m * h // 4) for m, w in enumerate(weights))

    def expect_yaw(self, off_rad: float, sigma_rad: float, trust: float) -> None:
        """Apply a prior yaw: `off_rad` is branch 0 less the prior; `trust` is the probability that it is valid."""
        off = (off_rad + self._turns_rad + math.pi) % (2 * math.pi) - math.pi
        near = np.exp(-0.5 * (off / sigma_rad) ** 2) / (math.sqrt(2 * math.pi) * sigma_rad)
        self._weigh(np.append(trust * near + (1 - trust) / (2 * math.pi), 1 / (2 * math.pi)))

    def see(self, moved: Displacement) -> None:
        """Update by the evidence of one window."""
        self._weigh(self._metric(moved) if moved.metric else self._bearing(moved))
        self.windows += 1

    def _weigh(self, likelihood: Array64) -> None:
        """Bayes' rule; likelihood (h + 1,)."""
        self._weight = self._weight * likelihood
        self._weight /= self._weight.sum()

    def _metric(self, moved: Displacement) -> Array64:
        """Likelihoods (h + 1,); updates the drift of each hypothesis for which the window is an inlier."""
        s, T = self.settings, moved.seconds
        length = float(np.linalg.norm(moved.odometry_m))
        reach = 2.0 * max(length, float(np.linalg.norm(moved.lidar_m[0]))) + 1.0
        outlier_density = 1.0 / (math.pi * reach**2)
        rotated = self._R @ moved.odometry_m
        along = rotated / max(length, 1e-9)
        along_m2 = (s.scale * length) ** 2 * along[:, :, None] * along[:, None, :]
        across = np.column_stack([-along[:, 1], along[:, 0]])
        across_m2 = (moved.bearing_rad * length) ** 2 * across[:, :, None] * across[:, None, :]
        self._drift_to(moved.start_ns)
        fresh = s.drift_mps**2 * (1 - math.exp(-2 * T / s.drift_time_s)) / 3  # drift gathered during the window
        S = moved.lidar_m2 + along_m2 + across_m2 + T**2 * (self._drift_m2ps2 + fresh * np.eye(2))
        e = moved.lidar_m - rotated - T * self._drift_mps
        inverse = np.linalg.inv(S)
        chi2 = np.einsum("hi,hij,hj->h", e, inverse, e)
        inlier = (1 - s.metric_outliers) * np.exp(-0.5 * chi2) / (2 * math.pi * np.sqrt(np.linalg.det(S)))
        accepted = inlier > s.metric_outliers * outlier_density
        gain = T * self._drift_m2ps2 @ inverse * accepted[:, None, None]
        self._drift_mps = self._drift_mps + np.einsum("hij,hj->hi", gain, e)
        self._drift_m2ps2 = self._drift_m2ps2 - T * gain @ self._drift_m2ps2
        self._drift_to(moved.end_ns)
        unrelated = 0.5 * outlier_density + 0.5 * self._same_length(moved, length)
        return np.append(inlier + s.metric_outliers * outlier_density, unrelated)

    def _same_length(self, moved: Displacement, length: float) -> float:
        """Density of a displacement of the odometry's length in any direction: another object with similar motion."""
        s, T = self.settings, moved.seconds
        variance = 0.5 * float(np.trace(moved.lidar_m2)) + (s.scale * length) ** 2 + (T * s.drift_mps) ** 2
        seen = float(np.linalg.norm(moved.lidar_m, axis=1).mean())
        ring = math.exp(-0.5 * (seen - length) ** 2 / variance) / math.sqrt(2 * math.pi * variance)
        return ring / (2 * math.pi * max(seen, math.sqrt(variance)))

    def _drift_to(self, stamp_ns: int) -> None:
        """Propagate the Gauss-Markov drift: it decays over `drift_time_s`."""
        if self._drift_ns is not None and stamp_ns > self._drift_ns:
            keep = math.exp(-(stamp_ns - self._drift_ns) * 1e-9 / self.settings.drift_time_s)
            self._drift_mps = keep * self._drift_mps
            fresh = (1 - keep**2) * self.settings.drift_mps**2
            self._drift_m2ps2 = keep**2 * self._drift_m2ps2 + fresh * np.eye(2)
        self._drift_ns = stamp_ns if self._drift_ns is None else max(self._drift_ns, stamp_ns)

    def _bearing(self, moved: Displacement) -> Array64:
        """Likelihoods (h + 1,) of a direction without a length."""
        s, lidar_m = self.settings, moved.lidar_m
        rotated = self._R @ moved.odometry_m
        length = np.linalg.norm(lidar_m, axis=1)
        variance = moved.bearing_rad**2 + math.radians(s.bearing_floor_deg) ** 2
        variance += (0.5 * float(np.trace(moved.lidar_m2)) + (s.drift_mps * moved.seconds) ** 2) / length**2
        sigma = np.minimum(np.sqrt(variance), 1.5)
        off = np.arctan2(
            rotated[:, 0] * lidar_m[:, 1] - rotated[:, 1] * lidar_m[:, 0], np.einsum("hi,hi->h", rotated, lidar_m)
        )
        right = (1 - s.bearing_outliers - s.bearing_reversed) * np.exp(-0.5 * (off / sigma) ** 2)
        wrong_way = s.bearing_reversed * np.exp(-0.5 * ((np.abs(off) - math.pi) / sigma) ** 2)
        anywhere = 1 / (2 * math.pi)
        near = (right + wrong_way) / (math.sqrt(2 * math.pi) * sigma)
        return np.append(near + s.bearing_outliers * anywhere, anywhere)
