"""Movers of a varied sky: birds that glide, circle, hover and flock; insects, kites, bags and free balloons.

Source: ours; speeds of gliding birds: Pennycuick, Modelling the Flying Bird (2008), 2 to 14 m/s over ground.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from links.simulated.kernels.motion import rotations_z
from links.simulated.world.mesh import Mesh, box, quads
from links.simulated.world.movers import FLAP_STEPS, balloon_mesh, bird_mesh
from links.simulated.world.path import Path, Waypoint
from stages.geometry.frames import Array64

LASTS_S = 60.0  # a path is straight or drawn for this long
KNOT_S = 1.5  # of drawn paths
NEAR_M = (6.0, 38.0)  # level distance from the start at which a mover passes


@dataclass(frozen=True)
class PathMover:
    """A body that follows a path, at the path's yaw, beating its wings if it has several shapes."""

    name: str
    meshes: tuple[Mesh, ...]
    path: Path
    speed_mps: float
    beat_hz: float = 0.0
    small: bool = True

    def poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        """T_world_body at times (n,): rotations (n, 3, 3), positions (n, 3) [m]."""
        position, _, _, yaw = self.path.at(time_s)
        return rotations_z(yaw), position

    def shape(self, time_s: Array64) -> NDArray[np.int64]:
        """Index into `meshes` at times (n,)."""
        return np.floor(np.mod(time_s * self.beat_hz, 1.0) * len(self.meshes)).astype(np.int64)


def draw_sky(rng: Generator, count: int, height_m: tuple[float, float] = (3.0, 24.0)) -> Iterator[PathMover]:
    """`count` movers, or flocks of them, of random kinds, near the origin of the world."""
    kinds: tuple[Callable[[Generator, Array64], Iterator[PathMover]], ...] = (
        _glider, _glider, _glider, _circling, _kestrel, _flock, _insect, _kite, _bag, _balloon,
    )  # fmt: skip
    for kind in rng.integers(0, len(kinds), count):
        angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(*NEAR_M)
        position = np.array([far * np.cos(angle), far * np.sin(angle), rng.uniform(*height_m)])
        yield from kinds[kind](rng, position)


def _glider(rng: Generator, position: Array64, flap: float = 0.4) -> Iterator[PathMover]:
    span = rng.uniform(0.25, 1.1)
    velocity = _velocity(rng, rng.uniform(2.0, 8.0), rng.normal(0, 0.3))
    yield _bird(span, _straight(rng, position, velocity), 8.5, rng.uniform(2, 6) if rng.uniform() < flap else 0.0)


def _circling(rng: Generator, position: Array64) -> Iterator[PathMover]:
    radius, speed, turn = rng.uniform(3.0, 14.0), rng.uniform(3.0, 9.0), rng.choice([-1.0, 1.0])
    t = np.arange(0.0, LASTS_S, min(KNOT_S, radius / speed / 2))
    angle = turn * speed / radius * t + rng.uniform(0, 2 * np.pi)
    circle = radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(t))])
    points = position + circle + np.outer(t, [0.0, 0.0, rng.uniform(-0.3, 0.5)])
    yield _bird(rng.uniform(0.3, 1.2), _path(t, points, angle + turn * np.pi / 2), 10.0, rng.uniform(0, 3))


def _kestrel(rng: Generator, position: Array64) -> Iterator[PathMover]:
    """Hovers into the wind, shifts to another position now and then."""
    t = np.arange(0.0, LASTS_S, KNOT_S)
    step = rng.normal(0, 0.12, (len(t), 3)) + (rng.uniform(size=(len(t), 1)) < 0.08) * rng.normal(0, 3.0, (len(t), 3))
    points = position + np.cumsum(step, axis=0)
    yaw = np.full(len(t), rng.uniform(0, 6))
    yield _bird(rng.uniform(0.35, 0.8), _path(t, points, yaw), 12.0, rng.uniform(4, 8))


def _flock(rng: Generator, position: Array64) -> Iterator[PathMover]:
    span, velocity, beat = rng.uniform(0.25, 0.9), _velocity(rng, rng.uniform(4.0, 13.0), 0.0), rng.uniform(0, 6)
    start_s = rng.uniform(1, 14)
    for _ in range(rng.integers(3, 8)):
        offset = rng.normal(0, [2.0, 2.0, 1.0])
        yield _bird(span, _straight(rng, position + offset, velocity + rng.normal(0, 0.2, 3), start_s), 14.5, beat)


def _insect(rng: Generator, position: Array64) -> Iterator[PathMover]:
    near = position * rng.uniform(2.0, 5.0) / np.linalg.norm(position)
    t = np.arange(0.0, LASTS_S, 0.5)
    points = near + np.cumsum(rng.normal(0, 0.4, (len(t), 3)), axis=0) * [1, 1, 0.5]
    points[:, 2] = np.maximum(points[:, 2], 0.8)
    yield PathMover("insect", (box((-0.012, -0.01, -0.01), (0.012, 0.01, 0.01), "feather"),), _path(t, points), 6.0)


def _kite(rng: Generator, position: Array64) -> Iterator[PathMover]:
    s = rng.uniform(0.4, 0.9)
    diamond = quads([[(0, -0.6 * s, 0), (-0.5 * s, 0, -s), (0, 0.6 * s, 0), (0.3 * s, 0, 0.6 * s)]], "latex")
    path = _swaying(rng, position + np.array([0.0, 0.0, 5.0]), rng.uniform(0.5, 2.5))
    yield PathMover("kite", (diamond,), path, 10.0)


def _bag(rng: Generator, position: Array64) -> Iterator[PathMover]:
    s = rng.uniform(0.15, 0.3)
    bag = box((-s, -0.6 * s, -s), (0.7 * s, 0.8 * s, s), "latex", taper=0.4)
    path = _straight(rng, position, _velocity(rng, rng.uniform(0.5, 4.0), rng.normal(0, 0.5)), wander_m=0.6)
    yield PathMover("bag", (bag,), path, 8.0)


def _balloon(rng: Generator, position: Array64) -> Iterator[PathMover]:
    velocity = _velocity(rng, rng.uniform(0.3, 4.0), rng.uniform(0.2, 1.6))
    free = rng.uniform() < 0.5
    path = _straight(rng, position, velocity, wander_m=0.3) if free else _swaying(rng, position, rng.uniform(0.2, 0.8))
    yield PathMover("balloon", (balloon_mesh(rng.uniform(0.28, 0.6)),), path, 8.0)


def _bird(span_m: float, path: Path, speed_mps: float, beat_hz: float) -> PathMover:
    steps = range(FLAP_STEPS) if beat_hz > 0.5 else [2]  # wings level
    meshes = tuple(bird_mesh(span_m, 2 * np.pi * step / FLAP_STEPS) for step in steps)
    return PathMover("bird", meshes, path, speed_mps, beat_hz)


def _velocity(rng: Generator, speed_mps: float, up_mps: float) -> Array64:
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([speed_mps * np.cos(angle), speed_mps * np.sin(angle), up_mps])


def _straight(
    rng: Generator, position: Array64, velocity: Array64, at_s: float | None = None, wander_m: float = 0.0
) -> Path:
    """A straight path that passes `position` at `at_s`, at most 40 m high and at least 1 m above the camera."""
    t = np.array([0.0, LASTS_S]) if wander_m == 0.0 else np.arange(0.0, LASTS_S, KNOT_S)
    points = position + np.outer(t - (rng.uniform(0.0, 15.0) if at_s is None else at_s), velocity)
    points += np.cumsum(rng.normal(0, max(wander_m, 1e-12), points.shape), axis=0)
    points[:, 2] = np.clip(points[:, 2], 1.0, 40.0)
    return _path(t, points, np.full(len(t), np.arctan2(velocity[1], velocity[0])))


def _swaying(rng: Generator, position: Array64, sway_m: float) -> Path:
    t = np.arange(0.0, LASTS_S, KNOT_S)
    return _path(t, position + rng.normal(0, sway_m, (len(t), 3)) * [1, 1, 0.4])


def _path(t_s: Array64, points_m: Array64, yaw_rad: Array64 | None = None) -> Path:
    yaw_deg = np.zeros(len(t_s)) if yaw_rad is None else np.degrees(yaw_rad)
    rows = zip(t_s.tolist(), points_m.tolist(), yaw_deg.tolist(), strict=True)
    return Path(waypoints=tuple(Waypoint(t_s=t, xyz_m=(x, y, z), yaw_deg=yaw) for t, (x, y, z), yaw in rows))
