"""Cars, birds and balloons: they move within their bounds, and rays hit them at their pose."""

from __future__ import annotations

import numpy as np
import pytest

from links.simulated.world.mesh import box
from links.simulated.world.movers import (
    FLAP_STEPS,
    Balloon,
    Bird,
    Car,
    balloon_mesh,
    bird_mesh,
    draw_balloon,
    draw_bird,
)
from links.simulated.world.path import Path, Waypoint
from links.simulated.world.scene import Scene, Truth
from links.simulated.world.vehicle import vehicle_mesh
from stages.geometry.frames import rotation_z

STILL = Path(waypoints=(Waypoint(t_s=0, xyz_m=(0, 0, -50)),))
TIMES = np.arange(0.0, 60.0, 0.02)


def _car() -> Car:
    return Car(
        box((-2, -0.9, 0), (2, 0.9, 1.5), "paint_light"), np.array([-100.0, 4, 0]), np.array([100.0, 4, 0]), 10.0, 0.0
    )


def _bird() -> Bird:
    return Bird(0.6, np.array([0.0, 0, 8]), np.array([12.0, 3, 0.5]), 0.0, 6.0, 4.0, 0.0)


def _balloon() -> Balloon:
    return Balloon(0.4, np.array([5.0, 1, 6]), 0.5, 4.0, 0.0)


MOVERS = [_car(), _bird(), _balloon()]


@pytest.mark.parametrize("mover", MOVERS, ids=lambda m: m.name)
def test_a_mover_is_no_faster_than_its_bound_and_its_pose_is_rigid(mover) -> None:
    R, t = mover.poses(TIMES)
    speed = np.linalg.norm(np.diff(t, axis=0), axis=1) / 0.02
    assert np.median(speed) > 0.1
    moving = speed[speed < 1000] if mover.name == "car" else speed  # a car that restarts jumps
    assert moving.max() <= mover.speed_mps * 1.001
    np.testing.assert_allclose(np.einsum("nij,nkj->nik", R, R), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)


def test_a_car_drives_forwards_and_restarts() -> None:
    R, t = _car().poses(np.array([0.0, 3.0, 19.9, 20.1]))
    np.testing.assert_allclose(t[:, 0], [-100, -70, 99, -99])
    np.testing.assert_allclose(R[0] @ [1, 0, 0], [1, 0, 0], atol=1e-12)


def test_a_bird_flies_forwards_and_takes_all_its_shapes() -> None:
    bird = _bird()
    R, t = bird.poses(TIMES)
    flown = np.diff(t, axis=0)[:, :2]
    ahead = R[:-1, :2, 0]
    cosine = (flown * ahead).sum(axis=1) / np.linalg.norm(flown, axis=1) / np.linalg.norm(ahead, axis=1)
    assert cosine.min() > 0.99
    assert set(bird.shape(TIMES)) == set(range(FLAP_STEPS))
    tips = [mesh.vertices_m[:, 2].max() for mesh in bird.meshes]
    assert max(tips) - min(tips) > 0.1
    assert len(bird.meshes) == FLAP_STEPS


def test_a_bird_is_as_wide_as_its_span_and_a_balloon_as_its_diameter() -> None:
    widest = max(np.ptp(bird_mesh(0.8, beat).vertices_m[:, 1]) for beat in np.linspace(0, 6, 40))
    assert 0.8 * 0.8 < widest <= 0.8
    assert np.ptp(balloon_mesh(0.4).vertices_m[:, 1]) == pytest.approx(0.4, rel=0.1)  # a pear


def test_drawn_birds_and_balloons_stay_in_their_box() -> None:
    turn = rotation_z(0.7)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        for mover in (draw_bird(rng, 4.0, 20.0, 28.0, 5.0, turn), draw_balloon(rng, 4.0, 20.0, 28.0, 5.0, turn)):
            scene_m = mover.poses(TIMES)[1] @ turn  # into the frame of the road
            low, high = scene_m.min(axis=0), scene_m.max(axis=0)
            assert low[0] > -29.0
            assert high[0] < 29.0
            assert np.abs(scene_m[:, 1]).max() < 6.0
            assert low[2] > 2.5
            assert high[2] < 21.5


def _ray(target) -> tuple[np.ndarray, np.ndarray]:
    d = np.asarray(target, dtype=np.float64)
    return np.zeros((1, 1, 3), dtype=np.float32), (d / np.linalg.norm(d)).astype(np.float32).reshape(1, 1, 3)


def test_a_ray_hits_a_mover_at_its_pose_at_that_time() -> None:
    balloon = _balloon()
    scene = Scene(box((400, -1, -1), (401, 1, 1), "brick"), vehicle_mesh(1.8), (), Truth(0, STILL, None), [balloon])
    for time_s in (0.0, 1.0, 2.3):
        target = balloon.poses(np.array([time_s]))[1][0]
        stamp = np.array([round(time_s * 1e9)])
        origins, directions = _ray(target)
        ranges, _, is_drone = scene.cast(stamp, origins, directions, 90.0)
        assert ranges[0, 0] == pytest.approx(np.linalg.norm(target) - 0.2, abs=0.04)
        assert not is_drone.any()
        assert scene.near_small_body(stamp, origins[:, 0], directions[:, 0]).all()
        aside = _ray(target + np.array([0.0, 4.0, 0.0]))
        assert np.isinf(scene.cast(stamp, *aside, 90.0)[0]).all()
        assert not scene.near_small_body(stamp, aside[0][:, 0], aside[1][:, 0]).any()


def test_which_pulses_pass_near_a_mover_does_not_depend_on_the_batch() -> None:
    bird = _bird()
    scene = Scene(box((400, -1, -1), (401, 1, 1), "brick"), vehicle_mesh(1.8), (), Truth(0, STILL, None), [bird])
    stamps = (np.arange(400) * 5_000_000).astype(np.int64)
    rng = np.random.default_rng(1)
    toward = bird.poses(stamps * 1e-9)[1] + rng.normal(0, 0.4, (400, 3))
    directions = (toward / np.linalg.norm(toward, axis=1, keepdims=True)).astype(np.float32)
    origins = np.zeros_like(directions)
    whole = scene.near_small_body(stamps, origins, directions)
    parts = [
        scene.near_small_body(stamps[i : i + 7], origins[i : i + 7], directions[i : i + 7]) for i in range(0, 400, 7)
    ]
    np.testing.assert_array_equal(whole, np.concatenate(parts))
    assert 50 < whole.sum() < 350
