"""The simulated VLP-16 against walls with known answers."""

from __future__ import annotations

import numpy as np
import pytest

from links.simulated.kernels.lidar import echoes
from links.simulated.sensors.lidar import COARSE, FINE, FOOTPRINTS, Lidar, LidarSettings, sub_rays
from links.simulated.world.mesh import RayScene, box, merge, quads
from stages.geometry.frames import rotation_from_rpy_deg, rotation_z
from stages.geometry.lidar_models import lidar_profile

VLP16 = lidar_profile("VLP-16")
START_NS = 1_748_773_230_000_000_000
SHARES = np.full(4, 0.25)


class _Scene:
    """A static scene without a drone."""

    def __init__(self, mesh) -> None:
        self._scene = RayScene(mesh)

    def cast(self, pulse_ns, origins_world_m, directions_world, max_range_m):
        rays = directions_world.shape[:2]
        found = self._scene.cast(origins_world_m.reshape(-1, 3), directions_world.reshape(-1, 3), max_range_m)
        return found[0].reshape(rays), found[1].reshape(rays), np.zeros(rays, dtype=np.uint8)

    def near_small_body(self, pulse_ns, origins_world_m, directions_world):
        return np.zeros(len(pulse_ns), dtype=np.bool_)


def _wall(x_m: float, surface: str = "plaster", half_m: float = 200.0):
    return quads(
        [[(x_m, -half_m, -half_m), (x_m, half_m, -half_m), (x_m, half_m, half_m), (x_m, -half_m, half_m)]], surface
    )


def _fire(scene, sequences: int, R=None, seed: int = 1, **settings):
    lidar = Lidar(LidarSettings(**settings), START_NS, seed)
    stamps = START_NS + VLP16.sequence_ns * np.arange(sequences)[:, None] + VLP16.firing_ns[1] * np.arange(16)
    stamps = stamps.ravel().astype(np.int64)
    rotations = np.broadcast_to(np.eye(3) if R is None else R, (len(stamps), 3, 3)).copy()
    pulses = lidar.fire(stamps, rotations, np.zeros((len(stamps), 3)), scene)
    return lidar, stamps, pulses


def _echo(ranges, fractions, threshold=1e-12, mode="dual", shares=SHARES):
    ranges, fractions = np.array([ranges], dtype=np.float32), np.array([fractions], dtype=np.float32)
    drone = np.zeros(ranges.shape, dtype=np.uint8)
    return [part[:, 0] for part in echoes(ranges, fractions, drone, shares, np.array([threshold]), 0.5, mode)]


def test_an_echo_is_the_power_weighted_mean_within_a_pulse_length() -> None:
    ranges, power, _, _ = _echo([10.0, 10.5, 11.2, np.inf], [0.2, 0.4, 0.8, 0.0], mode="strongest")
    p = 0.25 * np.array([0.2, 0.4, 0.8]) / np.array([10.0, 10.5, 11.2]) ** 2  # 1.2 m in all, but no gap over 1 m
    assert power[0] == pytest.approx(p.sum(), rel=1e-6)
    assert ranges[0] == pytest.approx((p @ [10.0, 10.5, 11.2]) / p.sum(), abs=1e-5)


def test_strongest_last_and_dual_choose_as_in_the_manual() -> None:
    seen = [5.0, 8.0, 20.0, np.inf], [0.1, 0.5, 0.5, 0.0]
    assert _echo(*seen, mode="strongest")[0] == pytest.approx([8.0])
    assert _echo(*seen, mode="last")[0] == pytest.approx([20.0])
    assert _echo(*seen, mode="dual")[0] == pytest.approx([8.0, 20.0])
    strongest_is_last = [5.0, 8.0, 20.0, np.inf], [0.02, 0.1, 5.0, 0.0]
    assert _echo(*strongest_is_last, mode="dual")[0] == pytest.approx([8.0, 20.0])
    assert _echo([7.0, 7.0, 7.0, np.inf], [0.3] * 4, mode="dual")[0] == pytest.approx([7.0, 7.0])


def test_an_echo_below_the_threshold_is_neither_last_nor_strongest() -> None:
    seen = [5.0, 8.0, 20.0, np.inf], [0.1, 0.5, 0.05, 0.0]
    weakest = 0.25 * 0.05 / 400
    assert _echo(*seen, mode="last", threshold=1.01 * weakest)[0] == pytest.approx([8.0])
    assert _echo(*seen, mode="last", threshold=0.99 * weakest)[0] == pytest.approx([20.0])
    assert _echo(*seen, mode="dual", threshold=np.inf)[0] == pytest.approx([0.0, 0.0])


def test_a_surface_that_is_too_near_hides_others_and_is_not_measured() -> None:
    assert _echo([0.3, 0.3, 9.0, 9.0], [0.5] * 4, mode="strongest")[0] == pytest.approx([9.0])
    assert _echo([0.3, 0.3, 0.4, 0.4], [0.5] * 4, mode="strongest")[0] == pytest.approx([0.0])


def test_a_pulse_leaves_along_its_lasers_elevation_at_the_rotors_azimuth() -> None:
    azimuth, laser = np.radians([0.0, 90.0]), np.array([0, 15])
    eye, zero = np.broadcast_to(np.eye(3), (2, 3, 3)).copy(), np.zeros((2, 3))
    origins, rays = sub_rays(azimuth, laser, eye, zero, COARSE.offsets)
    np.testing.assert_allclose(rays[0, 0], [0, np.cos(np.radians(15)), -np.sin(np.radians(15))], atol=1e-6)
    np.testing.assert_allclose(rays[1, 0], [np.cos(np.radians(15)), 0, np.sin(np.radians(15))], atol=1e-6)
    np.testing.assert_allclose(origins[:, 0], [[0, 0, 0.0112], [0, 0, -0.0112]], atol=1e-6)


def test_the_footprint_is_3_by_1_5_mrad_and_its_shares_add_to_one() -> None:
    eye, zero = np.eye(3)[None], np.zeros((1, 3))
    corners = np.array([(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)])
    _, rays = sub_rays(np.array([0.3]), np.array([6]), eye, zero, corners)
    rays = rays[0].astype(np.float64)
    assert np.linalg.norm(rays[0] - rays[1]) == pytest.approx(3.0e-3, rel=1e-3)
    assert np.linalg.norm(rays[2] - rays[3]) == pytest.approx(1.5e-3, rel=1e-3)
    for pattern in {FINE, *FOOTPRINTS["dense"], *FOOTPRINTS["sparse"]}:
        assert pattern.shares.sum() == pytest.approx(1.0)
        assert len(pattern.shares) == len(pattern.offsets)
        assert np.abs(pattern.shares @ pattern.offsets).max() < 1e-12  # its centre is the axis


def test_a_rotated_and_shifted_lidar_sends_rotated_and_shifted_rays_from_its_aperture() -> None:
    azimuth, laser, corners = (
        np.array([0.3]),
        np.array([6]),
        np.array([(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)]),
    )
    R, t = rotation_from_rpy_deg((20.0, 30.0, 40.0)), np.array([1.0, 2.0, 3.0])
    origins, rays = sub_rays(azimuth, laser, np.eye(3)[None], np.zeros((1, 3)), corners)
    turned_origins, turned_rays = sub_rays(azimuth, laser, R[None], t[None], corners)
    np.testing.assert_allclose(turned_rays[0], rays[0] @ R.T, atol=1e-6)
    np.testing.assert_allclose(turned_origins[0], origins[0] @ R.T + t, atol=1e-6)
    np.testing.assert_allclose((origins[0, 1] - origins[0, 0]) / 12.7e-3, (rays[0, 1] - rays[0, 0]) / 3.0e-3, atol=1e-3)
    np.testing.assert_allclose((origins[0, 3] - origins[0, 2]) / 9.5e-3, (rays[0, 3] - rays[0, 2]) / 1.5e-3, atol=1e-3)


def test_a_wall_is_measured_at_its_range_with_the_stated_noise() -> None:
    scene = _Scene(_wall(8.0))
    lidar, stamps, pulses = _fire(scene, 1900, laser_bias_m=0.0, dropout=0.0)
    azimuth, laser = lidar.azimuth_rad(stamps), np.arange(len(stamps)) % 16
    elevation = np.radians(np.array(VLP16.elevation_deg, dtype=np.float64))[laser]
    facing = np.cos(elevation) * np.sin(azimuth)
    ahead = facing > 0.5
    error = pulses.range_m[0, ahead] - 8.0 / facing[ahead]
    assert abs(error.mean()) < 0.001
    assert 0.007 < error.std() < 0.010  # 8 mm, a little more on the weak oblique ones
    ticks = pulses.range_m / 0.002
    np.testing.assert_allclose(ticks, np.rint(ticks), atol=1e-6)
    assert not pulses.range_m[0, facing < 0].any()


def test_rotating_world_and_lidar_together_changes_rounding_only() -> None:
    mesh = merge([_wall(8.0), box((3, 1, -1), (4, 2, 1), "brick")])
    turn = rotation_z(0.7)
    _, _, plain = _fire(_Scene(mesh), 300)
    _, _, rotated = _fire(_Scene(mesh.moved(rotation=turn)), 300, R=turn)
    both = (plain.range_m > 0) & (rotated.range_m > 0)
    assert both.sum() > 0.99 * (plain.range_m > 0).sum()
    assert np.quantile(np.abs(plain.range_m - rotated.range_m)[both], 0.98) < 0.0041


def test_half_of_the_pulses_on_a_ten_percent_wall_return_at_the_stated_range() -> None:
    def share(x_m: float) -> float:
        lidar, stamps, pulses = _fire(_Scene(_wall(x_m, "wire")), 1900, dropout=0.0)
        straight = (np.abs(lidar.azimuth_rad(stamps) - np.pi / 2) < 0.05) & (np.arange(len(stamps)) % 16 == 1)
        return float((pulses.range_m[0, straight] > 0).mean())

    assert share(50.0) == 1.0
    assert 0.2 < share(65.0) < 0.8
    assert share(80.0) < 0.2
    assert share(100.0) == 0.0


def test_an_edge_gives_mixed_returns_only_within_a_pulse_length() -> None:
    def between(gap_m: float) -> int:
        edge = quads([[(6.0, -50, -50), (6.0, 0.3, -50), (6.0, 0.3, 50), (6.0, -50, 50)]], "plaster")
        lidar, stamps, pulses = _fire(_Scene(merge([edge, _wall(6.0 + gap_m)])), 1900, laser_bias_m=0.0)
        elevation = np.radians(np.array(VLP16.elevation_deg, dtype=np.float64))[np.arange(len(stamps)) % 16]
        x = pulses.range_m[0] * np.cos(elevation) * np.sin(lidar.azimuth_rad(stamps))
        return int(np.count_nonzero((x > 6.1) & (x < 6.0 + gap_m - 0.1)))

    assert between(0.6) > 0
    assert between(3.0) == 0


def test_a_sparse_footprint_measures_walls_and_edges_like_a_dense_one() -> None:
    edge = quads([[(6.0, -50, -50), (6.0, 0.3, -50), (6.0, 0.3, 50), (6.0, -50, 50)]], "plaster")
    scene = _Scene(merge([edge, _wall(9.0)]))
    _, _, dense = _fire(scene, 1900, footprint="dense")
    _, _, sparse = _fire(scene, 1900, footprint="sparse")
    d, s = dense.range_m[0], sparse.range_m[0]
    alike = np.abs(d - s) < 0.02
    assert alike.mean() > 0.98
    assert np.count_nonzero(s > 0) == pytest.approx(np.count_nonzero(d > 0), rel=0.002)
    assert np.count_nonzero(s > 8.9) == pytest.approx(np.count_nonzero(d > 8.9), rel=0.01)


def test_nothing_in_range_is_no_return() -> None:
    _, _, pulses = _fire(_Scene(_wall(140.0)), 200)
    assert not pulses.range_m.any()
    assert not pulses.reflectivity.any()
