"""Factors of a cue in the graph: a measurement of position and bias, and the bias over time.

    z = h(t - t_vehicle) + b (+ phi e_z x (t - t_vehicle)) + v       pose X_k, state of the cue C_m = (b, phi)
    C_m+1 = exp(-dt / T) C_m + w,   stationary covariance of the prior       (first-order Gauss-Markov)

h: stages/cues/evidence.py. phi, the error of the yaw between north and frame map, belongs to a POSITION alone. A
measurement between two keys is moved to the nearest one by the displacement of the estimate between them.

Source: ours; Brown, Hwang, Introduction to Random Signals and Applied Kalman Filtering, ch. 3 (Gauss-Markov).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import gtsam
import numpy as np

from stages.cues.evidence import measure
from stages.geometry.frames import Array64
from stages.messages import CueKind, DroneCue

YAW_TIME_S = 60.0  # correlation time of the yaw between north and frame map: that of stages/cues/map_north.py
LEAST_YAW_RAD = 1e-3  # for a yaw that is stated to be exact
HUBER = 1.345  # [sigma]


class CueValue(NamedTuple):
    """What a cue would measure, and the Jacobians by position (n, 3) and by the state of the cue (n, m)."""

    value_m: Array64
    by_position: Array64
    by_state: Array64


def prior_covariance(cue: DroneCue) -> Array64:
    """(m, m) stationary covariance of the state of a cue."""
    if cue.kind is not CueKind.POSITION:
        return cue.bias_covariance_m2
    whole = np.zeros((4, 4))
    whole[:3, :3], whole[3, 3] = cue.bias_covariance_m2, max(cue.yaw_sigma_rad, LEAST_YAW_RAD) ** 2
    return whole


def kept_shares(cue: DroneCue, dt_s: float) -> Array64:
    """(m,) exp(-dt / T) of each element of the state."""
    bias = np.full(len(cue.value_m), math.exp(-dt_s / cue.bias_time_s))
    return np.append(bias, math.exp(-dt_s / YAW_TIME_S)) if cue.kind is CueKind.POSITION else bias


def predicted_value(cue: DroneCue, offset_m: Array64, state: Array64) -> CueValue:
    """What a cue would measure of a drone at `offset_m` (3,) from the vehicle, frame map, with its state (m,)."""
    n = len(cue.value_m)
    value_m, H = measure(cue.kind, offset_m, cue.reference_map_m)
    if cue.kind is not CueKind.POSITION:
        return CueValue(value_m + state, H, np.eye(n))
    across = np.array([-offset_m[1], offset_m[0], 0.0])
    turn = np.array([[0.0, -state[3], 0.0], [state[3], 0.0, 0.0], [0.0, 0.0, 0.0]])
    return CueValue(value_m + state[:3] + state[3] * across, H + turn, np.column_stack([np.eye(3), across]))


def measurement_factor(pose: int, state: int, cue: DroneCue, origin_map_m: Array64, noise_m2: Array64) -> Any:
    """Factor of a measurement on a pose and a state of the cue, by their keys.

    `origin_map_m`: position (3,) of the vehicle less the drone's displacement since the pose.
    """

    def error(_: Any, values: Any, H: list[Array64] | None) -> Array64:
        at = values.atPose3(pose)
        made = predicted_value(cue, at.translation() - origin_map_m, values.atVector(state))
        if H is not None:
            by_pose = np.zeros((len(made.value_m), 6))
            by_pose[:, 3:] = made.by_position @ at.rotation().matrix()
            H[0], H[1] = np.asfortranarray(by_pose), np.asfortranarray(made.by_state)
        return made.value_m - cue.value_m

    huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER)
    noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(noise_m2))
    return gtsam.CustomFactor(noise, [pose, state], error)


def prior_factor(state: int, covariance: Array64) -> Any:
    """Factor of the first state of a cue: zero with this covariance (m, m)."""
    return gtsam.PriorFactorVector(state, np.zeros(len(covariance)), gtsam.noiseModel.Gaussian.Covariance(covariance))


def change_factor(before: int, after: int, kept: Array64, prior: Array64) -> Any:
    """Factor between two states of a cue; `kept` (m,) as `kept_shares`, `prior` (m, m) as `prior_covariance`."""
    n = len(kept)
    whiten = np.linalg.inv(np.linalg.cholesky(prior - kept[:, None] * prior * kept))
    at_zero = gtsam.Values()
    at_zero.insert(before, np.zeros(n))
    at_zero.insert(after, np.zeros(n))
    factor = gtsam.JacobianFactor(
        before,
        np.asfortranarray(-whiten * kept),
        after,
        np.asfortranarray(whiten),
        np.zeros(n),
        gtsam.noiseModel.Unit.Create(n),
    )
    return gtsam.LinearContainerFactor(factor, at_zero)
