"""Equation 6 of P III.C by hand and under rotation and translation; the covariance by hand."""

# ruff: noqa: RUF005 (arrays are added here, not joined)

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.kernels.track.mean_shift import mean_shift
from stages.track.mean_shift import crossings, fix_covariance_m2
from tests.stages.made import MS

RNG = np.random.default_rng(0)


def test_one_step_is_equation_6_by_hand():
    points = np.array([[0.0, 0.0, 10.0], [0.6, 0.0, 10.0]])
    t, weights, iterations, shift_m = mean_shift(points, np.array([0.0, 0.0, 10.0]), 1, 0.0)
    w = math.exp(-0.36)
    np.testing.assert_allclose(weights, [1.0, w])
    np.testing.assert_allclose(t, [0.6 * w / (1 + w), 0.0, 10.0])
    assert (iterations, shift_m) == (1, pytest.approx(0.6 * w / (1 + w)))


def test_each_step_recomputes_the_weights():
    points = RNG.normal(0, 0.4, (30, 3)) + [1.0, 2.0, 20.0]
    t = np.array([0.8, 2.3, 19.9])
    for _ in range(3):
        c = np.exp(-((points - t) ** 2).sum(axis=1))
        t = (c[:, None] * points).sum(axis=0) / c.sum()
    found, _, iterations, _ = mean_shift(points, np.array([0.8, 2.3, 19.9]), 3, 0.0)
    np.testing.assert_allclose(found, t)
    assert iterations == 3


def test_one_return_is_reached_in_one_step():
    t, _, iterations, shift_m = mean_shift(np.array([[0.5, -0.2, 9.0]]), np.array([0.0, 0.0, 9.5]), 10, 1e-4)
    np.testing.assert_allclose(t, [0.5, -0.2, 9.0])
    assert iterations == 2
    assert shift_m == pytest.approx(0.0, abs=1e-12)


def test_it_ends_after_n_max_or_when_a_step_is_short():
    points = RNG.normal(0, 0.5, (200, 3))
    start = np.array([0.7, 0.0, 0.0])
    assert mean_shift(points, start, 10, 0.0)[2] == 10
    _, _, iterations, shift_m = mean_shift(points, start, 100, 1e-3)
    assert iterations < 30
    assert shift_m < 1e-3
    np.testing.assert_array_equal(start, [0.7, 0.0, 0.0])  # the caller's t_0 is unchanged


def test_mean_shift_is_invariant_to_rotation_and_translation():
    points = RNG.normal(0, 0.3, (40, 3))
    start = np.array([0.2, -0.1, 0.3])
    t, *_ = mean_shift(points, start, 10, 1e-6)
    R, offset = rotation_z(math.pi / 2), np.array([5.0, -7.0, 20.0])
    turned, *_ = mean_shift(points @ R.T + offset, R @ start + offset, 10, 1e-6)
    np.testing.assert_allclose(turned, R @ t + offset, atol=1e-9)


def test_crossings_are_runs_of_one_laser():
    laser = np.array([3, 3, 3, 5, 3, 3], dtype=np.uint8)
    stamps = np.array([0.0, 0.1, 0.2, 0.1, 100.0, 100.1]) * MS
    assert crossings(stamps.astype(np.int64), laser) == 3
    order = np.array([4, 0, 3, 2, 5, 1])
    assert crossings(stamps.astype(np.int64)[order], laser[order]) == 3
    assert crossings(np.array([7]), np.array([1], dtype=np.uint8)) == 1


def covariance(
    points, weights=None, beam_crossings=1, origin=(0, 0, 0), span=0.6, noise=0.03, pointing=0.002, beam=0.003
):
    points = np.asarray(points, dtype=float)
    weights = np.ones(len(points)) if weights is None else np.asarray(weights, dtype=float)
    return fix_covariance_m2(points, weights, beam_crossings, np.asarray(origin, float), span, noise, pointing, beam)


def test_the_covariance_of_one_return_is_the_formula_by_hand():
    # along the ray 0.03^2 + 0.6^2 / 12 = 0.0309; across 0.6^2 / 12 + 20^2 (0.002^2 + 0.003^2 / 12) = 0.0319
    P = covariance([[0, 0, 20.0]])
    np.testing.assert_allclose(P, np.diag([0.0319, 0.0319, 0.0309]), atol=1e-12)


def test_the_scatter_is_divided_by_the_effective_number_and_the_span_by_the_crossings():
    points = [[0.1, 0, 20.0], [-0.1, 0, 20.0]]
    P = covariance(points, beam_crossings=2)
    assert P[0, 0] == pytest.approx(0.01 / 2 + 0.015 + 0.0019)  # S = 0.01, n_eff = 2
    assert P[1, 1] == pytest.approx(0.015 + 0.0019)
    weighted = covariance([[0.3, 0, 20.0], [-0.1, 0, 20.0]], weights=[1, 3], beam_crossings=2)
    assert weighted[0, 0] == pytest.approx(0.03 / (16 / 10) + 0.015 + 0.0019)  # mean 0, S = 0.03, n_eff = 16 / 10


def test_the_covariance_rotates_with_the_points_about_the_lidar():
    points = RNG.normal(0, 0.1, (9, 3)) + [8.0, 3.0, 12.0]
    R = rotation_z(math.pi / 2)
    np.testing.assert_allclose(covariance(points @ R.T), R @ covariance(points) @ R.T, atol=1e-12)
    offset = np.array([3.0, -2.0, 1.0])
    np.testing.assert_allclose(covariance(points + offset, origin=offset), covariance(points), atol=1e-12)


def test_the_covariance_is_never_singular():
    for points in ([[0, 0, 20.0]], [[0, 0, 20.0]] * 50, [[0, 0, 0.0]], [[k * 0.01, 0, 5.0] for k in range(100)]):
        assert np.linalg.eigvalsh(covariance(points, beam_crossings=len(points))).min() > 1e-5
