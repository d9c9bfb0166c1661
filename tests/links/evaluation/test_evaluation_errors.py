"""Statistics, interpolation and rotation errors against closed forms and tables."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from links.evaluation.association import interpolate, newest
from links.evaluation.errors import (
    effective_samples,
    euler_error,
    inside_95,
    mahalanobis,
    mean_nees_bounds,
    pose_error,
    sigma_along,
    slerp,
    wilson_interval,
)
from stages.geometry.frames import rotation_from_rpy_deg
from tests.links.evaluation.made_runs import yaw_quaternion


@pytest.mark.parametrize(("dof", "x"), [(1, 3.841459), (3, 7.814728), (6, 12.591587)])
def test_the_95_percent_bound_of_the_nees_is_that_of_the_chi_square_table(dof, x):
    assert inside_95(np.array([x - 2e-6, x + 2e-6, np.nan]), dof).tolist() == [True, False, False]


@pytest.mark.parametrize(
    ("p", "dof", "x"),
    [(0.975, 3, 9.348404), (0.025, 3, 0.215795), (0.5, 1, 0.454936), (1 - math.exp(-1.5), 2, 3.0)],
)
def test_scipys_chi_square_is_that_of_the_table(p, dof, x):
    assert stats.chi2.ppf(p, dof) == pytest.approx(x, abs=2e-6)
    assert stats.chi2.cdf(x, dof) == pytest.approx(p, abs=1e-6)


def test_bounds_of_the_mean_nees_narrow_with_samples():
    assert mean_nees_bounds(1, 3) == pytest.approx((0.2158, 9.3484), abs=1e-4)
    low, high = mean_nees_bounds(1000, 3)
    assert 2.84 < low < 2.86 < 3.14 < high < 3.16
    n = 30_000  # nearly normal: mean n, variance 2 n
    assert mean_nees_bounds(n / 3, 3)[1] * n / 3 == pytest.approx(n + 1.96 * math.sqrt(2 * n), rel=1e-3)


def test_the_interval_of_a_share_is_wilsons():
    assert wilson_interval(95, 100) == pytest.approx((0.8882, 0.9785), abs=1e-4)
    assert wilson_interval(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert wilson_interval(10, 10)[1] == pytest.approx(1.0)
    for successes, trials in ((0, 10), (3, 7), (95, 100)):
        by_scipy = stats.binomtest(successes, trials).proportion_ci(method="wilson")
        assert wilson_interval(successes, trials) == pytest.approx((by_scipy.low, by_scipy.high))


def test_correlated_samples_have_less_information():
    rng = np.random.default_rng(1)
    white = rng.normal(size=4000)
    correlated = np.zeros(4000)
    for i in range(1, 4000):
        correlated[i] = 0.9 * correlated[i - 1] + white[i]
    assert effective_samples(white) > 3000
    assert effective_samples(correlated) == pytest.approx(4000 * 0.1 / 1.9, rel=0.5)
    assert effective_samples(np.ones(50)) == 1.0
    assert effective_samples(np.zeros(0)) == 0.0
    by_hand = np.array([2.0, 1.0, -1.0, -2.0])  # correlation (2 - 1 + 2) / 10 at lag 1, -4 / 10 at lag 2
    assert effective_samples(by_hand) == pytest.approx(4 / (1 + 2 * 0.3))


def test_truth_is_linear_between_its_samples_and_unknown_outside():
    stamps = np.array([0, 100, 200, 1000], dtype=np.int64)
    xyz = np.array([[0.0, 0, 0], [1, 2, 3], [1, 2, 3], [9, 9, 9]])
    at = np.array([-1, 0, 25, 100, 150, 201, 600, 1000, 1001], dtype=np.int64)
    known, found = interpolate(at, stamps, xyz, 100)
    assert known.tolist() == [False, True, True, True, True, False, False, True, False]
    assert found[2].tolist() == [0.25, 0.5, 0.75]
    assert found[known][-1].tolist() == [9, 9, 9]
    assert not interpolate(at, stamps[:0], xyz[:0], 100)[0].any()


def test_slerp_takes_the_shorter_arc_whatever_the_signs():
    q0, q1 = yaw_quaternion([0.2, 3.0]), yaw_quaternion([1.0, -3.0])
    yaw = slerp(q0, -q1, np.array([0.5, 0.5])).as_euler("ZYX")[:, 0]
    assert yaw[0] == pytest.approx(0.6)
    assert abs(yaw[1]) == pytest.approx(math.pi)


def test_the_newest_output_is_never_one_of_the_future():
    assert newest(np.array([0, 5, 9, 10, 99]), np.array([5, 10])).tolist() == [-1, 0, 0, 1, 1]


@settings(max_examples=60, deadline=None)
@given(st.tuples(*[st.floats(-80, 80)] * 3), st.floats(0, math.pi - 1e-3))
def test_the_rotation_part_of_a_pose_error_is_axis_times_angle(rpy, angle):
    axis = rotation_from_rpy_deg(rpy)[:, 0]
    q = np.array([[*(axis * math.sin(angle / 2)), math.cos(angle / 2)]])
    error = pose_error(Rotation.identity(1), np.zeros((1, 3)), Rotation.from_quat(q), np.zeros((1, 3)))
    assert error[0] == pytest.approx([*(axis * angle), 0, 0, 0], abs=1e-6)


def test_a_rotation_by_180_degrees_has_the_length_pi():
    for axis in np.eye(3):
        R = Rotation.from_quat(np.array([[*axis, 0.0]]))
        assert R.magnitude() == pytest.approx(math.pi)
        error = pose_error(Rotation.identity(1), np.zeros((1, 3)), R, np.zeros((1, 3)))
        assert np.linalg.norm(error) == pytest.approx(math.pi)


def test_euler_angles_are_those_of_the_project_and_differences_are_wrapped():
    R = Rotation.from_matrix([rotation_from_rpy_deg((10.0, -20.0, 170.0))])
    level, behind = Rotation.identity(1), Rotation.from_matrix([rotation_from_rpy_deg((0.0, 0.0, -170.0))])
    assert np.degrees(euler_error(R, level))[0] == pytest.approx([10.0, -20.0, 170.0])
    assert np.degrees(euler_error(R, behind))[0] == pytest.approx([10.0, -20.0, -20.0])


def test_the_pose_error_is_gtsams_logarithm():
    gtsam = pytest.importorskip("gtsam")
    rng = np.random.default_rng(7)
    for scale in (1e-6, 0.3, 1.5):
        a = gtsam.Pose3.Expmap(rng.normal(0, 1, 6))
        noise = rng.normal(0, scale, 6)
        b = a.compose(gtsam.Pose3.Expmap(noise))
        R, R_true = (Rotation.from_matrix([pose.rotation().matrix()]) for pose in (a, b))
        error = pose_error(R, a.translation()[None], R_true, b.translation()[None])
        assert error[0] == pytest.approx(gtsam.Pose3.Logmap(gtsam.Pose3.Expmap(noise)), abs=1e-7)


def test_mahalanobis_by_hand_and_sigma_along_the_error():
    C = np.diag([4.0, 1.0, 0.25])[None]
    assert mahalanobis(np.array([[2.0, 1.0, 0.5]]), C).tolist() == [3.0]
    assert sigma_along(np.array([[3.0, 0, 0]]), C).tolist() == [2.0]
    assert sigma_along(np.zeros((1, 3)), C).tolist() == [2.0]
    assert np.isnan(mahalanobis(np.ones((1, 3)), np.diag([1.0, 1.0, -1.0])[None]))[0]
