"""Depth of a ray from points around it: planes exactly, their sigma, and no depth without a plane."""

import numpy as np

from stages.odometry.vehicle.lidar_depth import RayDepths

REACH = np.radians(2.0)


def plane(normal, away_m, count, spread_rad=0.03, seed=0, noise_m=0.0):
    """Points (n, 3) near the z axis on the plane normal . p = away_m."""
    rng = np.random.default_rng(seed)
    ray = np.column_stack([rng.uniform(-spread_rad, spread_rad, (count, 2)), np.ones(count)])
    return ray * ((away_m + noise_m * rng.normal(size=count)) / (ray @ np.asarray(normal, float)))[:, None]


def depth_of(points, ray=(0.0, 0.0, 1.0)):
    rays = RayDepths(np.array([ray]), REACH)
    rays.add(np.asarray(points, float))
    found = rays.depths()
    return 1.0 / found.inverse_m[0], found.sigma[0]


def test_a_plane_gives_the_depth_of_the_ray_itself():
    assert abs(depth_of(plane((0, 0, 1), 8.0, 40))[0] - 8.0) < 1e-9
    assert abs(depth_of(plane((0.6, -0.3, 1), 8.0, 40))[0] - 8.0) < 1e-9  # slanted: 1 / depth is linear on a plane
    turned = np.array([0.3, -0.5, 0.81])
    turned /= np.linalg.norm(turned)
    points = plane((0, 0, 1), 8.0, 20_000, 0.8)
    assert abs(depth_of(points, turned)[0] - 8.0 / turned[2]) < 1e-6


def test_slices_are_summed():
    points = plane((0.2, 0.1, 1), 6.0, 40, noise_m=0.05)
    rays = RayDepths(np.array([[0.0, 0.0, 1.0]]), REACH)
    for part in np.split(points, 4):
        rays.add(part)
    np.testing.assert_allclose(1.0 / rays.depths().inverse_m[0], depth_of(points)[0], rtol=1e-9)


def test_the_stated_sigma_covers_noise():
    off = []
    for seed in range(50):
        depth, sigma = depth_of(plane((0, 0, 1), 10.0, 30, seed=seed, noise_m=0.03))
        off.append((1.0 / depth - 0.1) / sigma)
    assert 0.2 < np.std(off) < 1.2


def test_few_points_a_line_or_a_step_give_no_depth():
    assert np.isnan(depth_of(plane((0, 0, 1), 8.0, 4))[0])
    line = plane((0, 0, 1), 8.0, 40)
    line[:, 0] = 0.0
    assert np.isnan(depth_of(line)[0])
    step = np.vstack([plane((0, 0, 1), 8.0, 20), plane((0, 0, 1), 12.0, 20, seed=1)])
    assert np.isnan(depth_of(step)[0])
    assert np.isnan(depth_of(np.add(plane((0, 0, 1), 8.0, 40), [3.0, 0.0, 0.0]))[0])  # at another position
    assert np.isnan(depth_of(-plane((0, 0, 1), 8.0, 40))[0])  # behind
    assert np.isnan(depth_of(plane((0, 0, 1), 0.3, 40))[0])  # the sensor's own mount


def test_no_rays_and_no_points_are_valid():
    rays = RayDepths(np.zeros((0, 3)), REACH)
    rays.add(plane((0, 0, 1), 8.0, 5))
    assert len(rays.depths().inverse_m) == 0
    assert np.isnan(depth_of(np.zeros((0, 3)))[0])
