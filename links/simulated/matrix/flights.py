"""How vehicle and drone move in a cell of the scenario matrix.

The seed draws the side on which the drone flies, from the ones that are free of obstacles and that the LiDAR can see.
Ranges are from the LiDAR, kept while the vehicle drives: the drone flies with it, and its motion comes on top.

Source: ours, after the cases of issue "A simulated rig".
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
from stages.geometry import Array64

CAMERA_HEIGHT_M = 1.8
DURATION_S = {"occlusion": 16.0, "return": 24.0, "empty": 30.0}
USUAL_DURATION_S = 12.0
KNOT_S = 0.5
ROOM_M = 1.0  # around the drone
BODY_ROOM_M = 1.2  # around the vehicle's camera
WAY_STEP = 5  # of the samples: the vehicle's way each 0.25 s, as `Simulation` tells it to the scene
ELEVATIONS_RAD = np.radians((45.0, 60.0, 75.0))
MUST_SEE = 0.95  # of the time
HIDDEN_S = 3.0
FARTHEST_M = 75.0  # half way to where a scene ends: no vehicle drives on
FAR_M = 105.0  # beyond the LiDAR's reach
SEPARATION_DEG = (40.0, 60.0)  # between two drones at the start; they come no nearer

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
        """How long it takes [s]."""
        return DURATION_S.get(self.motion, USUAL_DURATION_S)


def vehicle_path(cell: Cell, seed: int, rng: Generator, times: Array64) -> tuple[Path, RayScene]:
    """Straight at 5 m/s, or round in circles at 20 deg/s; slower or tighter where there is no room or time for that.

    The scene goes with it: it keeps the vehicle's way free of what is not built of stone.
    """
    knots = np.arange(0.0, cell.duration_s + KNOT_S, KNOT_S)
    side = float(rng.choice([-1.0, 1.0]))
    if cell.vehicle == "parked":
        tried = [path_of(np.zeros(1), np.zeros((1, 3)))]
    elif cell.vehicle == "driving":
        tried = [
            path_of(knots, np.outer(speed * knots, [np.cos(yaw), np.sin(yaw), 0.0]), np.full(len(knots), yaw))
            for speed in np.minimum((5.0, 3.0, 1.5), FARTHEST_M / cell.duration_s)
            for yaw in side * np.radians([0, 10, -10, 20, -20, 45, -45, 90, -90, 180])
        ]
    else:
        turn = side * np.radians(20.0) * knots
        tried = [
            path_of(knots, r * side * np.column_stack([np.sin(turn), 1 - np.cos(turn), 0 * turn]), turn)
            for r in (4.0, 3.0, 2.0, 1.0, 0.0)
        ]
    for path in tried:
        driven_m = path.at(times)[0]
        scene = build_world(SceneSettings(kind=cell.scene), CAMERA_HEIGHT_M, seed, driven_m[::WAY_STEP, :2])
        world = RayScene(scene.mesh)
        if fits(world, driven_m, BODY_ROOM_M):
            return path, world
    raise LinkError(f"{cell.name}: no way for the vehicle in this scene; take another seed")


def drone_path(cell: Cell, world: RayScene, rng: Generator, times: Array64, lidar_m: Array64) -> Path:
    """The first flight, of all sides from low to high, that has room and is seen as the cell wants it."""
    for path, _, _ in _flights(cell, world, rng, times, lidar_m):
        return path
    raise _no_flight(cell)


def two_paths(cell: Cell, world: RayScene, rng: Generator, times: Array64, lidar_m: Array64) -> tuple[Path, Path]:
    """One drone that orbits and one that hovers where the first one came from, both free and in sight."""
    hover = replace(cell, motion="hover")
    behind = np.radians([50.0, 45.0, 55.0, *SEPARATION_DEG])
    for orbit, azimuth, elevation in _flights(cell, world, rng, times, lidar_m):
        orbit_m = orbit.at(times)[0]
        for height, aside in product((elevation, *ELEVATIONS_RAD), behind):
            path, flown_m = _flown(hover, next(motions(hover, azimuth - float(aside), height)), times, lidar_m)
            apart = _azimuths_apart(orbit_m - lidar_m, flown_m - lidar_m).min()
            if apart > np.radians(SEPARATION_DEG[0] - 2.0) and _is_possible(hover, world, lidar_m, flown_m):
                return orbit, path
    raise _no_flight(cell)


def _flights(
    cell: Cell, world: RayScene, rng: Generator, times: Array64, lidar_m: Array64
) -> Iterator[tuple[Path, float, float]]:
    """All flights that are possible, with the azimuth and elevation [rad] that they start towards."""
    azimuths = rng.permutation(24) * np.radians(15.0) + rng.uniform(0, np.radians(15.0))
    elevations = np.radians((10.0, 17.0, 25.0, 33.0)) if cell.motion == "occlusion" else ELEVATIONS_RAD
    for elevation, azimuth in product(elevations, azimuths):
        for motion in motions(cell, float(azimuth), float(elevation)):
            path, flown_m = _flown(cell, motion, times, lidar_m)
            if _is_possible(cell, world, lidar_m, flown_m):
                yield path, float(azimuth), float(elevation)


def _flown(cell: Cell, motion: Motion, times: Array64, lidar_m: Array64) -> tuple[Path, Array64]:
    """A motion on top of the vehicle's, and where it is (n, 3) at `times`."""
    knots = np.arange(0.0, cell.duration_s + KNOT_S, KNOT_S)
    at_knots = np.column_stack([np.interp(knots, times, lidar_m[:, axis]) for axis in range(3)])
    path = path_of(knots, at_knots + motion(knots))
    return path, path.at(times)[0]


def _is_possible(cell: Cell, world: RayScene, lidar_m: Array64, flown_m: Array64) -> bool:
    return _as_wanted(cell, visible(world, lidar_m, flown_m)) and fits(world, flown_m, ROOM_M)


def _no_flight(cell: Cell) -> LinkError:
    return LinkError(f"{cell.name}: no free flight of this kind in this scene; take another seed")


def _azimuths_apart(a: Array64, b: Array64) -> Array64:
    """Angle (n,) between the azimuths of directions (n, 3), 0 to pi [rad]."""
    turn = np.arctan2(a[:, 1], a[:, 0]) - np.arctan2(b[:, 1], b[:, 0])
    return np.abs(np.mod(turn + np.pi, 2 * np.pi) - np.pi)


def _as_wanted(cell: Cell, seen: NDArray[np.bool_]) -> bool:
    """In sight all along; or, for an occlusion, out of sight once, for 3 s, and in sight before and after."""
    if cell.motion != "occlusion":
        return bool(seen.mean() >= MUST_SEE)
    hidden = np.nonzero(~seen)[0]
    if len(hidden) == 0:
        return False
    once_s = (hidden[-1] - hidden[0] + 1) * cell.duration_s / len(seen)
    shown_before = hidden[0] >= 0.4 * len(seen)
    return bool(shown_before and abs(once_s - HIDDEN_S) < 0.4 and len(hidden) * cell.duration_s / len(seen) > 2.4)


def motions(cell: Cell, azimuth: float, elevation: float) -> Iterator[Motion]:
    """Flights of a cell that start towards a direction [rad]; several where how far to go depends on the scene."""
    reach = float(cell.range_m)
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    aside = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    centre = reach * (np.cos(elevation) * level + np.sin(elevation) * up)
    duration = cell.duration_s

    def swing(t: Array64, amplitude: float, speed: float) -> Array64:
        """Back and forth, starting at the middle with this speed [m/s]."""
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
    elif cell.motion == "return":
        there = np.clip(np.array([4.0, 11.5, 14.0, 21.5]), 0, duration)
        yield lambda t: centre * (1 + np.outer(np.interp(t, there, [0, 1, 1, 0]), (FAR_M - reach) / reach * np.ones(3)))
    else:
        radius, height = reach * np.cos(elevation), reach * np.sin(elevation)
        for turn, wait_s in product(np.radians([20, 40, 60, 80, -20, -40, -60, -80]), (1.0, 2.0, 3.0)):
            middle = 0.6 * duration
            knots = [middle - wait_s / 2 - 2.5, middle - wait_s / 2, middle + wait_s / 2, middle + wait_s / 2 + 2.5]
            yield lambda t, k=knots, turn=turn: around(azimuth + np.interp(t, k, [0, turn, turn, 0]), radius, height)


def around(azimuth_rad: Array64, radius_m: float, height_m: float) -> Array64:
    """Points (n, 3) on a level circle about the LiDAR."""
    level = [radius_m * np.cos(azimuth_rad), radius_m * np.sin(azimuth_rad), np.full(len(azimuth_rad), height_m)]
    return np.column_stack(level)


def path_of(times_s: Array64, xyz_m: Array64, yaw_rad: Array64 | None = None) -> Path:
    """A path through points (n, 3) at times (n,), rounded to millimetres as a file would hold it."""
    yaw_deg = np.zeros(len(times_s)) if yaw_rad is None else np.degrees(yaw_rad)
    rows = zip(times_s, np.round(xyz_m, 3).tolist(), yaw_deg, strict=True)
    return Path(waypoints=tuple(Waypoint(t_s=float(t), xyz_m=p, yaw_deg=round(float(y), 3)) for t, p, y in rows))
