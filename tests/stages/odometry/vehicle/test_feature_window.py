"""Bundle adjustment: perturbed poses are recovered, LiDAR sets the scale, and too few features change nothing."""

import numpy as np

from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.odometry.vehicle.window import Keyframe, adjusted


def keys_of(shake, noise_rad=1e-4, lidar=True, scale=1.0, count=80, seed=0):
    """Five images at steps of one metre with the same points; poses after the second perturbed. Also the true poses."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points *= (rng.uniform(5.0, 25.0, count) / np.linalg.norm(points, axis=1))[:, None]
    keys, truth = [], []
    for k in range(5):
        R, p = exp_rotation(np.array([0.02, -0.01, 0.1]) * k), np.array([1.0, 0.2, 0.0]) * k
        seen = (points - p) @ R
        away = np.linalg.norm(seen, axis=1)
        ray = seen / away[:, None] + noise_rad * rng.normal(size=seen.shape)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        p_start = scale * p
        if k >= 2:
            p_start, R_start = p_start + shake * rng.normal(size=3), R @ exp_rotation(0.02 * shake * rng.normal(size=3))
        else:
            R_start = R
        inverse = 1.0 / away if lidar else np.full(count, np.nan)
        keys.append(Keyframe(R_start, p_start, np.arange(count), ray, inverse, np.full(count, 2e-4)))
        truth.append((R, p))
    return keys, truth


def worst(keys, truth):
    return (
        max(np.linalg.norm(k.p - p) for k, (_, p) in zip(keys, truth, strict=True)),
        max(np.linalg.norm(log_rotation(k.R.T @ R)) for k, (R, _) in zip(keys, truth, strict=True)),
    )


def test_perturbed_poses_are_recovered():
    keys, truth = keys_of(0.2)
    assert worst(keys, truth)[0] > 0.15
    moved, turned = worst(adjusted(keys, 1e-4), truth)
    assert moved < 0.01
    assert turned < 1e-3


def test_features_first_observed_late_are_used():
    keys, truth = keys_of(0.2, count=120)
    late = np.arange(120) >= 12  # nearly all are first observed in the third image, whose pose is not fixed
    keys[:2] = [
        Keyframe(k.R, k.p, *(v[~late] for v in (k.number, k.ray, k.inverse_m, k.inverse_sigma))) for k in keys[:2]
    ]
    moved, turned = worst(adjusted(keys, 1e-4), truth)
    assert moved < 0.02
    assert turned < 2e-3


def test_without_lidar_the_fixed_images_keep_the_scale():
    keys, truth = keys_of(0.2, lidar=False)
    assert worst(adjusted(keys, 1e-4), truth)[0] < 0.03


def test_20_percent_of_wrong_rays_have_little_effect():
    keys, truth = keys_of(0.1)
    rng = np.random.default_rng(1)
    for key in keys[2:]:
        wrong = rng.normal(size=(16, 3))
        key.ray[:16] = wrong / np.linalg.norm(wrong, axis=1, keepdims=True)
    assert worst(adjusted(keys, 1e-4), truth)[0] < 0.02


def test_the_two_oldest_poses_are_fixed():
    keys, _ = keys_of(0.2)
    after = adjusted(keys, 1e-4)
    for k in range(2):
        assert (after[k].p == keys[k].p).all()
        assert (after[k].R == keys[k].R).all()


def test_too_few_images_or_features_change_nothing():
    keys, _ = keys_of(0.2)
    assert adjusted(keys[:2], 1e-4) == keys[:2]
    few, _ = keys_of(0.2, count=10)
    assert adjusted(few, 1e-4) == few
