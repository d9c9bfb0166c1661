"""The length of a motion: formula by hand, wrong depths, and too few."""

import numpy as np
import pytest

from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.odometry.vehicle.image_motion import Pose6, Step, after, is_plausible, vehicle_pose
from stages.odometry.vehicle.scale import length_of, parallax_ratio
from tests.stages.seen import point_rays

TURN, MOVE = (0.02, -0.05, 0.15), (0.6, -0.2, 0.1)


def with_depths(count, noise_rad=0.0, depth_noise=0.0, seed=1):
    earlier, later, R, t = point_rays(count, TURN, MOVE, noise_rad, seed=seed)
    rng = np.random.default_rng(seed)
    length = np.linalg.norm(t)
    rho, sigma = parallax_ratio(earlier, later, R, t / length, max(noise_rad, 1e-6))
    points = np.random.default_rng(seed)
    raw = points.normal(size=(count, 3))
    depth = points.uniform(4.0, 30.0, count)
    assert np.allclose(raw / np.linalg.norm(raw, axis=1, keepdims=True), earlier, atol=10 * noise_rad + 1e-9)
    inverse = 1.0 / depth * (1.0 + depth_noise * rng.normal(size=count))
    return rho, sigma, inverse, np.maximum(depth_noise, 1e-4) * inverse, length, depth


def test_the_parallax_ratio_is_length_over_depth():
    rho, _, _, _, length, depth = with_depths(50)
    np.testing.assert_allclose(rho, length / depth, rtol=1e-6)


def test_the_length_is_found_and_its_sigma_covers_the_error():
    off = []
    for seed in range(30):
        rho, sigma, inverse, inverse_sigma, length, _ = with_depths(60, 3e-4, 0.02, seed)
        found = length_of(rho, sigma, inverse, inverse_sigma)
        off.append((found.m - length) / found.sigma_m)
        assert abs(found.m / length - 1.0) < 0.03
    assert 0.3 < np.std(off) < 1.6


def test_a_third_of_wrong_depths_is_rejected():
    rho, sigma, inverse, inverse_sigma, length, _ = with_depths(60, 1e-4, 0.01)
    inverse[::3] *= 3.0
    assert length_of(rho, sigma, inverse, inverse_sigma).m == pytest.approx(length, rel=0.03)


def test_a_precise_depth_outweighs_imprecise_ones():
    """Ten depths known to 1 % give 1 m, twenty known to 30 % give 1.3 m: the mean by 1 / sigma^2 is 1.00 m."""
    rho, rho_sigma = np.full(30, 0.1), np.full(30, 1e-4)
    inverse = np.where(np.arange(30) < 10, 0.1, 0.1 / 1.3)
    inverse_sigma = np.where(np.arange(30) < 10, 0.01, 0.3) * inverse
    assert length_of(rho, rho_sigma, inverse, inverse_sigma).m == pytest.approx(1.0, abs=0.01)


def test_the_sigma_of_the_length_grows_with_the_sigma_of_the_depths():
    """Sigma of the mean of 100 depths known to 20 %, with 1 % of each and 0.4 % of all added: 0.0204 of the length."""
    rho, rho_sigma, inverse = np.full(100, 0.1), np.full(100, 1e-6), np.full(100, 0.05)
    found = length_of(rho, rho_sigma, inverse, 0.2 * inverse)
    assert found.m == pytest.approx(2.0)
    assert found.sigma_m / found.m == pytest.approx(np.hypot(np.hypot(0.2, 0.01) / 10.0, 0.004), rel=1e-6)


def test_without_depths_or_parallax_there_is_no_length():
    rho, sigma, inverse, inverse_sigma, _, _ = with_depths(60)
    assert length_of(rho, sigma, np.full(60, np.nan), inverse_sigma) is None
    assert length_of(0.0 * rho, sigma, inverse, inverse_sigma) is None
    inverse[4:] = np.nan
    assert length_of(rho, sigma, inverse, inverse_sigma) is None


def test_few_features_are_accepted_only_near_the_expected_length():
    rho, sigma, inverse, inverse_sigma, length, _ = with_depths(60, 1e-4, 0.01)
    many = length_of(rho, sigma, inverse, inverse_sigma)
    few = length_of(rho[:9], sigma[:9], inverse[:9], inverse_sigma[:9])
    far = type(few)(length + 5.0, 0.1, 0)
    assert is_plausible(many, far)
    assert not is_plausible(few, far)
    assert is_plausible(few, type(few)(length, 0.1, 0))


def test_steps_are_composed_with_their_covariance():
    rng = np.random.default_rng(2)
    start = Pose6(exp_rotation(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2.0, 3.0]), 1e-4 * np.eye(6))
    step = Step(
        exp_rotation(np.array([0.0, 0.1, 0.5])), np.array([2.0, 0.5, -0.2]), 1e-5 * np.eye(3), 1e-4 * np.eye(3), False
    )
    end = after(start, step)
    np.testing.assert_allclose(end.p, start.p + start.R @ step.t)
    samples = []
    for _ in range(4000):
        xi = 1e-2 * rng.normal(size=6)
        R, p = start.R @ exp_rotation(xi[:3]), start.p + start.R @ xi[3:]
        R, p = (
            R @ step.R @ exp_rotation(np.sqrt(1e-5) * rng.normal(size=3)),
            p + R @ (step.t + 1e-2 * rng.normal(size=3)),
        )
        samples.append([*log_rotation(end.R.T @ R), *(end.R.T @ (p - end.p))])
    np.testing.assert_allclose(np.cov(np.array(samples).T), end.covariance, atol=0.06 * end.covariance.max())


def test_the_carriers_covariance_is_that_of_its_pose():
    rng = np.random.default_rng(3)
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = exp_rotation(np.array([0.3, -0.2, 1.5])), [1.5, -0.4, 0.8]
    P = np.diag([1e-4, 4e-4, 1e-6, 1e-4, 9e-4, 1e-6])
    camera = Pose6(exp_rotation(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2.0, 3.0]), P)
    vehicle = vehicle_pose(camera, M)
    samples = []
    for _ in range(4000):
        xi = np.sqrt(np.diag(P)) * rng.normal(size=6)
        other = vehicle_pose(Pose6(camera.R @ exp_rotation(xi[:3]), camera.p + camera.R @ xi[3:], P), M)
        samples.append([*log_rotation(vehicle.R.T @ other.R), *(vehicle.R.T @ (other.p - vehicle.p))])
    np.testing.assert_allclose(np.cov(np.array(samples).T), vehicle.covariance, atol=0.06 * vehicle.covariance.max())
    np.testing.assert_allclose(vehicle.R, M[:3, :3] @ camera.R @ M[:3, :3].T)
