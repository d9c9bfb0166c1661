"""The scene, its meshes and moving bodies."""

from __future__ import annotations

import numpy as np

from links.simulated.kernels.ray_casting import into_body
from links.simulated.matrix.sim_vs_real import drone_area_m2
from links.simulated.world.drone import DroneModel, drone_mesh
from links.simulated.world.mesh import SURFACE_NAMES, RayScene, box, merge, rod
from links.simulated.world.path import Path, Waypoint
from links.simulated.world.procedural import SceneSettings, world_mesh
from links.simulated.world.procedural.parts import building_row, dashes
from links.simulated.world.scene import Body, Scene, Truth, drone_shapes
from links.simulated.world.vehicle import vehicle_mesh
from stages.geometry.frames import rotation_from_rpy_deg


def _rays(origin, directions):
    d = np.asarray(directions, dtype=np.float32)
    return np.tile(np.asarray(origin, dtype=np.float32), (len(d), 1)), d / np.linalg.norm(d, axis=1, keepdims=True)


def test_a_ray_hits_a_box_at_its_face_and_dims_with_incidence() -> None:
    scene = RayScene(box((2, -1, -1), (4, 1, 1), "plaster"))
    ranges, fraction = scene.cast(*_rays((0, 0, 0), [(1, 0, 0), (1, 0.3, 0), (-1, 0, 0)]), 50.0)
    np.testing.assert_allclose(ranges, [2.0, 2.0 * np.hypot(1, 0.3), np.inf], rtol=1e-6)
    np.testing.assert_allclose(fraction, [0.55, 0.55 / np.hypot(1, 0.3), 0.0], rtol=1e-5)


def test_rays_end_at_the_range_they_are_given() -> None:
    scene = RayScene(box((2, -1, -1), (4, 1, 1), "plaster"))
    assert np.isinf(scene.cast(*_rays((0, 0, 0), [(1, 0, 0)]), 1.9)[0][0])


def test_a_rod_is_as_long_and_thick_as_asked() -> None:
    mesh = rod((0, 0, 1), (0, 0, 3), 0.1, "metal", sides=12)
    np.testing.assert_allclose(np.hypot(*mesh.vertices_m[:, :2].T), 0.1)
    np.testing.assert_allclose([mesh.vertices_m[:, 2].min(), mesh.vertices_m[:, 2].max()], [1, 3])


def test_merged_meshes_keep_their_faces_and_surfaces() -> None:
    a, b = box((0, 0, 0), (1, 1, 1), "brick"), box((5, 0, 0), (6, 1, 1), "leaf")
    both = merge([a, b])
    np.testing.assert_allclose(both.vertices_m[both.faces[len(a.faces) :]], b.vertices_m[b.faces])
    assert set(both.surface[: len(a.faces)]) == set(a.surface)


def test_the_drone_is_as_wide_as_its_span_and_mostly_open() -> None:
    for span_m, shape in ((0.35, "folding"), (0.5, "x4"), (0.8, "hexa"), (0.4, "hexa")):
        blades = np.linspace(0, np.pi, 32)
        meshes = [drone_mesh(span_m, a, DroneModel(shape=shape)) for a in blades]
        width = max(np.linalg.norm(mesh.vertices_m[:, :2], axis=1).max() for mesh in meshes)
        assert abs(2 * width - span_m) < 0.02 * span_m
    scene = RayScene(drone_mesh(0.5))
    x, y = np.meshgrid(np.linspace(-0.25, 0.25, 101), np.linspace(-0.25, 0.25, 101))
    up = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -2.0)]).astype(np.float32)
    hit = np.isfinite(scene.cast(up, np.tile(np.float32([0, 0, 1]), (x.size, 1)), 5.0)[0])
    assert 0.1 < hit.mean() < 0.25


def test_the_street_is_below_the_camera_with_walls_on_both_sides() -> None:
    scene = RayScene(world_mesh(SceneSettings(), 1.8, 3))
    ranges, _ = scene.cast(*_rays((0, 0, 0), [(0, 0, -1), (0, 0, 1)]), 200.0)
    assert abs(ranges[0] - 1.8) < 1e-3
    assert np.isinf(ranges[1])
    for side in (-1, 1):
        level = [(x, side * 1.0, 0.3) for x in np.linspace(-0.5, 0.5, 41)]
        assert np.isfinite(scene.cast(*_rays((0, 0, 0), level), 60.0)[0]).mean() > 0.7


def test_a_seed_determines_the_scene() -> None:
    same, again, other = (world_mesh(SceneSettings(), 1.8, seed) for seed in (4, 4, 5))
    np.testing.assert_array_equal(same.vertices_m, again.vertices_m)
    assert same.vertices_m.shape != other.vertices_m.shape or not np.array_equal(same.vertices_m, other.vertices_m)


def _scene(drone: Path | None, vehicle: Path) -> Scene:
    shapes = drone_shapes(0.5, DroneModel())
    return Scene(box((100, -1, -1), (101, 1, 1), "brick"), vehicle_mesh(1.8), shapes, Truth(0, vehicle, drone))


def test_a_moving_drone_is_hit_at_its_pose_at_the_pulse() -> None:
    drone = Path(waypoints=(Waypoint(t_s=0, xyz_m=(10, 0, 0)), Waypoint(t_s=1, xyz_m=(18, 0, 0))))
    scene = _scene(drone, Path(waypoints=(Waypoint(t_s=0, xyz_m=(0, 0, -9)),)))
    pulse_ns = np.array([0, 500_000_000, 1_000_000_000])
    origins, directions = _rays((0, 0, 0), [(1, 0, 0)] * 3)
    for i in range(3):
        ranges, _, is_drone = scene.cast(pulse_ns[i : i + 1], origins[:1, None], directions[:1, None], 90.0)
        assert is_drone.all()
        assert abs(ranges[0, 0] - (10 + 4 * i)) < 0.13
    aside = directions[:1, None] + np.float32([0, 0.1, 0])
    assert not scene.cast(pulse_ns[:1], origins[:1, None], aside, 90.0)[2].any()


def test_the_vehicle_blocks_rays_that_point_down_and_moves_along() -> None:
    scene = _scene(None, Path(waypoints=(Waypoint(t_s=0, xyz_m=(0, 0, 0)), Waypoint(t_s=1, xyz_m=(20, 0, 0)))))
    origins, directions = _rays((20.5, 0.5, 0.35), [(0, 0, -1)])
    start = scene.cast(np.array([0]), origins[:, None], directions[:, None], 90.0)[0]
    later = scene.cast(np.array([1_000_000_000]), origins[:, None], directions[:, None], 90.0)[0]
    assert np.isinf(start[0, 0])
    assert abs(later[0, 0] - 0.5) < 1e-3


def test_a_tilted_vehicle_is_hit_by_rays_that_point_up_in_the_world() -> None:
    """Culling uses the box of the body, not the world's down direction."""
    turn = rotation_from_rpy_deg((0.0, -40.0, 0.0))  # nose up
    body = Body("vehicle", (vehicle_mesh(1.8),), lambda ns: (np.tile(turn, (len(ns), 1, 1)), np.zeros((len(ns), 3))),
                None, 50.0, False)  # fmt: skip
    bonnet = turn @ [1.8, 0.0, -0.9] - turn @ [0.0, 0.0, 0.35]
    origins, directions = _rays(turn @ [0.0, 0.0, 0.35], [bonnet])
    assert directions[0, 2] > 0
    pick, R, t = body.near(np.zeros(1, dtype=np.int64), origins, directions)
    o, d, ray = into_body(R, t, origins[:, None], directions[:, None], pick, *body.box_m)
    assert len(ray) == 1
    assert np.isfinite(body.scenes[0].cast(o, d, 90.0)[0]).all()


def test_only_rays_that_meet_the_box_of_a_body_are_cast() -> None:
    origins, directions = _rays((0, 0, 0), [(1, 0, 0), (0, 1, 0), (-1, 0, 0), (1, 0.01, 0)])
    low, high = np.array([4.0, -1.0, -1.0]), np.array([6.0, 1.0, 1.0])
    _, _, ray = into_body(
        np.eye(3)[None], np.zeros((1, 3)), origins[:, None], directions[:, None], np.arange(4), low, high
    )
    np.testing.assert_array_equal(ray, [0, 3])


def test_a_dark_drone_is_lost_first_and_a_light_one_last() -> None:
    def hits(surface: str, range_m: float) -> float:
        mesh = drone_mesh(0.5, 0.4, DroneModel(surface=surface))
        return drone_area_m2(mesh, range_m * np.array([0.6, 0.0, -0.8]), 0.03 / range_m)

    near = hits("carbon", 15.0)
    assert 0.2 * near < hits("carbon", 40.0) < 0.8 * near
    assert hits("carbon", 62.0) == 0.0
    assert hits("dark_shell", 45.0) < hits("carbon", 45.0) < hits("grey_shell", 45.0) < hits("light_shell", 45.0)
    assert hits("light_shell", 62.0) > 0.5 * near


def test_a_face_has_its_normal_and_its_surface() -> None:
    mesh = merge([box((0, 0, 0), (1, 2, 3), "brick"), box((5, 0, 0), (6, 1, 1), "marking")])
    normals = mesh.normals()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    np.testing.assert_allclose(np.abs(normals).max(axis=1), 1.0)
    assert {SURFACE_NAMES[row] for row in mesh.surface} == {"brick", "marking"}
    assert mesh.only(mesh.is_surface("marking")).vertices_m[mesh.only(mesh.is_surface("marking")).faces].min() == 0.0
    assert mesh.is_surface("marking").sum() == 12


def test_a_row_of_buildings_has_none_of_zero_width() -> None:
    for seed in range(190, 240):
        rng = np.random.default_rng(seed)
        row = building_row(float(rng.uniform(18, 42)), 12.0, (9.0, 20.0), rng)
        a, b, c = (row.vertices_m[row.faces[:, i]] for i in range(3))
        assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 1e-3


def test_a_lane_that_ends_with_a_dash_has_no_dash_of_zero_length() -> None:
    lane = merge(dashes((1000.0, 0.0), (1009.0 + 2e-13, 0.0)))
    assert np.isfinite(lane.vertices_m).all()
    assert len(lane.faces) == len(merge(dashes((0.0, 0.0), (9.0, 0.0))).faces)
