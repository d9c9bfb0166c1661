"""Each kind of scene has its features, is determined by its seed, and keeps the vehicle's corridor free."""

from __future__ import annotations

import numpy as np
import pytest

from links.simulated.world.mesh import Mesh, RayScene
from links.simulated.world.procedural import SceneSettings, build_world
from links.simulated.world.procedural.atlanta import MIN_SEPARATION_DEG, odd_angles_deg
from links.simulated.world.procedural.build import KINDS
from links.simulated.world.procedural.settings import VehicleCorridor

HEIGHT_M = 1.8
BIN_DEG = 5.0
WALLS = ("brick", "plaster", "concrete")


def _world(kind: str, seed: int = 3, **settings):
    return build_world(SceneSettings(kind=kind, **settings), HEIGHT_M, seed)


def _area_m2(mesh: Mesh) -> np.ndarray:
    a, b, c = (mesh.vertices_m[mesh.faces[:, i]] for i in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def _near(mesh: Mesh, reach_m: float = 80.0) -> np.ndarray:
    return np.hypot(*mesh.vertices_m[mesh.faces].mean(axis=1)[:, :2].T) < reach_m


def _wall_families(mesh: Mesh) -> np.ndarray:
    """Wall area by direction modulo 90 deg, in bins around 0, 5, .. 85."""
    normal = mesh.normals()
    wall = mesh.is_surface(*WALLS) & (np.abs(normal[:, 2]) < 0.05) & _near(mesh)
    direction = np.degrees(np.arctan2(normal[wall, 1], normal[wall, 0]))
    bins = np.rint(direction / BIN_DEG).astype(int) % round(90 / BIN_DEG)
    return np.bincount(bins, _area_m2(mesh)[wall], minlength=round(90 / BIN_DEG))


def _surface_m2(mesh: Mesh, *names: str) -> float:
    return float(_area_m2(mesh)[mesh.is_surface(*names) & _near(mesh)].sum())


@pytest.mark.parametrize("kind", KINDS)
def test_kind_and_seed_determine_a_scene(kind: str) -> None:
    one, again, other = _world(kind), _world(kind), _world(kind, seed=4)
    np.testing.assert_array_equal(one.mesh.vertices_m, again.mesh.vertices_m)
    np.testing.assert_array_equal(one.mesh.surface, again.mesh.surface)
    assert one.mesh.vertices_m.shape != other.mesh.vertices_m.shape or not np.array_equal(
        one.mesh.vertices_m, other.mesh.vertices_m
    )
    times = np.linspace(0, 5, 7)
    for a, b in zip(one.movers, again.movers, strict=True):
        np.testing.assert_array_equal(a.poses(times)[1], b.poses(times)[1])


@pytest.mark.parametrize("kind", KINDS)
def test_the_road_is_below_the_camera_and_the_sky_above(kind: str) -> None:
    scene = RayScene(_world(kind).mesh)
    down_up = np.array([[0, 0, -1], [0, 0, 1]], dtype=np.float32)
    ranges, _ = scene.cast(np.zeros((2, 3), dtype=np.float32), down_up, 300.0)
    assert abs(ranges[0] - HEIGHT_M) < 0.01
    assert np.isinf(ranges[1])


@pytest.mark.parametrize("kind", ["street", "manhattan"])
def test_a_manhattan_street_has_one_pair_of_wall_directions(kind: str) -> None:
    for seed in (1, 2, 3):
        families = _wall_families(_world(kind, seed).mesh)
        assert families[0] > 0.99 * families.sum()


def test_atlanta_has_at_least_three_pairs_none_of_them_the_roads() -> None:
    for seed in (1, 2, 3, 4):
        families = _wall_families(_world("atlanta", seed).mesh)
        assert (families > 0.05 * families.sum()).sum() >= 3
        assert families[0] < 0.02 * families.sum()


def test_odd_angles_are_separated_from_each_other_and_from_the_road() -> None:
    for seed in range(20):
        angles = np.append(odd_angles_deg(np.random.default_rng(seed)), 0.0)
        separation = np.abs(angles[:, None] - angles)[np.triu_indices(len(angles), 1)] % 90
        assert np.minimum(separation, 90 - separation).min() >= MIN_SEPARATION_DEG - 1e-9


def test_a_campus_has_two_pairs_lawns_and_open_space() -> None:
    mesh = _world("campus", 2).mesh
    families = _wall_families(mesh)
    assert (families > 0.05 * families.sum()).sum() == 2
    assert _surface_m2(mesh, "grass") > 5000
    assert families.sum() < 0.4 * _wall_families(_world("manhattan", 2).mesh).sum()


def test_a_park_has_leaves_instead_of_walls_and_a_lot_has_neither() -> None:
    town, park, lot = (_world(kind).mesh for kind in ("manhattan", "park_edge", "open_lot"))
    assert _surface_m2(park, *WALLS) < 0.1 * _surface_m2(town, *WALLS)
    assert _surface_m2(park, "leaf") > 3 * _surface_m2(town, "leaf")
    assert _surface_m2(lot, *WALLS) == 0.0
    assert _surface_m2(lot, "leaf") < 0.5 * _surface_m2(town, "leaf")
    assert _surface_m2(lot, "marking") > 100


@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"street", "village"}))  # the village is a generator of its own
def test_every_kind_has_marks_trees_poles_cars_and_movers(kind: str) -> None:
    world = _world(kind)
    for surface in ("marking", "leaf", "metal"):
        assert world.mesh.is_surface(surface).any()
    assert {mover.name for mover in world.movers} == {"car", "bird", "balloon"}


def test_the_number_of_movers_is_a_setting() -> None:
    assert _world("street").movers == ()
    world = _world("street", driving_cars=2, birds=1, balloons=0)
    assert [mover.name for mover in world.movers] == ["car", "car", "bird"]
    assert _world("manhattan", driving_cars=0, birds=0, balloons=0).movers == ()


def test_nothing_parks_or_drives_on_the_path_of_the_vehicle() -> None:
    path = np.column_stack(
        [np.linspace(0, 60, 121), np.linspace(0, 6.5, 121)]
    )  # across the other lane and the parked cars
    free = build_world(SceneSettings(kind="manhattan", parked_cars=1.0), HEIGHT_M, 3, path)
    full = _world("manhattan", parked_cars=1.0)
    assert len(free.mesh.faces) < len(full.mesh.faces)
    assert not [mover for mover in free.movers if mover.name == "car"]
    low = free.mesh.is_surface("rubber", "paint_dark", "paint_light")
    centre = free.mesh.vertices_m[free.mesh.faces].mean(axis=1)[low][:, :2]
    away = np.linalg.norm(centre[:, None] - path, axis=2).min(axis=1)
    assert away.min() > 1.0


def test_the_corridor_is_as_wide_and_as_long_as_the_vehicle() -> None:
    corridor = VehicleCorridor(np.column_stack([np.linspace(0, 10, 11), np.zeros(11)]))
    assert not corridor.allows(5.0 - 2.0, 0.0, 0.5)
    assert not corridor.allows(0.0, 1.4, 0.5)
    assert corridor.allows(0.0, 1.6, 0.5)
    assert not corridor.allows(12.8, 0.0, 0.5)
    assert corridor.allows(13.0, 0.0, 0.5)


def test_rotating_the_vehicle_rotates_the_scene_in_the_opposite_direction() -> None:
    ahead = _wall_families(_world("manhattan", vehicle_yaw_deg=20.0).mesh)
    assert ahead[round(70 / BIN_DEG)] > 0.99 * ahead.sum()  # -20 deg, modulo 90


@pytest.mark.parametrize("kind", ["manhattan", "campus"])
def test_clutter_adds_objects_and_people_and_leaves_the_rest_as_it_is(kind: str) -> None:
    plain, cluttered, again = _world(kind), _world(kind, clutter=True), _world(kind, clutter=True)
    np.testing.assert_array_equal(cluttered.mesh.vertices_m, again.mesh.vertices_m)
    faces = len(plain.mesh.faces)
    np.testing.assert_array_equal(cluttered.mesh.faces[:faces], plain.mesh.faces)
    np.testing.assert_array_equal(cluttered.mesh.vertices_m[: len(plain.mesh.vertices_m)], plain.mesh.vertices_m)
    assert cluttered.mesh.is_surface("print")[faces:].any()
    assert not plain.mesh.is_surface("print").any()
    names = [mover.name for mover in cluttered.movers]
    assert names[: len(plain.movers)] == [mover.name for mover in plain.movers]
    assert set(names[len(plain.movers) :]) == {"person"}
    assert len(names) - len(plain.movers) > 8


def test_clutter_keeps_the_corridor_of_the_vehicle_and_the_sky_free() -> None:
    path = np.column_stack([np.linspace(0, 40, 81), np.linspace(0, 8.0, 81)])  # onto the pavement
    with_path = build_world(SceneSettings(kind="manhattan", clutter=True), HEIGHT_M, 3, path)
    plain = build_world(SceneSettings(kind="manhattan"), HEIGHT_M, 3, path)
    added = with_path.mesh.vertices_m[len(plain.mesh.vertices_m) :]
    assert (added[:, 2] + HEIGHT_M).max() < 9.0
    low = added[added[:, 2] + HEIGHT_M < 2.0]
    assert np.linalg.norm(low[:, None, :2] - path, axis=2).min() > 0.9


def test_people_walk_on_the_ground_at_walking_speed_and_turn_back() -> None:
    times = np.arange(0.0, 120.0, 0.1)
    walkers = [mover for mover in _world("manhattan", clutter=True).movers if mover.name == "person"]
    for walker in walkers:
        R, t = walker.poses(times)
        speed = np.linalg.norm(np.diff(t, axis=0), axis=1) / 0.1
        assert np.median(speed) == pytest.approx(walker.speed_mps, rel=1e-6)
        assert 1.2 <= walker.speed_mps <= 1.5
        assert np.ptp(t[:, :2], axis=0).max() < 31.0
        ahead = np.einsum("ni,ni->n", R[:-1, :, 0], np.diff(t, axis=0)) / 0.1
        assert np.median(ahead) == pytest.approx(walker.speed_mps, rel=1e-6)
        feet = min(mesh.vertices_m[:, 2].min() for mesh in walker.meshes)
        assert 0.0 <= t[0, 2] + HEIGHT_M + feet < 0.3
        assert set(walker.shape(times)) == set(range(len(walker.meshes)))
