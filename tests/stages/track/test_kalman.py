"""Prediction and update by hand and against many small steps."""

from __future__ import annotations

import numpy as np
import pytest

from stages.track.kalman import condition, measured, predicted

RNG = np.random.default_rng(4)
X = RNG.normal(size=6) * 10
ROOT = RNG.normal(size=(6, 6))
P = ROOT @ ROOT.T + 0.1 * np.eye(6)


def test_prediction_by_hand():
    x, forward = predicted(np.array([1.0, 2, 3, 4, 5, 6]), np.diag([1.0, 1, 1, 4, 4, 4]), 0.5, 3.0)
    np.testing.assert_allclose(x, [3, 4.5, 6, 4, 5, 6])
    # p: 1 + dt^2 4 + q dt^3 / 3,  pv: dt 4 + q dt^2 / 2,  v: 4 + q dt
    for axis in range(3):
        assert forward[axis, axis] == pytest.approx(1 + 1 + 0.125)
        assert forward[axis, axis + 3] == forward[axis + 3, axis] == pytest.approx(2 + 0.375)
        assert forward[axis + 3, axis + 3] == pytest.approx(4 + 1.5)
    assert forward[0, 1] == forward[0, 4] == 0


def test_one_step_equals_many_small_ones():
    at_once = predicted(X, P, 1.0, 2.0)
    x, P_ = X, P
    for _ in range(50):
        x, P_ = predicted(x, P_, 0.02, 2.0)
    np.testing.assert_allclose(x, at_once[0])
    np.testing.assert_allclose(P_, at_once[1])


def test_zero_time_changes_nothing_and_negative_time_does_not_reduce_the_covariance():
    same = predicted(X, P, 0.0, 2.0)
    np.testing.assert_array_equal(same[0], X)
    np.testing.assert_array_equal(same[1], P)
    x, back = predicted(X, P, -0.1, 2.0)
    np.testing.assert_allclose(x[:3], X[:3] - 0.1 * X[3:])
    plain = predicted(X, P, -0.1, 0.0)[1]
    assert np.all(np.linalg.eigvalsh(back - plain) >= -1e-12)


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_conditioning_on_a_linear_measurement_is_the_kalman_update(rows):
    H3 = RNG.normal(size=(rows, 3))
    H = np.hstack([H3, np.zeros((rows, 3))])
    noise = 0.3 * np.eye(rows)
    S = H @ P @ H.T
    z = RNG.normal(size=rows)
    change = S @ np.linalg.solve(S + noise, z)  # of y, for the residual z
    S_after = S - S @ np.linalg.solve(S + noise, S)
    x, after = condition(X, P, H3, change, S_after)
    K = P @ H.T @ np.linalg.inv(S + noise)
    np.testing.assert_allclose(x, X + K @ z)
    np.testing.assert_allclose(after, (np.eye(6) - K @ H) @ P, atol=1e-9)


def test_a_posterior_equal_to_the_prediction_changes_nothing():
    H = RNG.normal(size=(2, 3))
    x, after = condition(X, P, H, np.zeros(2), H @ P[:3, :3] @ H.T)
    np.testing.assert_array_equal(x, X)
    np.testing.assert_allclose(after, P)


def test_after_conditioning_the_state_has_the_posteriors_mean_and_covariance():
    H, change, S_after = RNG.normal(size=(2, 3)), np.array([0.4, -0.2]), np.array([[0.02, 0.01], [0.01, 0.03]])
    x, after = condition(X, P, H, change, S_after)
    np.testing.assert_allclose(H @ (x - X)[:3], change)
    np.testing.assert_allclose(H @ after[:3, :3] @ H.T, S_after, atol=1e-9)
    np.testing.assert_array_equal(after, after.T)
    assert np.linalg.eigvalsh(after)[0] > 0


def test_the_scalar_update_agrees_with_conditioning():
    h = np.array([0.6, 0.0, 0.8])
    x, after = measured(X, P, h, 0.5, 0.2)
    s = h @ P[:3, :3] @ h
    K = P[:, :3] @ h / (s + 0.04)
    np.testing.assert_allclose(x, X + 0.5 * K)
    np.testing.assert_allclose(after, P - np.outer(K, K) * (s + 0.04))
    same = condition(X, P, h[np.newaxis], np.array([0.5 * s / (s + 0.04)]), np.array([[s * 0.04 / (s + 0.04)]]))
    np.testing.assert_allclose(same[0], x)
    np.testing.assert_allclose(same[1], after, atol=1e-9)
