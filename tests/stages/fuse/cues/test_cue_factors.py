"""Factors of cues: Jacobians against differences, and the state over time."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from stages.fuse.cues.cue_factors import (
    change_factor,
    kept_shares,
    measurement_factor,
    predicted_value,
    prior_covariance,
    prior_factor,
)
from stages.geometry.frames import rotation_z
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import CueKind, DroneCue

SIZE = {CueKind.POSITION: 3, CueKind.LEVEL_AND_HEIGHT: 2, CueKind.RANGE: 1, CueKind.HEIGHT: 1}
OFFSET_M = np.array([8.0, -5.0, 9.0])
X, C, D = 1, 2, 3


def cue(kind: CueKind, value_m=None) -> DroneCue:
    n = SIZE[kind]
    return DroneCue(
        stamp_ns=0,
        source="made",
        kind=kind,
        value_m=np.zeros(n) if value_m is None else np.asarray(value_m, dtype=np.float64),
        covariance_m2=0.04 * np.eye(n),
        bias_covariance_m2=np.diag(np.arange(4.0, 4.0 + n)),
        bias_time_s=100.0,
        yaw_sigma_rad=0.05,
        reference_map_m=np.array([0.3, 0.2, 0.5]),
    )


@pytest.mark.parametrize("kind", CueKind)
def test_jacobians_are_derivatives(kind):
    z = cue(kind)
    m = len(prior_covariance(z))
    state = 0.1 * np.arange(1.0, m + 1.0)
    made = predicted_value(z, OFFSET_M, state)
    for axis in range(3):
        d = 1e-6 * np.eye(3)[axis]
        ahead, behind = (predicted_value(z, OFFSET_M + s * d, state).value_m for s in (1, -1))
        assert made.by_position[:, axis] == pytest.approx((ahead - behind) / 2e-6, abs=1e-6)
    for k in range(m):
        d = 1e-6 * np.eye(m)[k]
        ahead, behind = (predicted_value(z, OFFSET_M, state + s * d).value_m for s in (1, -1))
        assert made.by_state[:, k] == pytest.approx((ahead - behind) / 2e-6, abs=1e-6)


@pytest.mark.parametrize("kind", CueKind)
def test_the_jacobian_of_a_factor_is_that_by_the_pose(kind):
    z = cue(kind)
    m = len(prior_covariance(z))
    factor = measurement_factor(X, C, z, np.array([1.0, 2.0, 0.5]), np.eye(len(z.value_m)))
    pose = gtsam.Pose3(gtsam.Rot3(exp_rotation(np.array([0.2, -0.1, 1.1]))), OFFSET_M)
    values = gtsam.Values()
    values.insert(X, pose)
    values.insert(C, 0.01 * np.ones(m))

    def whitened(by_pose, by_state):
        moved = gtsam.Values()
        moved.insert(X, pose.retract(by_pose))
        moved.insert(C, 0.01 * np.ones(m) + by_state)
        return factor.unwhitenedError(moved)

    A, _ = (
        gtsam.CustomFactor(
            gtsam.noiseModel.Unit.Create(len(z.value_m)), [X, C], lambda f, v, H: _error(factor, z, v, H)
        )
        .linearize(values)
        .jacobian()
    )
    for k in range(6 + m):
        d = 1e-6 * np.eye(6 + m)[k]
        difference = (whitened(d[:6], d[6:]) - whitened(-d[:6], -d[6:])) / 2e-6
        assert A[:, k] == pytest.approx(difference, abs=1e-5)


def _error(factor, z, values, H):
    """The same error as the factor's, without its robust noise."""
    at, state = values.atPose3(X), values.atVector(C)
    made = predicted_value(z, at.translation() - [1.0, 2.0, 0.5], state)
    if H is not None:
        by_pose = np.zeros((len(made.value_m), 6))
        by_pose[:, 3:] = made.by_position @ at.rotation().matrix()
        H[0], H[1] = np.asfortranarray(by_pose), np.asfortranarray(made.by_state)
    assert factor.unwhitenedError(values) == pytest.approx(made.value_m - z.value_m)
    return made.value_m - z.value_m


@pytest.mark.parametrize("kind", CueKind)
@pytest.mark.parametrize("dt_s", [1.0, 50.0, 1e4])
def test_a_state_that_is_not_measured_keeps_its_stationary_covariance(kind, dt_s):
    z = cue(kind)
    prior = prior_covariance(z)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(prior_factor(C, prior))
    graph.add(change_factor(C, D, kept_shares(z, dt_s), prior))
    for key in (C, D):
        values.insert(key, np.zeros(len(prior)))
    marginals = gtsam.Marginals(graph, values)
    assert marginals.marginalCovariance(D) == pytest.approx(prior, abs=1e-9)
    cross = marginals.jointMarginalCovariance([C, D]).at(C, D)
    assert cross == pytest.approx(prior * kept_shares(z, dt_s)[:, None], abs=1e-9)


def test_only_a_position_has_an_error_of_north():
    for kind in CueKind:
        assert len(prior_covariance(cue(kind))) == SIZE[kind] + (kind is CueKind.POSITION)
    turned = predicted_value(cue(CueKind.POSITION), OFFSET_M, np.array([0.0, 0.0, 0.0, 1e-4])).value_m
    assert turned == pytest.approx(rotation_z(1e-4) @ OFFSET_M, abs=1e-6)
