"""The heading by motion: accepted, rejected, and never on a wrong branch."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.fuse.settings import FuseErrors
from stages.geometry.frames import rotation_z
from stages.heading.motion_yaw import (
    LEAST,
    MIN_TO_CONFIRM,
    MotionYaw,
    Point,
    YawFit,
    YawLikelihood,
    bank,
    chi2_999,
    fit,
    level_covariance,
    weigh,
)
from stages.heading.yaw_fit import apart_rad
from tests.stages.fuse.made_drone_flight import gauss_markov

ERRORS = FuseErrors()
S = 1_000_000_000


def points(way_m, psi=0.7, noise=0.05, seed=0, false=(), drift_mps=0.08, step_s=0.5):
    """A path (n, 3) by the autopilot and by LiDAR: turned by psi, with drift, noise and false fixes."""
    rng = np.random.default_rng([seed, 8])
    n = len(way_m)
    drift = np.cumsum(gauss_markov(rng, drift_mps, 10.0, step_s, n) * step_s, axis=0) * [1, 1, 0.3]
    z = way_m @ rotation_z(psi).T + drift + rng.normal(0, noise, (n, 3)) + [30.0, -20.0, 4.0]
    for i in false:
        z[i] += rng.normal(0, 3.0, 3)
    return tuple(Point(round(i * step_s * S), z[i], noise**2, way_m[i], 0) for i in range(n))


def circle(n=16, radius=6.0):
    a = np.linspace(0, 2.0, n)
    return np.column_stack([radius * np.cos(a), radius * np.sin(a), 0.1 * a])


def straight(n=16, length=8.0):
    return np.outer(np.linspace(0, length, n), [0.6, 0.8, 0.0])


@pytest.mark.parametrize("place", [0.0, 1 / 3, 1e3])
def test_points_at_one_position_after_outlier_rejection_give_no_yaw(place):
    way = np.full((14, 3), place)
    way[[4, 9], :2] += [[1.5, 0.0], [0.0, 1.5]]
    result = weigh(points(way, drift_mps=0.0, false=(4, 9)), ERRORS)
    assert result.yaw is None


def test_the_fit_is_that_of_a_complex_factor():
    """z = c + a p without errors: a is found, with the precision sum of |p - mean|^2 / variance."""
    p = np.array([[0.0, 0], [1, 0], [1, 2], [3, 1]])
    a = 0.9 * np.exp(0.5j)
    z = (p[:, 0] + 1j * p[:, 1]) * a + (4 - 2j)
    found, precision, misfit, _ = fit(np.column_stack([z.real, z.imag]), p, 0.04 * np.eye(4))
    assert np.allclose(found, [a.real, a.imag])
    assert precision == pytest.approx((np.abs(p - p.mean(axis=0)) ** 2).sum() / 0.04)
    assert misfit == pytest.approx(0, abs=1e-9)


def test_the_worst_point_is_found():
    p = circle()[:, :2]
    z = p.copy()
    z[5] += [0.5, -0.3]
    assert fit(z, p, 0.01 * np.eye(len(p)))[3] == 5


@pytest.mark.parametrize("psi", [-3.0, -1.2, 0.0, 1.6, 3.1])
@pytest.mark.parametrize("way", [circle(), straight()])
def test_a_turned_world_gives_a_turned_yaw(psi, way):
    result = weigh(points(way, psi), ERRORS)
    assert result.yaw is not None
    assert apart_rad(result.yaw.yaw_rad, psi) < 4 * result.yaw.sigma_rad
    assert result.yaw.sigma_rad < math.radians(8)


def test_sigma_matches_the_errors():
    off = []
    for seed in range(150):
        result = weigh(points(circle(), seed=seed), ERRORS)
        if result.yaw is not None:
            off.append(math.remainder(result.yaw.yaw_rad - 0.7, 2 * math.pi) / result.yaw.sigma_rad)
    assert len(off) > 140
    assert np.mean(np.square(off)) < 1.3
    assert np.abs(off).max() < 4.5


def test_a_few_false_fixes_are_rejected():
    result = weigh(points(circle(), false=(3, 9)), ERRORS)
    assert result.yaw is not None
    assert apart_rad(result.yaw.yaw_rad, 0.7) < 0.1
    assert weigh(points(circle(), false=(1, 3, 5, 7, 9, 11)), ERRORS).yaw is None


@pytest.mark.parametrize("seed", range(40))
def test_another_moving_object_gives_no_heading(seed):
    """A bird of the same speed on a path of its own."""
    rng = np.random.default_rng([seed, 9])
    way, bird = circle(), points(circle(), psi=0.0)
    other = np.cumsum(gauss_markov(rng, 1.5, 3.0, 0.5, len(way)) * 0.5, axis=0)
    mixed = tuple(Point(b.stamp_ns, other[i], 0.0025, b.xyz_odom_m, 0) for i, b in enumerate(bird))
    assert weigh(mixed, ERRORS).yaw is None


def test_a_displacement_of_another_length_gives_no_heading():
    result = weigh(points(1.0 * straight(length=20.0)), ERRORS)
    assert result.yaw is not None
    short = tuple(
        Point(p.stamp_ns, 0.7 * p.xyz_map_m, p.variance_m2, p.xyz_odom_m, 0) for p in points(straight(length=20.0))
    )
    rejected = weigh(short, ERRORS)
    assert rejected.yaw is None
    assert "0.67 of the displacement" in rejected.reason


def test_heights_must_agree():
    climbs = tuple(
        Point(p.stamp_ns, p.xyz_map_m + np.array([0, 0, 0.3 * i]), p.variance_m2, p.xyz_odom_m, 0)
        for i, p in enumerate(points(circle()))
    )
    assert weigh(climbs, ERRORS).yaw is None


def test_a_drone_that_hardly_moves_gives_no_heading():
    result = weigh(points(0.05 * circle()), ERRORS)
    assert result.yaw is None
    assert result.likelihood is None
    assert "too little" in result.reason


def test_too_few_points_give_no_heading():
    few = weigh(points(circle())[: LEAST - 1], ERRORS)
    assert few.yaw is None
    assert few.likelihood is not None  # enough to confirm another yaw
    assert weigh(points(circle())[: MIN_TO_CONFIRM - 1], ERRORS).likelihood is None


def test_the_bank_has_one_peak_and_is_ambiguous_when_flat():
    peak, near, odds = bank(np.array([math.cos(2.0), math.sin(2.0)]), 400.0)
    assert peak == pytest.approx(2.0)
    assert near > 0.9999
    assert odds < 1e-3
    assert bank(np.array([1.0, 0.0]), 5.0)[1] < 0.99


def test_drift_of_both_odometries_is_correlated_as_an_integral_is():
    """For a nearly constant velocity: s^2 t_a t_b."""
    slow = FuseErrors(drift_mps=0.1, drift_time_s=1e4, walk_m_per_sqrt_s=1e-6)
    K = level_covariance(np.array([0.0, 2.0, 5.0]), np.zeros((3, 2)), np.zeros(3), slow)
    assert K[1, 1] == pytest.approx(0.01 * 4, rel=0.01)
    assert K[1, 2] == pytest.approx(0.01 * 10, rel=0.01)


@pytest.mark.parametrize(("dof", "tabled"), [(3, 16.27), (10, 29.59), (40, 73.40)])
def test_the_gates_match_tabulated_values(dof, tabled):
    assert chi2_999(dof) == pytest.approx(tabled, rel=0.02)


def test_a_new_segment_restarts_the_collection():
    bank_ = MotionYaw(ERRORS, math.radians(6))
    for p in points(circle()):
        bank_.add(p)
    assert bank_.yaw is not None
    p = points(circle())[-1]
    bank_.add(Point(p.stamp_ns + S, p.xyz_map_m, p.variance_m2, p.xyz_odom_m, segment=1))
    assert bank_.yaw is None
    assert not bank_.confirms(p.stamp_ns, 0.0, 0.01)


def test_the_odds_of_other_branches_follow_the_likelihood():
    """exp(k (cos a - 1)): branches at +-90 and 180 deg against a yaw at the peak."""
    likelihood = YawLikelihood(0, 0.7, 3.0)
    assert likelihood.alternatives_odds(0.7) == pytest.approx(2 * math.exp(-3.0) + math.exp(-6.0))
    assert likelihood.alternatives_odds(0.7 + math.pi / 4) > 1.0  # halfway to another branch
    assert likelihood.alternatives_odds(0.7 + math.pi / 2) > 10.0


def test_a_short_path_confirms_a_yaw_before_it_determines_one():
    """Its sigma is 15 deg, too much for a heading but small against 90 deg."""
    bank_ = MotionYaw(ERRORS, math.radians(6))
    p = points(circle())[0]
    bank_._fit = YawFit("", YawLikelihood(p.stamp_ns, 0.3, 1 / math.radians(15) ** 2))
    assert bank_.coarse_yaw is None
    assert bank_.confirms(p.stamp_ns, 0.4, 0.01)
    assert not bank_.confirms(p.stamp_ns, 0.4 + math.pi / 2, 0.01)
    assert not bank_.confirms(p.stamp_ns + 6 * S, 0.4, 0.01)
    bank_._fit = YawFit("", YawLikelihood(p.stamp_ns, 0.3, 1 / math.radians(30) ** 2))
    assert not bank_.confirms(p.stamp_ns, 0.3, 0.01)  # odds 1 : 19
