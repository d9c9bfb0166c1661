"""Bank of yaw hypotheses: an error-state Kalman filter for each, weighted by the likelihood of its innovations.

The specific force of the drone, turned by the right yaw, explains the LiDAR positions; turned by a wrong one it does
not. Each hypothesis starts at its own yaw and estimates position, velocity, attitude and IMU biases. A measurement has
an outlier share o with a constant density u, so no single one excludes a hypothesis:

    L = (1 - o) N(r; 0, S) + o u,   w <- w L,   beta = (1 - o) N / L
    x <- x + beta K r,   P <- P - beta K S K^T + beta (1 - beta) K r r^T K^T        (moments of both cases)

Hypotheses that agree are merged, improbable ones dropped. Those more than NEAR_RAD apart do not agree, whatever their
weights: a probability of 0.0004 of yaws round the circle would widen a sigma of 4.5 deg to 5. Where there are too many,
those are merged that lose least, in proportion to their probability. A hypothesis with a large yaw sigma is split in
three, so that the linearisation holds.

START_GYRO_BIAS: ArduPilot averages the gyro at boot until two averages agree within 0.1 deg/s = 0.0017 rad/s
(AP_InertialSensor::_init_gyro). In the log of a flight (Pixhawk, ArduCopter 3.1.3, two IMUs, 330 s) calibrated gyros
have a mean of at most 0.0022 rad/s per axis (0.0013 RMS) over the 7 s before take-off; in flight they differ from each
other by at most 0.0038 per axis (0.0019 RMS for each one, if independent), and the difference changes by 0.0047 at
take-off. EKF3 assumes 0.0087 (0.5 deg/s) after a calibration. Too small a value makes a wrong yaw look certain.

Source: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), 11 (static multiple
model), and PDA, 3.4 of Bar-Shalom and Li (1995), with one measurement; split: Faubel et al. (2009), 3 components;
merging: Runnalls (2007), Kullback-Leibler approach to Gaussian mixture reduction, by the yaw.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64, rotation_z
from stages.heading.inertial_state import (
    ACCEL_BIAS,
    GYRO_BIAS,
    POSITION,
    SIZE,
    THETA,
    VELOCITY,
    InertialState,
)
from stages.kernels.geometry.so3 import exp_rotation
from stages.kernels.heading.moments import moments as compiled_moments

STARTS, MOST = 12, 24
START_TILT_RAD = math.radians(3.0)  # of the autopilot's roll and pitch
START_YAW_RAD = 0.6 * 2 * math.pi / STARTS
START_MPS = 4.0  # an unknown velocity, one axis
START_ACCEL_BIAS = 0.2  # [m/s^2]
START_GYRO_BIAS = 0.005  # [rad/s] one axis, after the autopilot's calibration of the gyro at boot; see the docstring
WIDEST_YAW_RAD = math.radians(22.0)  # a hypothesis with a larger sigma is split
SPLIT_SHARE, SPLIT_SHIFT, SPLIT_SIGMA = 0.2252, 1.0566, 0.6716
DROPPED = 1e-8  # a less probable hypothesis is dropped
LOSS = 0.2  # of information [nat] below which two hypotheses may be merged, for each unit of their probability
ALIKE_RAD = math.radians(3.0)
NEAR_RAD = math.radians(20.0)  # a yaw this near to the right one counts as right
WITH_CAMERAS_RAD = math.radians(10.0)  # the same, while matches of cameras may be of another street
LEAST_CANDIDATE = 0.05  # a less probable hypothesis is not the best one


@dataclass(frozen=True)
class YawMixture:
    """Normal densities of a yaw."""

    yaw_rad: Array64  # (n,)
    variance_rad2: Array64  # (n,)
    weight: Array64  # (n,) sums to 1

    def best(self, reach_rad: float) -> tuple[int, float]:
        """Index of the part with the most probability within a reach, and that probability."""
        sigma = np.sqrt(self.variance_rad2)
        near = np.zeros(len(sigma))
        for i in np.flatnonzero(self.weight > LEAST_CANDIDATE):
            near[i] = _within(self.yaw_rad - self.yaw_rad[i], sigma, reach_rad) @ self.weight
        best = int(np.argmax(near))
        return best, float(near[best])


class InertialBank:
    """Yaw hypotheses and their normalised log weights."""

    def __init__(self, state: InertialState, log_weight: Array64) -> None:
        self.state, self.log_weight = state, log_weight - _log_sum(log_weight)
        self.tied = np.zeros(len(state), dtype=np.bool_)  # to a match of both cameras (rotation_matches.py)
        self.log_evidence = 0.0  # log density of the newest measurement, outliers included

    @property
    def weight(self) -> Array64:
        """(n,) probabilities; they sum to 1."""
        return np.exp(self.log_weight)

    def update(
        self, residual: Array64, H: Array64, noise: Array64, outlier_share: float, outlier_density: float
    ) -> float:
        """Add a measurement: residual (n, m), H (n, m, 15), noise (m, m) or (n, m, m).

        Returns the probability that it is no outlier.
        """
        P = self.state.covariance
        PHt = P @ np.swapaxes(H, 1, 2)
        S = H @ PHt + noise
        inverse = np.linalg.inv(S)
        Sr = np.einsum("nij,nj->ni", inverse, residual)
        log_in = log_normal(np.einsum("ni,ni->n", residual, Sr), S) + math.log(1.0 - outlier_share)
        log_all = np.logaddexp(log_in, math.log(outlier_share * outlier_density))
        beta = np.exp(log_in - log_all)
        step = np.einsum("nij,nj->ni", PHt, Sr)
        K = PHt @ inverse
        after = P - beta[:, None, None] * (K @ np.swapaxes(PHt, 1, 2))
        after += (beta * (1.0 - beta))[:, None, None] * step[:, :, None] * step[:, None, :]
        state = self.state
        self.state = InertialState(
            state.R, state.xyz_m, state.velocity_mps, state.bias, 0.5 * (after + np.swapaxes(after, 1, 2))
        ).moved(beta[:, None] * step)
        log_weight = self.log_weight + log_all
        self.log_evidence = _log_sum(log_weight)
        self.log_weight = log_weight - self.log_evidence
        return float(self.weight @ beta)

    def replace(self, state: InertialState, log_weight: Array64, tied: NDArray[np.bool_]) -> None:
        """Other hypotheses, with log weights (n,) that need not be normalised."""
        self.state, self.log_weight, self.tied = state, log_weight - _log_sum(log_weight), tied
        self.tidy()

    def drop_tied(self) -> None:
        """The matches of both cameras are wrong: the free hypotheses remain. Without any, the others become free."""
        free = np.flatnonzero(~self.tied)
        if len(free):
            self.replace(self.state.rows(free), self.log_weight[free], self.tied[free])
        else:
            self.tied = np.zeros(len(self.state), dtype=np.bool_)

    def tidy(self) -> None:
        """Drop improbable hypotheses, split wide ones and merge those that agree."""
        keep = np.flatnonzero(self.log_weight > self.log_weight.max() + math.log(DROPPED))
        if len(keep) < len(self.log_weight):
            self.state, self.log_weight, self.tied = self.state.rows(keep), self.log_weight[keep], self.tied[keep]
            self.log_weight -= _log_sum(self.log_weight)
        wide = np.sqrt(self.state.yaw_variance_rad2) > WIDEST_YAW_RAD
        if wide.any():
            self._split(np.flatnonzero(wide))
        while self._merge_nearest():
            pass

    def _split(self, wide: NDArray[np.intp]) -> None:
        """Replace each of some hypotheses by three along its yaw."""
        state, log_weight = self.state.rows(wide), self.log_weight[wide]
        up = np.zeros((len(wide), SIZE))
        up[:, THETA] = state.R[:, 2, :]
        sigma = np.sqrt(state.yaw_variance_rad2)[:, None]
        along = np.einsum("nij,nj->ni", state.covariance, up) / sigma
        P = state.covariance - (1.0 - SPLIT_SIGMA**2) * along[:, :, None] * along[:, None, :]
        narrow = InertialState(state.R, state.xyz_m, state.velocity_mps, state.bias, P)
        parts = [narrow.moved(shift * SPLIT_SHIFT * along) for shift in (-1.0, 0.0, 1.0)]
        shares = np.log([SPLIT_SHARE, 1.0 - 2 * SPLIT_SHARE, SPLIT_SHARE])
        rest = np.setdiff1d(np.arange(len(self.log_weight)), wide)
        self.state = joined([self.state.rows(rest), *parts])
        self.log_weight = np.concatenate([self.log_weight[rest], *(log_weight + share for share in shares)])
        self.tied = np.concatenate([self.tied[rest], *[self.tied[wide]] * 3])

    def _merge_nearest(self) -> bool:
        """Merge the two hypotheses that lose least by it, if they agree or there are too many."""
        n = len(self.log_weight)
        if n < 2:
            return False
        yaw, variance, weight = self.state.yaw_rad, self.state.yaw_variance_rad2, self.weight
        apart = np.abs(np.remainder(yaw[:, None] - yaw[None, :] + math.pi, 2 * math.pi) - math.pi)
        a = weight[:, None] / (weight[:, None] + weight[None, :])
        merged2 = a * variance[:, None] + (1 - a) * variance[None, :] + a * (1 - a) * apart**2
        cost = 0.5 * (np.log(merged2) - a * np.log(variance[:, None]) - (1 - a) * np.log(variance[None, :]))
        cost[np.tril_indices(n)] = cost[self.tied[:, None] != self.tied] = math.inf
        merged = cost < LOSS if n > STARTS else (cost < 0.1 * LOSS) | ((apart < ALIKE_RAD) & (cost < LOSS))
        merged &= apart <= NEAR_RAD
        if not np.isfinite(cost).any() or (n <= MOST and not merged.any()):
            return False
        if not merged.any():
            merged, cost = np.isfinite(cost), cost * (weight[:, None] + weight[None, :])
        i, j = np.unravel_index(int(np.argmin(np.where(merged, cost, math.inf))), cost.shape)
        pair = np.array([i, j])
        share = np.exp(self.log_weight[pair] - _log_sum(self.log_weight[pair]))
        one = moments(self.state.rows(pair), share)
        rest = np.setdiff1d(np.arange(n), pair)
        log_weight = _log_sum(self.log_weight[pair])
        self.state = joined([self.state.rows(rest), one])
        self.log_weight = np.append(self.log_weight[rest], log_weight)
        self.tied = np.append(self.tied[rest], self.tied[i])
        return True

    @property
    def yaws(self) -> YawMixture:
        """The yaw of each hypothesis."""
        return YawMixture(self.state.yaw_rad, self.state.yaw_variance_rad2, self.weight)

    def mean(self) -> InertialState:
        """One hypothesis with the moments of all: valid for position and velocity, not for the rotation."""
        return moments(self.state, self.weight)


def start(
    xyz_m: Array64,
    covariance_m2: Array64,
    velocity: tuple[Array64, float] | None,
    up_drone: Array64,
    memory: tuple[float, float, float] | None = None,
) -> InertialBank:
    """Hypotheses at yaws round the circle, at a LiDAR position.

    velocity: map, with its sigma [m/s]. up_drone: the vertical in drone axes. memory: a yaw [rad] known before,
    its sigma [rad] and the probability that it still holds.
    """
    yaws = 2 * math.pi / STARTS * np.arange(STARTS)
    sigma, log_weight = np.full(STARTS, START_YAW_RAD), np.zeros(STARTS)
    if memory is not None:
        yaws, sigma = np.append(yaws, memory[0]), np.append(sigma, max(memory[1], math.radians(1.0)))
        probability = min(max(memory[2], DROPPED), 1.0 - DROPPED)
        log_weight += math.log((1.0 - probability) / STARTS)
        log_weight = np.append(log_weight, math.log(probability))
    n = len(yaws)
    R_level = level(up_drone)
    R = np.array([rotation_z(yaw) @ R_level for yaw in yaws])
    v, v_sigma = (np.zeros(3), START_MPS) if velocity is None else velocity
    P = np.zeros((n, SIZE, SIZE))
    tilt = np.einsum("ij,kj->ik", np.eye(3), np.eye(3)) - np.outer(up_drone, up_drone)
    P[:, THETA, THETA] = START_TILT_RAD**2 * tilt + sigma[:, None, None] ** 2 * np.outer(up_drone, up_drone)
    P[:, POSITION, POSITION] = covariance_m2
    for part, s in ((VELOCITY, v_sigma), (ACCEL_BIAS, START_ACCEL_BIAS), (GYRO_BIAS, START_GYRO_BIAS)):
        P[:, part, part] = s**2 * np.eye(3)
    state = InertialState(R, np.tile(xyz_m, (n, 1)), np.tile(v, (n, 1)), np.zeros((n, 6)), P)
    return InertialBank(state, log_weight)


def level(up_drone: Array64) -> Array64:
    """The smallest rotation (3, 3) that takes the vertical in drone axes to z."""
    x, y, z = up_drone / np.linalg.norm(up_drone)
    phi = np.array([y, -x, 0.0])
    sin = math.hypot(x, y)
    if sin < 1e-9:
        return np.eye(3)
    return exp_rotation(phi * (math.atan2(sin, z) / sin))


def joined(states: list[InertialState]) -> InertialState:
    """The hypotheses of several states in one."""
    return InertialState(
        np.concatenate([s.R for s in states]),
        np.concatenate([s.xyz_m for s in states]),
        np.concatenate([s.velocity_mps for s in states]),
        np.concatenate([s.bias for s in states]),
        np.concatenate([s.covariance for s in states]),
    )


def moments(state: InertialState, weight: Array64) -> InertialState:
    """One hypothesis (1 row) with the mean and covariance of several; weight (n,) sums to 1."""
    return InertialState(*(one[None] for one in compiled_moments(*state.contiguous(), weight)))


def log_normal(d2: Array64, S: Array64) -> Array64:
    """(n,) logarithm of the normal density with covariance S (n, m, m) at squared Mahalanobis distances d2 (n,)."""
    return -0.5 * (d2 + np.linalg.slogdet(S)[1] + S.shape[-1] * math.log(2 * math.pi))


def _within(off_rad: Array64, sigma_rad: Array64, reach_rad: float) -> Array64:
    """(n,) probability that a normal yaw lies within a reach of another."""
    off = np.abs(np.remainder(off_rad + math.pi, 2 * math.pi) - math.pi)
    s = np.sqrt(2.0) * sigma_rad
    return np.array(
        [0.5 * (math.erf((reach_rad - o) / k) + math.erf((reach_rad + o) / k)) for o, k in zip(off, s, strict=True)]
    )


def _log_sum(values: Array64) -> float:
    top = float(values.max())
    return top + math.log(float(np.exp(values - top).sum()))
