"""Whether a path is free of obstacles and outside buildings, and whether the LiDAR has a line of sight to it.

Source: ours. Rays from each sample of a path: 26 directions for near obstacles, a hemisphere for open sky.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from flow.link import LinkError
from links.simulated.world.mesh import RayScene
from links.simulated.world.scene import Truth
from stages.geometry.frames import Array64

SAMPLE_S = 0.05
SKY_M = 300.0  # larger than any scene
_GRID = np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
DIRECTIONS = _GRID / np.linalg.norm(_GRID, axis=1, keepdims=True)  # (26, 3)
_RING_RAD = np.arange(12) * np.pi / 6
UPWARD_DIRECTIONS = np.array(
    [(0.0, 0.0, 1.0)]
    + [(np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)) for e in np.radians([25, 50, 75]) for a in _RING_RAD]
)  # (37, 3)
MAST_M = 0.5  # clearance of the vehicle's mast around the camera


def sample_times_s(duration_s: float) -> Array64:
    """Times [s] at which a path is checked."""
    return np.arange(0.0, duration_s, SAMPLE_S)


def clearance_m(world: RayScene, points_world_m: Array64, reach_m: float) -> Array64:
    """Distance (n,) from each point (n, 3) to the nearest surface, as sampled by rays; inf beyond reach_m."""
    return _cast(world, points_world_m, DIRECTIONS, reach_m).min(axis=1)


def under_open_sky(world: RayScene, points_world_m: Array64) -> NDArray[np.bool_]:
    """Whether some direction from each point (n, 3) is free up to the sky; inside a building none is."""
    return np.any(np.isinf(_cast(world, points_world_m, UPWARD_DIRECTIONS, SKY_M)), axis=1)


def visible(world: RayScene, from_world_m: Array64, to_world_m: Array64) -> NDArray[np.bool_]:
    """Whether the line between points (n, 3) and (n, 3) is free."""
    away = to_world_m - from_world_m
    distance = np.linalg.norm(away, axis=1)
    directions = (away / distance[:, None]).astype(np.float32)
    ranges, _ = world.cast(from_world_m.astype(np.float32), directions, SKY_M)
    return ranges > distance


def _cast(world: RayScene, points_m: Array64, directions: Array64, reach_m: float) -> Array64:
    origins = np.repeat(points_m, len(directions), axis=0).astype(np.float32)
    rays = np.tile(directions, (len(points_m), 1)).astype(np.float32)
    return world.cast(origins, rays, reach_m)[0].astype(np.float64).reshape(len(points_m), len(directions))


def fits(world: RayScene, points_world_m: Array64, required_m: float) -> bool:
    """Whether all samples (n, 3) of a path have the required clearance and open sky."""
    near = clearance_m(world, points_world_m, required_m)
    return bool(np.isinf(near).all() and under_open_sky(world, points_world_m).all())


def check_paths(world: RayScene, truth: Truth, duration_s: float, spans_m: Sequence[float]) -> None:
    """LinkError when the path of the vehicle's camera or of a drone (with these spans) is blocked in this scene."""
    times = sample_times_s(duration_s)
    stamps = truth.start_ns + np.rint(times * 1e9).astype(np.int64)
    check_path(world, times, truth.T_world_vehicle(stamps)[1], MAST_M, "vehicle.path")
    for number, span_m in zip(truth.drones, spans_m, strict=True):
        name = "drone.path" if number == 1 else f"other_drones.{number - 2}.path"
        check_path(world, times, truth.T_world_drone(stamps, number)[1], span_m / 2, name)


def check_path(world: RayScene, time_s: Array64, points_world_m: Array64, required_m: float, name: str) -> None:
    """LinkError when the samples (n, 3) of a path come too near to a surface or pass through a building."""
    hidden = ~under_open_sky(world, points_world_m)
    near = clearance_m(world, points_world_m, required_m)
    for wrong, text in (
        (hidden, "inside a building or under a roof"),
        (near < required_m, f"{{near:.2f}} m from an obstacle, less than {required_m:.2f} m"),
    ):
        if wrong.any():
            first = int(wrong.argmax())
            x, y, z = points_world_m[first]
            raise LinkError(
                f"{name}: {text.format(near=near[first])} at {time_s[first]:.2f} s, ({x:.1f}, {y:.1f}, {z:.1f}) m; "
                "move its waypoints, or choose another seed (it draws the scene)"
            )
