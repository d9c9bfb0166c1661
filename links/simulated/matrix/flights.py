"""Motions of vehicle and drone in a cell of the scenario matrix.

The seed draws the direction in which the drone flies, among those free of obstacles and with a line of sight to the
LiDAR. Ranges are relative to the LiDAR and hold while the vehicle drives: the drone's motion is added to the vehicle's.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from flow.link import LinkError
from links.simulated.world.clearance import fits, visible
from links.simulated.world.mesh import RayScene
from links.simulated.world.path import Path, Waypoint
from links.simulated.world.procedural import SceneSettings, build_world
from links.simulated.world.procedural.settings import Kind
from stages.geometry.frames import Array64

CAMERA_HEIGHT_M = 1.8
DURATION_S = {"occlusion": 16.0, "return": 24.0, "empty": 30.0}
USUAL_DURATION_S = 12.0
KNOT_S = 0.5
CLEARANCE_M = 1.0  # around the drone
VEHICLE_CLEARANCE_M = 1.2  # around the vehicle's camera
PATH_STEP = 5  # samples: the vehicle's path every 0.25 s, as `image_cache.scenario_world` uses it
ELEVATIONS_RAD = np.radians((45.0, 60.0, 75.0))
MUST_SEE = 0.95  # fraction of the time with a line of sight
HIDDEN_S = 3.0
FARTHEST_M = 75.0  # limit of the vehicle's path: half the distance to the end of a scene
FAR_M = 105.0  # beyond the LiDAR's range
SEPARATION_DEG = (40.0, 60.0)  # between two drones at the start, which is their minimum

Motion = Callable[[Array64], Array64]  # times (n,) -> offset (n, 3) from the LiDAR, world axes [m]


@dataclass(frozen=True)
class Cell:
    """One case of the matrix."""

    scene: Kind
    range_m: int
    motion: str  # of MOTIONS, SPECIALS or GOALS
    vehicle: str

    @property
    def name(self) -> str:
        """`campus-20m-orbit-driving`."""
        return f"{self.scene}-{self.range_m}m-{self.motion}-{self.vehicle}"

    @property
    def duration_s(self) -> float:
        """Duration [s]."""
        return DURATION_S.get(self.motion, USUAL_DURATION_S)


def vehicle_path(cell: Cell, seed: int, rng: Generator, times: Array64) -> tuple[Path, RayScene]:
    """Straight at 5 m/s, or in circles at 20 deg/s; slower or tighter where space or time are short.

    The scene depends on the path: it keeps the path free of cars, trees and poles.
    """
    knots = np.arange(0.0, cell.duration_s + KNOT_S, KNOT_S)
    side = float(rng.choice([-1.0, 1.0]))
    if cell.vehicle == "parked":
        candidates = [path_of(np.zeros(1), np.zeros((1, 3)))]
    elif cell.vehicle == "driving":
        candidates = [
            path_of(knots, np.outer(speed * knots, [np.cos(yaw), np.sin(yaw), 0.0]), np.full(len(knots), yaw))
            for speed in np.minimum((5.0, 3.0, 1.5), FARTHEST_M / cell.duration_s)
            for yaw in side * np.radians([0, 10, -10, 20, -20, 45, -45, 90, -90, 180])
        ]
    else:
        turn = side * np.radians(20.0) * knots
        candidates = [
            path_of(knots, r * side * np.column_stack([np.sin(turn), 1 - np.cos(turn), 0 * turn]), turn)
            for r in (4.0, 3.0, 2.0, 1.0, 0.0)
        ]
    for path in candidates:
        driven_m = path.at(times)[0]
        scene = build_world(SceneSettings(kind=cell.scene), CAMERA_HEIGHT_M, seed, driven_m[::PATH_STEP, :2])
        world = RayScene(scene.mesh)
        if fits(world, driven_m, VEHICLE_CLEARANCE_M):
            return path, world
    raise LinkError(f"{cell.name}: no free path for the vehicle in this scene; choose another seed")


def drone_path(cell: Cell, world: RayScene, rng: Generator, times: Array64, lidar_m: Array64) -> Path:
    """The first flight, over all directions from low to high, that is clear and as visible as the cell requires."""
    for path, _, _ in _flights(cell, world, rng, times, lidar_m):
        return path
    raise _no_flight(cell)


def two_paths(cell: Cell, world: RayScene, rng: Generator, times: Array64, lidar_m: Array64) -> tuple[Path, Path]:
    """A drone that orbits and one that hovers behind its start, both clear and visible."""
    hover = replace(cell, motion="hover")
    behind = np.radians([50.0, 45.0, 55.0, *SEPARATION_DEG])
    for orbit, azimuth, elevation in _flights(cell, world, rng, times, lidar_m):
        orbit_m = orbit.at(times)[0]
        for height, aside in product((elevation, *ELEVATIONS_RAD), behind):
            path, positions_m = _follow(hover, next(motions(hover, azimuth - float(aside), height)), times, lidar_m)
            separation = _azimuth_difference(orbit_m - lidar_m, positions_m - lidar_m).min()
            if separation > np.radians(SEPARATION_DEG[0] - 2.0) and _is_possible(hover, world, lidar_m, positions_m):
                return orbit, path
    raise _no_flight(cell)


def _flights(
    cell: Cell, world: RayScene, rng: Generator, times: Array64, lidar_m: Array64
) -> Iterator[tuple[Path, float, float]]:
    """All possible flights, with the azimuth and elevation [rad] of their start."""
    azimuths = rng.permutation(24) * np.radians(15.0) + rng.uniform(0, np.radians(15.0))
    elevations = np.radians((10.0, 17.0, 25.0, 33.0)) if cell.motion == "occlusion" else ELEVATIONS_RAD
    for elevation, azimuth in product(elevations, azimuths):
        for motion in motions(cell, float(azimuth), float(elevation)):
            path, positions_m = _follow(cell, motion, times, lidar_m)
            if _is_possible(cell, world, lidar_m, positions_m):
                yield path, float(azimuth), float(elevation)


def _follow(cell: Cell, motion: Motion, times: Array64, lidar_m: Array64) -> tuple[Path, Array64]:
    """The path of a motion relative to the vehicle, and its positions (n, 3) at `times`."""
    knots = np.arange(0.0, cell.duration_s + KNOT_S, KNOT_S)
    at_knots = np.column_stack([np.interp(knots, times, lidar_m[:, axis]) for axis in range(3)])
    path = path_of(knots, at_knots + motion(knots))
    return path, path.at(times)[0]


def _is_possible(cell: Cell, world: RayScene, lidar_m: Array64, positions_m: Array64) -> bool:
    return _is_visible_as_required(cell, visible(world, lidar_m, positions_m)) and fits(world, positions_m, CLEARANCE_M)


def _no_flight(cell: Cell) -> LinkError:
    return LinkError(f"{cell.name}: no free flight of this kind in this scene; choose another seed")


def _azimuth_difference(a: Array64, b: Array64) -> Array64:
    """Angle (n,) between the azimuths of directions (n, 3), 0 to pi [rad]."""
    turn = np.arctan2(a[:, 1], a[:, 0]) - np.arctan2(b[:, 1], b[:, 0])
    return np.abs(np.mod(turn + np.pi, 2 * np.pi) - np.pi)


def _is_visible_as_required(cell: Cell, shown: NDArray[np.bool_]) -> bool:
    """Visible all the time; for an occlusion hidden once, for 3 s, and visible before and after."""
    if cell.motion != "occlusion":
        return bool(shown.mean() >= MUST_SEE)
    hidden = np.nonzero(~shown)[0]
    if len(hidden) == 0:
        return False
    once_s = (hidden[-1] - hidden[0] + 1) * cell.duration_s / len(shown)
    shown_before = hidden[0] >= 0.4 * len(shown)
    return bool(shown_before and abs(once_s - HIDDEN_S) < 0.4 and len(hidden) * cell.duration_s / len(shown) > 2.4)


def motions(cell: Cell, azimuth: float, elevation: float) -> Iterator[Motion]:
    """Motions of a cell that start in a direction [rad]; several where the scene determines how far to go."""
    reach = float(cell.range_m)
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    aside = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    centre = reach * (np.cos(elevation) * level + np.sin(elevation) * up)
    duration = cell.duration_s

    def swing(t: Array64, amplitude: float, speed: float) -> Array64:
        """Oscillation that starts at its centre with this speed [m/s]."""
        return amplitude * np.sin(speed / amplitude * t)

    if cell.motion in ("hover", "search"):
        yield lambda t: centre + np.outer(swing(t, 0.3, 0.2), aside) + np.outer(swing(t, 0.2, 0.15), up)
    elif cell.motion in ("orbit", "two"):
        radius = reach * np.cos(elevation)
        yield lambda t: around(azimuth + 3.0 / radius * t, radius, reach * np.sin(elevation))
    elif cell.motion == "cross":
        half = min(1.5 * duration, reach)
        yield lambda t: centre + np.outer(half * (2 * t / duration - 1), aside)
    elif cell.motion == "fast":
        yield lambda t: centre + np.outer(swing(t, 12.8, 8.0), aside)
    elif cell.motion == "overhead":
        half = min(duration, 0.5 * reach)
        yield lambda t: reach * up + np.outer(half * (2 * t / duration - 1), level)
    elif cell.motion == "climb":
        rise = min(2.0 * duration, 0.5 * reach)
        yield lambda t: centre + np.outer(rise * (t / duration - 0.5), up)
    elif cell.motion == "wander":
        for attempt in range(4):
            yield _wander(centre, duration, np.random.default_rng([int(1e6 * azimuth), int(1e6 * elevation), attempt]))
    elif cell.motion == "return":
        there = np.clip(np.array([4.0, 11.5, 14.0, 21.5]), 0, duration)
        yield lambda t: centre * (1 + np.outer(np.interp(t, there, [0, 1, 1, 0]), (FAR_M - reach) / reach * np.ones(3)))
    else:
        radius, height = reach * np.cos(elevation), reach * np.sin(elevation)
        for turn, wait_s in product(np.radians([20, 40, 60, 80, -20, -40, -60, -80]), (1.0, 2.0, 3.0)):
            middle = 0.6 * duration
            knots = [middle - wait_s / 2 - 2.5, middle - wait_s / 2, middle + wait_s / 2, middle + wait_s / 2 + 2.5]
            yield lambda t, k=knots, turn=turn: around(azimuth + np.interp(t, k, [0, turn, turn, 0]), radius, height)


def _wander(centre: Array64, duration_s: float, rng: Generator) -> Motion:
    """Random flight about a centre at up to 1 to 12 m/s: a sum of sines on each axis, less along the vertical."""
    top_mps = rng.uniform(1.0, 12.0)
    rate = rng.uniform(0.15, 0.7, (3, 3))  # [rad/s]
    phase = rng.uniform(0, 2 * np.pi, (3, 3))
    share = rng.dirichlet(np.ones(3), 3) * np.array([[1.0], [1.0], [0.25]])
    amplitude = np.minimum(top_mps * share / rate, 0.35 * np.linalg.norm(centre))

    axes = list(zip(rate, phase, amplitude, strict=True))

    def motion(t: Array64) -> Array64:
        return centre + np.stack([np.sin(np.outer(t, w) + p) @ a for w, p, a in axes], axis=1)

    return motion


def around(azimuth_rad: Array64, radius_m: float, height_m: float) -> Array64:
    """Points (n, 3) on a horizontal circle around the LiDAR."""
    level = [radius_m * np.cos(azimuth_rad), radius_m * np.sin(azimuth_rad), np.full(len(azimuth_rad), height_m)]
    return np.column_stack(level)


def path_of(times_s: Array64, xyz_m: Array64, yaw_rad: Array64 | None = None) -> Path:
    """A path through points (n, 3) at times (n,), rounded to millimetres, as in a file."""
    yaw_deg = np.zeros(len(times_s)) if yaw_rad is None else np.degrees(yaw_rad)
    rows = zip(times_s, np.round(xyz_m, 3).tolist(), yaw_deg, strict=True)
    return Path(waypoints=tuple(Waypoint(t_s=float(t), xyz_m=p, yaw_deg=round(float(y), 3)) for t, p, y in rows))
