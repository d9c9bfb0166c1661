"""Rotation vectors: formula by hand, round trips, both ends of the logarithm."""

import math

import numpy as np
import pytest

from stages.geometry.frames import heading_rad, rotation_z
from stages.kernels.geometry.so3 import exp_rotation, hat, log_rotation, nearest_rotation, nearly_rotation


def test_90_deg_about_z_takes_x_to_y():
    R = exp_rotation(np.array([0.0, 0.0, math.pi / 2]))
    np.testing.assert_allclose(R, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)


def test_hat_is_the_cross_product():
    a, b = np.array([1.0, -2.0, 0.5]), np.array([0.3, 4.0, -1.0])
    np.testing.assert_allclose(hat(a) @ b, np.cross(a, b))


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 0.3, 2.0, math.pi - 1e-9, math.pi])
def test_the_logarithm_undoes_the_exponential(angle):
    for axis in np.vstack([np.eye(3), np.random.default_rng(0).normal(size=(20, 3))]):
        phi = angle * axis / np.linalg.norm(axis)
        R = exp_rotation(phi)
        np.testing.assert_allclose(exp_rotation(log_rotation(R)), R, atol=1e-7)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.norm(log_rotation(R)) == pytest.approx(angle, abs=1e-7)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0, 3.0, 15.0, 200.0])
def test_nearly_a_rotation_or_not_the_nearest_is_found(share):
    rng = np.random.default_rng(3)
    for angle_rad in (1e-4, 0.02, 0.3, 1.5):
        R = exp_rotation(rng.normal(size=3))
        turned = R @ exp_rotation(angle_rad * np.array([0.6, -0.48, 0.64]))
        M = R + share * (turned - R)
        np.testing.assert_allclose(nearly_rotation(M), nearest_rotation(M), atol=1e-12)


@pytest.mark.parametrize("yaw", [-3.0, 0.0, 2.5])
def test_the_heading_of_a_nearly_level_rotation(yaw):
    assert math.remainder(heading_rad(rotation_z(yaw)) - yaw, 2 * math.pi) == pytest.approx(0, abs=1e-12)
    tilted = rotation_z(yaw) @ exp_rotation(np.array([0.02, -0.03, 0.0]))
    assert math.remainder(heading_rad(tilted) - yaw, 2 * math.pi) == pytest.approx(0, abs=0.002)
