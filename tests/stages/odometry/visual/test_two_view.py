"""Motion from rays: the error by hand, any direction of the sphere, noise, outliers, no motion, and too few rays."""

import math

import numpy as np
import pytest

from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.kernels.visual.epipolar import across, cost_of, direction_given, epipolar, refine
from stages.odometry.visual.two_view import Noise, backwards, relative_motion
from tests.stages.seen import degrees_between, point_rays

NOISE = Noise(1e-4, 0.0)
TURN, MOVE = (0.02, -0.05, 0.15), (0.6, -0.2, 0.1)


def motion(earlier, later, guess=None, noise=NOISE, tries=200):
    return relative_motion(earlier, later, np.eye(3) if guess is None else guess, None, noise, tries)


def test_the_error_is_the_angle_out_of_the_plane_shared_by_both_rays():
    t, R = np.array([1.0, 0.0, 0.0]), np.eye(3)
    earlier = np.array([[0.0, 0.0, 1.0]])
    off = 0.01
    later = np.array([[-0.1, math.sin(off), math.cos(off)]])
    later /= np.linalg.norm(later)
    e, ahead = epipolar(earlier, later, R, t, 1e-4)
    # x' . (t x y) = -sin(off) / |x'|, both sines of the angle to t are 1 and 1 / |x'|
    length = math.sqrt(1.01)
    assert e[0] == pytest.approx(-math.sin(off) / length / math.sqrt(1.0 + 1.0 / length**2), rel=1e-12)
    assert e[0] == pytest.approx(-off / math.sqrt(2.0), rel=0.01)  # two noisy rays share the miss
    assert not ahead[0]  # p' = p + x: a point ahead moves to +x


def test_a_point_is_ahead_when_it_moves_with_t():
    R, t = np.eye(3), np.array([1.0, 0.0, 0.0])
    point = np.array([[0.0, 0.0, -5.0]])  # behind any image plane, and yet ahead along its ray
    moved = point + t
    _, ahead = epipolar(point / 5.0, moved / np.linalg.norm(moved), R, t, 1e-4)
    assert ahead[0]
    _, ahead = epipolar(point / 5.0, moved / np.linalg.norm(moved), R, -t, 1e-4)
    assert not ahead[0]


def test_exact_rays_give_the_exact_motion():
    earlier, later, R, t = point_rays(80, TURN, MOVE)
    found = motion(earlier, later)
    assert np.linalg.norm(log_rotation(found.R_later_earlier @ R.T)) < 1e-6
    assert degrees_between(found.t_hat_later, t) < 1e-3
    assert found.inlier.all()
    np.testing.assert_allclose(np.linalg.norm(found.t_hat_later), 1.0)


@pytest.mark.parametrize("turn", [(0, 0, 0), (0.3, 0, 0), (0, -0.3, 0), (0, 0, 0.3)])
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_every_axis_of_rotation_and_translation_is_distinguished(turn, axis, sign):
    move = np.zeros(3)
    move[axis] = 0.8 * sign
    earlier, later, R, t = point_rays(120, turn, move, noise_rad=3e-4)
    found = motion(earlier, later, exp_rotation(np.asarray(turn, float)))
    assert math.degrees(np.linalg.norm(log_rotation(found.R_later_earlier @ R.T))) < 0.05
    assert degrees_between(found.t_hat_later, t) < 0.5


def test_turning_both_cameras_turns_the_result():
    earlier, later, _, _ = point_rays(150, TURN, MOVE, noise_rad=2e-4)
    one = motion(earlier, later)
    Q = exp_rotation(np.array([0.4, 1.0, -0.7]))
    other = motion(earlier @ Q.T, later @ Q.T)
    assert np.abs(other.R_later_earlier - Q @ one.R_later_earlier @ Q.T).max() < 1e-4
    assert degrees_between(other.t_hat_later, Q @ one.t_hat_later) < 0.05


def test_40_percent_of_outliers_are_rejected():
    for seed in range(5):
        earlier, later, R, t = point_rays(200, TURN, MOVE, noise_rad=3e-4, outliers=0.4, seed=seed)
        found = motion(earlier, later)
        assert math.degrees(np.linalg.norm(log_rotation(found.R_later_earlier @ R.T))) < 0.1
        assert degrees_between(found.t_hat_later, t) < 0.7
        assert 95 < np.count_nonzero(found.inlier) < 135


def test_the_covariance_matches_the_errors():
    turn_nees, direction_nees = [], []
    for seed in range(60):
        earlier, later, R, t = point_rays(100, TURN, MOVE, noise_rad=5e-4, seed=seed)
        found = motion(earlier, later)
        w = -log_rotation(found.R_later_earlier @ R.T)
        turn_nees.append(w @ np.linalg.solve(found.covariance[:3, :3], w))
        direction = math.radians(degrees_between(found.t_hat_later, t))
        direction_nees.append((direction / found.direction_sigma_rad) ** 2)
    assert 2.0 < np.mean(turn_nees) < 4.2  # 3 axes
    assert 1.3 < np.mean(direction_nees) < 3.0  # 2 axes


def test_the_reversed_motion_is_the_inverse():
    earlier, later, R, t = point_rays(150, TURN, MOVE, noise_rad=1e-4)
    found = backwards(motion(earlier, later))
    assert np.linalg.norm(log_rotation(found.R_earlier_later @ R)) < 1e-3
    assert degrees_between(found.t_hat_earlier, -R.T @ t) < 0.2
    swapped = motion(later, earlier)
    assert degrees_between(found.t_hat_earlier, swapped.t_hat_later) < 0.1
    assert found.direction_sigma_rad == pytest.approx(swapped.direction_sigma_rad, rel=0.2)


def test_rotation_alone_is_recognised_and_has_no_direction():
    for seed in range(10):
        earlier, later, R, _ = point_rays(150, (0.1, 0.05, -0.2), (0, 0, 0), noise_rad=3e-4, seed=seed)
        found = motion(earlier, later)
        assert found.t_hat_later is None
        assert math.degrees(np.linalg.norm(log_rotation(found.R_later_earlier @ R.T))) < 0.02
        assert (found.covariance[3:] == 0).all()


def test_no_motion_gives_no_motion():
    earlier, later, _, _ = point_rays(150, (0, 0, 0), (0, 0, 0), noise_rad=3e-4, outliers=0.2)
    found = motion(earlier, later)
    assert found.t_hat_later is None
    assert np.linalg.norm(log_rotation(found.R_later_earlier)) < 3e-4


def test_a_few_near_points_determine_the_motion_under_a_wide_sky():
    sky = point_rays(200, TURN, (0, 0, 0), noise_rad=1e-4, seed=3)
    near = point_rays(40, TURN, MOVE, noise_rad=1e-4, seed=4)
    found = motion(np.vstack([sky[0], near[0]]), np.vstack([sky[1], near[1]]))
    assert found.t_hat_later is not None
    assert degrees_between(found.t_hat_later, near[3]) < 1.0


def test_the_common_error_limits_the_covariance():
    earlier, later, _, _ = point_rays(2000, TURN, MOVE)
    found = motion(earlier, later, noise=Noise(1e-4, 1e-3))
    assert math.sqrt(found.covariance[0, 0]) == pytest.approx(1e-3, rel=0.1)
    assert found.direction_sigma_rad == pytest.approx(1e-3 / found.parallax_rad, rel=0.1)


def test_the_common_error_of_lens_and_parallax_grows_with_the_motion():
    earlier, later, R, _ = point_rays(2000, TURN, MOVE)
    angle_rad = float(np.linalg.norm(log_rotation(R)))
    found = motion(earlier, later, noise=Noise(1e-4, 0.0, lens_share=0.01))
    assert math.sqrt(found.covariance[0, 0]) == pytest.approx(0.01 * angle_rad, rel=0.1)
    found = motion(earlier, later, noise=Noise(1e-4, 0.0, parallax_share=0.05, direction_rad=0.02))
    assert math.sqrt(found.covariance[0, 0]) == pytest.approx(0.05 * found.parallax_rad, rel=0.1)
    assert found.direction_sigma_rad == pytest.approx(0.02, rel=0.1)


def test_too_few_points_or_no_agreement_is_none():
    earlier, later, _, _ = point_rays(11, TURN, MOVE)
    assert motion(earlier, later) is None
    rng = np.random.default_rng(0)
    one, other = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 14, 3)))
    assert motion(one, other) is None


def test_the_same_rays_give_the_same_result():
    earlier, later, _, _ = point_rays(100, TURN, MOVE, noise_rad=1e-3, outliers=0.3)
    one, other = motion(earlier, later), motion(earlier, later)
    assert (one.R_later_earlier == other.R_later_earlier).all()
    assert (one.t_hat_later == other.t_hat_later).all()


def test_a_known_rotation_gives_the_direction_at_once():
    earlier, later, R, t = point_rays(60, TURN, MOVE)
    assert degrees_between(direction_given(earlier, later, R, 1e-3), t) < 1e-3


def test_the_cost_is_least_at_the_truth():
    earlier, later, R, t = point_rays(100, TURN, MOVE, noise_rad=2e-4)
    t = t / np.linalg.norm(t)
    least, agree = cost_of(earlier, later, R, t, 2e-4)
    assert agree == 100
    assert cost_of(earlier, later, R, -t, 2e-4)[0] > 2 * least  # behind the camera
    assert cost_of(earlier, later, exp_rotation(np.array([0.0, 0.01, 0.0])) @ R, t, 2e-4)[0] > 2 * least


def test_refinement_converges_from_a_near_start():
    earlier, later, R, t = point_rays(100, TURN, MOVE)
    t = t / np.linalg.norm(t)
    away = t + 0.05 * across(t)[:, 0]
    got, direction, _ = refine(earlier, later, exp_rotation(np.full(3, 0.004)) @ R, away / np.linalg.norm(away), 5e-3)
    assert np.linalg.norm(log_rotation(got @ R.T)) < 1e-5
    assert degrees_between(direction, t) < 1e-2
