"""The paper's filter: prediction and update by hand, the estimated rate, its lag, and its limit in time."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.align.paper_filter import FURTHEST_S, RotationFilter
from stages.geometry.frames import rotation_from_rpy_deg, rotation_z
from stages.kernels.geometry.so3 import log_rotation

S = 1_000_000_000
DEG = math.pi / 180


def fresh(sigma_deg=10.0, rate_sigma_dps=10.0, rate_noise_dps=5.0):
    return RotationFilter(np.eye(3), sigma_deg * DEG, rate_sigma_dps * DEG, rate_noise_dps * DEG)


def turning(estimate, rate_dps, until_s, from_s=0.0, step_s=0.1, axis=(0, 0, 1.0), sigma_deg=0.5):
    """Observations of a steady turn; returns the last error [deg]."""
    for k in range(round((until_s - from_s) / step_s) + 1):
        t = from_s + k * step_s
        true = rotation_from_rpy_deg(tuple(rate_dps * t * np.array(axis)))
        estimate.predict(round(t * S))
        estimate.observe(true, sigma_deg * DEG)
    return np.degrees(np.linalg.norm(log_rotation(estimate.rotation.T @ true)))


def test_one_update_by_hand():
    """P = 10^2, R = 5^2: K = 100 / 125, so 10 deg off becomes 2; P = 100 * 25 / 125."""
    estimate = fresh(sigma_deg=10)
    estimate.predict(0)
    estimate.observe(rotation_z(10 * DEG), 5 * DEG)
    assert np.degrees(log_rotation(estimate.rotation)[2]) == pytest.approx(8.0)
    np.testing.assert_allclose(np.diag(estimate.covariance)[:3] / DEG**2, 20.0)
    np.testing.assert_allclose(np.diag(estimate.covariance)[3:] / DEG**2, 100.0)


def test_one_prediction_by_hand():
    """dt = 2 s: phi variance 10^2 + 2^2 10^2 + 5^2 2^3 / 3, rate variance 10^2 + 5^2 2, between them 2 10^2 + 5^2 2^2 / 2."""
    estimate = fresh()
    estimate.predict(0)
    estimate.predict(2 * S)
    P = estimate.covariance / DEG**2
    np.testing.assert_allclose(np.diag(P)[:3], 100 + 400 + 25 * 8 / 3)
    np.testing.assert_allclose(np.diag(P)[3:], 150)
    np.testing.assert_allclose(np.diag(P[:3, 3:]), 200 + 50)
    np.testing.assert_allclose(P, P.T)


def test_a_steady_turn_is_estimated_and_predicted_about_any_axis():
    for axis in np.eye(3):
        estimate = fresh()
        assert turning(estimate, 10.0, 4.0, axis=axis[[0, 1, 2]]) < 0.2
        np.testing.assert_allclose(np.degrees(estimate.rate_radps), 10.0 * axis, atol=1.0)
        before = estimate.rotation
        estimate.predict(round(4.5 * S))
        assert np.degrees(np.linalg.norm(log_rotation(before.T @ estimate.rotation))) == pytest.approx(5.0, abs=0.6)


def test_a_sudden_turn_is_followed_late_because_the_rate_is_slow():
    slow, quick = fresh(rate_noise_dps=2.0), fresh(rate_noise_dps=60.0)
    for estimate in (slow, quick):
        turning(estimate, 0.0, 2.0)
    lag = []
    for estimate in (slow, quick):
        for k in range(1, 6):
            true = rotation_z(60 * DEG * k * 0.1)
            estimate.predict(round((2.0 + k * 0.1) * S))
            estimate.observe(true, 2 * DEG)
        lag.append(np.degrees(np.linalg.norm(log_rotation(estimate.rotation.T @ true))))
    assert lag[0] > 5.0 > lag[1]


def test_after_a_gap_the_rate_is_not_applied_but_the_covariance_grows():
    estimate = fresh()
    turning(estimate, 10.0, 4.0)
    start = estimate.rotation
    for t in (4.4, 4.8, 5.5, 9.0):
        estimate.predict(round(t * S))
    turned = np.degrees(np.linalg.norm(log_rotation(start.T @ estimate.rotation)))
    assert turned == pytest.approx(10.0 * FURTHEST_S, abs=0.8)
    assert np.sqrt(estimate.covariance[2, 2]) / DEG > 20.0


def test_a_time_that_is_not_later_changes_nothing():
    estimate = fresh()
    turning(estimate, 10.0, 1.0)
    before = estimate.rotation.copy(), estimate.covariance.copy()
    estimate.predict(S // 2)
    estimate.predict(S)
    np.testing.assert_array_equal(estimate.rotation, before[0])
    np.testing.assert_array_equal(estimate.covariance, before[1])


def test_covariance_and_rotation_stay_valid():
    rng = np.random.default_rng(0)
    estimate = fresh()
    for k in range(300):
        estimate.predict(round(k * 0.1 * S))
        estimate.observe(rotation_from_rpy_deg(tuple(rng.normal(0, 20, 3))), 2 * DEG)
    assert np.linalg.eigvalsh(estimate.covariance)[0] > 0
    np.testing.assert_allclose(estimate.covariance, estimate.covariance.T, atol=1e-12)
    np.testing.assert_allclose(estimate.rotation.T @ estimate.rotation, np.eye(3), atol=1e-12)


def test_a_restart_resets_the_rate():
    estimate = fresh()
    turning(estimate, 10.0, 2.0)
    estimate.restart(rotation_z(1.0), 3 * DEG)
    np.testing.assert_array_equal(estimate.rotation, rotation_z(1.0))
    np.testing.assert_array_equal(estimate.rate_radps, np.zeros(3))
    np.testing.assert_allclose(np.diag(estimate.covariance) / DEG**2, [9, 9, 9, 100, 100, 100])
