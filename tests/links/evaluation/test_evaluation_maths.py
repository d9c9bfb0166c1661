"""Statistics, interpolation and rotation errors against closed forms and tables."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from links.evaluation.associate import interpolate, newest, slerp
from links.evaluation.errors import euler_rpy, log_rotation, mahalanobis, pose_error, sigma_along
from links.evaluation.statistics import (
    chi2_cdf,
    chi2_density,
    chi2_quantile,
    effective_samples,
    mean_nees_bounds,
    wilson_interval,
)
from stages.geometry.frames import rotation_from_rpy_deg, rotations_from_xyzw
from tests.links.evaluation.made_runs import yaw_quaternion


@pytest.mark.parametrize(
    ("p", "dof", "x"),
    [(0.95, 3, 7.814728), (0.975, 3, 9.348404), (0.025, 3, 0.215795), (0.95, 6, 12.591587), (0.5, 1, 0.454936)],
)
def test_chi_square_quantiles_are_those_of_the_table(p, dof, x):
    assert chi2_quantile(p, dof) == pytest.approx(x, abs=2e-6)
    assert chi2_cdf(x, dof) == pytest.approx(p, abs=1e-6)


def test_chi_square_of_two_and_of_very_many_degrees_of_freedom():
    assert chi2_cdf(3.0, 2) == pytest.approx(1 - math.exp(-1.5), abs=1e-12)
    n = 30_000  # nearly normal: mean n, variance 2 n
    assert chi2_quantile(0.975, n) == pytest.approx(n + 1.96 * math.sqrt(2 * n), rel=1e-3)
    x = np.linspace(1e-6, 60, 60_001)
    assert np.trapezoid(chi2_density(x, 3), x) == pytest.approx(1.0, abs=1e-3)


def test_bounds_of_the_mean_nees_narrow_with_samples():
    assert mean_nees_bounds(1, 3) == pytest.approx((0.2158, 9.3484), abs=1e-4)
    low, high = mean_nees_bounds(1000, 3)
    assert 2.84 < low < 2.86 < 3.14 < high < 3.16


def test_the_interval_of_a_share_is_wilsons():
    assert wilson_interval(95, 100) == pytest.approx((0.8882, 0.9785), abs=1e-4)
    assert wilson_interval(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert wilson_interval(10, 10)[1] == pytest.approx(1.0)


def test_correlated_samples_are_worth_less():
    rng = np.random.default_rng(1)
    white = rng.normal(size=4000)
    walk = np.zeros(4000)
    for i in range(1, 4000):
        walk[i] = 0.9 * walk[i - 1] + white[i]
    assert effective_samples(white) > 3000
    assert effective_samples(walk) == pytest.approx(4000 * 0.1 / 1.9, rel=0.5)
    assert effective_samples(np.ones(50)) == 1.0
    assert effective_samples(np.zeros(0)) == 0.0


def test_truth_is_linear_between_its_samples_and_unknown_elsewhere():
    stamps = np.array([0, 100, 200, 1000], dtype=np.int64)
    xyz = np.array([[0.0, 0, 0], [1, 2, 3], [1, 2, 3], [9, 9, 9]])
    at = np.array([-1, 0, 25, 100, 150, 201, 600, 1000, 1001], dtype=np.int64)
    known, found, quaternion = interpolate(at, stamps, xyz, None, 100)
    assert known.tolist() == [False, True, True, True, True, False, False, True, False]
    assert found[2].tolist() == [0.25, 0.5, 0.75]
    assert found[known][-1].tolist() == [9, 9, 9]
    assert quaternion is None
    assert not interpolate(at, stamps[:0], xyz[:0], None, 100)[0].any()


def test_slerp_takes_the_shorter_way_whatever_the_signs():
    q0, q1 = yaw_quaternion([0.2, 3.0]), yaw_quaternion([1.0, -3.0])
    half = slerp(q0, -q1, np.array([0.5, 0.5]))
    yaw = euler_rpy(rotations_from_xyzw(half))[:, 2]
    assert yaw[0] == pytest.approx(0.6)
    assert abs(yaw[1]) == pytest.approx(math.pi)


def test_the_newest_output_is_never_one_of_the_future():
    assert newest(np.array([0, 5, 9, 10, 99]), np.array([5, 10])).tolist() == [-1, 0, 0, 1, 1]


@settings(max_examples=60, deadline=None)
@given(st.tuples(*[st.floats(-80, 80)] * 3), st.floats(0, math.pi - 1e-3))
def test_the_logarithm_undoes_a_rotation(rpy, angle):
    axis = rotation_from_rpy_deg(rpy)[:, 0]
    q = np.array([[*(axis * math.sin(angle / 2)), math.cos(angle / 2)]])
    assert log_rotation(rotations_from_xyzw(q))[0] == pytest.approx(axis * angle, abs=1e-6)


def test_half_a_turn_has_the_length_pi():
    for axis in np.eye(3):
        q = np.array([[*axis, 0.0]])
        assert np.linalg.norm(log_rotation(rotations_from_xyzw(q))) == pytest.approx(math.pi)


def test_euler_angles_are_those_of_the_project():
    R = rotation_from_rpy_deg((10.0, -20.0, 170.0))[None]
    assert np.degrees(euler_rpy(R))[0] == pytest.approx([10.0, -20.0, 170.0])


def test_the_pose_error_is_gtsams_logarithm():
    gtsam = pytest.importorskip("gtsam")
    rng = np.random.default_rng(7)
    for scale in (1e-6, 0.3, 1.5):
        a = gtsam.Pose3.Expmap(rng.normal(0, 1, 6))
        b = a.compose(gtsam.Pose3.Expmap(rng.normal(0, scale, 6)))
        ours = pose_error(
            a.rotation().matrix()[None], a.translation()[None], b.rotation().matrix()[None], b.translation()[None]
        )
        assert ours[0] == pytest.approx(gtsam.Pose3.Logmap(a.between(b)), abs=1e-7)


def test_mahalanobis_by_hand_and_sigma_along_the_error():
    C = np.diag([4.0, 1.0, 0.25])[None]
    assert mahalanobis(np.array([[2.0, 1.0, 0.5]]), C).tolist() == [3.0]
    assert sigma_along(np.array([[3.0, 0, 0]]), C).tolist() == [2.0]
    assert sigma_along(np.zeros((1, 3)), C).tolist() == [2.0]
    assert np.isnan(mahalanobis(np.ones((1, 3)), np.diag([1.0, 1.0, -1.0])[None]))[0]
