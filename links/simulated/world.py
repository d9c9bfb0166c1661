"""A street as a mesh, by seed: road, kerbs, facades with recessed windows, side streets, trees, poles, wires, cars.

Source: ours. Street frame: road axis along x, z = 0 on the carriageway. `street_mesh` returns it in the world frame,
whose origin is the vehicle camera at the start. Nothing here knows about the drone or the method.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.random import Generator
from pydantic import BaseModel, ConfigDict, Field

from links.simulated.mesh import Array64, Mesh, box, merge, quads, rod
from stages.geometry import rotation_z

HALF_LENGTH_M = 150.0  # beyond the LiDAR's reach from the middle
KERB_HEIGHT_M = 0.12


class SceneSettings(BaseModel):
    """What stands around the vehicle."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    kind: Literal["street"] = "street"
    road_width_m: float = Field(default=7.5, ge=5, le=30)
    pavement_width_m: float = Field(default=3.5, ge=1.5, le=15)
    building_height_m: tuple[float, float] = (6.0, 24.0)
    side_streets: float = Field(default=0.2, ge=0, le=1)  # chance of a gap after each building
    tree_spacing_m: float = Field(default=14.0, gt=2)
    pole_spacing_m: float = Field(default=30.0, gt=5)
    parked_cars: float = Field(default=0.35, ge=0, le=1)  # share of kerb places taken
    vehicle_lane_y_m: float = -1.9  # the vehicle's start on the street
    vehicle_yaw_deg: float = 0.0


def world_mesh(settings: SceneSettings, camera_height_m: float, seed: int) -> Mesh:
    """The scene in the world frame. Same settings and seed: the same mesh."""
    rng = np.random.default_rng([seed, 1])
    street = merge([_ground(settings), *_both_sides(settings, rng), *_poles_and_wires(settings, rng)])
    at_camera = street.moved((0.0, -settings.vehicle_lane_y_m, -camera_height_m))
    return at_camera.moved(rotation=rotation_z(-np.radians(settings.vehicle_yaw_deg)))


def _ground(settings: SceneSettings) -> Mesh:
    half, length, far = settings.road_width_m / 2, HALF_LENGTH_M, HALF_LENGTH_M
    parts = [quads([[(-length, -half, 0), (length, -half, 0), (length, half, 0), (-length, half, 0)]], "asphalt")]
    for side in (-1, 1):
        k, h = side * half, KERB_HEIGHT_M
        parts.append(quads([[(-length, k, 0), (length, k, 0), (length, k, h), (-length, k, h)]], "kerb"))
        edge = k + side * settings.pavement_width_m
        parts.append(quads([[(-length, k, h), (length, k, h), (length, edge, h), (-length, edge, h)]], "paving"))
        parts.append(
            quads(
                [[(-length, edge, h), (length, edge, h), (length, side * far, h), (-length, side * far, h)]], "asphalt"
            )
        )
    return merge(parts)


def _both_sides(settings: SceneSettings, rng: Generator) -> list[Mesh]:
    parts: list[Mesh] = []
    for side in (-1, 1):
        parts += _buildings(settings, side, rng)
        parts += _trees(settings, side, rng)
        parts += _cars(settings, side, rng)
    return parts


def _buildings(settings: SceneSettings, side: int, rng: Generator) -> list[Mesh]:
    parts: list[Mesh] = []
    front = settings.road_width_m / 2 + settings.pavement_width_m
    x = -HALF_LENGTH_M + rng.uniform(0, 10)
    while x < HALF_LENGTH_M:
        width, depth = rng.uniform(10, 28), rng.uniform(10, 14)
        height = rng.uniform(*settings.building_height_m)
        set_back = rng.choice([0.0, 0.0, rng.uniform(0.3, 2.5)])
        surface = str(rng.choice(["brick", "plaster", "concrete"]))
        house = _building(width, depth, height, surface, rng)
        if side < 0:
            house = house.moved(rotation=rotation_z(np.pi)).moved((width, 0, 0))
        parts.append(house.moved((x, side * (front + set_back), KERB_HEIGHT_M)))
        x += width + (rng.uniform(4, 10) if rng.uniform() < settings.side_streets else 0.0)
    x = -HALF_LENGTH_M
    while x < HALF_LENGTH_M:  # the next row, seen through the gaps
        width, height, y = rng.uniform(12, 30), rng.uniform(8, 30), front + rng.uniform(28, 40)
        parts.append(
            box((x, min(side * y, side * (y + 12)), 0), (x + width, max(side * y, side * (y + 12)), height), "concrete")
        )
        x += width + rng.uniform(0, 6)
    return parts


def _building(width_m: float, depth_m: float, height_m: float, surface: str, rng: Generator) -> Mesh:
    """One house: front at y = 0 (facing -y), x from 0 to width, with cornice, parapet and chimneys."""
    floors = max(1, int(height_m // rng.uniform(2.9, 3.6)))
    recess = rng.uniform(0.08, 0.25)
    front = _facade(width_m, height_m, floors, recess, surface, rng)
    left = _facade(depth_m, height_m, floors, recess, surface, rng).moved(rotation=rotation_z(-np.pi / 2))
    right = _facade(depth_m, height_m, floors, recess, surface, rng).moved(rotation=rotation_z(np.pi / 2))
    h, w, d = height_m, width_m, depth_m
    parts = [
        front,
        left.moved((0, depth_m, 0)),
        right.moved((width_m, 0, 0)),
        quads([[(0, d, 0), (w, d, 0), (w, d, h), (0, d, h)]], surface),
        quads([[(0, 0, h), (w, 0, h), (w, d, h), (0, d, h)]], "roof"),
        box((-0.15, -rng.uniform(0.15, 0.5), h - 0.3), (w + 0.15, 0.2, h + rng.uniform(0.0, 0.9)), surface),
    ]
    for _ in range(rng.integers(0, 4)):
        x, y = rng.uniform(0.5, w - 1.5), rng.uniform(2, d - 2)
        parts.append(box((x, y, h), (x + 0.6, y + 0.8, h + rng.uniform(0.8, 2.0)), "brick"))
    return merge(parts)


def _facade(width_m: float, height_m: float, floors: int, recess_m: float, surface: str, rng: Generator) -> Mesh:
    """A wall in the plane y = 0 facing -y, one row of recessed windows a floor; glass stands at y = recess."""
    columns = max(1, int(width_m // rng.uniform(2.4, 3.8)))
    pitch, storey = width_m / columns, height_m / floors
    window_w, window_h = pitch * rng.uniform(0.35, 0.6), storey * rng.uniform(0.45, 0.65)
    sill = (storey - window_h) * 0.6
    x0 = pitch * np.arange(columns) + (pitch - window_w) / 2
    x1 = x0 + window_w
    wall: list[Array64] = []
    glass: list[Array64] = []
    wall_x0, wall_x1 = np.append(0.0, x1), np.append(x0, width_m)
    for floor in range(floors):
        z0, z1, top = floor * storey + sill, floor * storey + sill + window_h, (floor + 1) * storey
        wall += [_upright(0.0, width_m, floor * storey, z0), _upright(0.0, width_m, z1, top)]
        wall += [_upright(a, b, z0, z1) for a, b in zip(wall_x0, wall_x1, strict=True)]
        for a, b in zip(x0, x1, strict=True):
            outer, inner = _upright(a, b, z0, z1), _upright(a, b, z0, z1, recess_m)
            glass.append(inner)
            for i in range(4):
                j = (i + 1) % 4
                wall.append(np.array([outer[i], outer[j], inner[j], inner[i]]))
    return merge([quads(np.array(wall), surface), quads(np.array(glass), "glass")])


def _upright(x0: float, x1: float, z0: float, z1: float, y: float = 0.0) -> Array64:
    return np.array([(x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1)])


def _trees(settings: SceneSettings, side: int, rng: Generator) -> list[Mesh]:
    parts: list[Mesh] = []
    for x in np.arange(-100.0, 100.0, settings.tree_spacing_m):
        if rng.uniform() < 0.7:
            y = side * (settings.road_width_m / 2 + rng.uniform(0.6, 1.2))
            parts.append(_tree(rng).moved((x + rng.uniform(-3, 3), y, KERB_HEIGHT_M)))
    return parts


def _tree(rng: Generator) -> Mesh:
    """Trunk, a few boughs, and clusters of loose leaves: small quads facing anywhere, with air between."""
    height, crown = rng.uniform(5.0, 10.0), rng.uniform(1.4, 2.6)
    centre = np.array([0.0, 0.0, height - crown])
    clusters = centre + _in_ball(rng, int(rng.integers(20, 40))) * [crown, crown, crown * 1.2]
    parts = [rod((0, 0, 0), centre, rng.uniform(0.08, 0.16), "bark")]
    parts += [rod(centre - [0, 0, 0.8], tip, 0.03, "bark", sides=4) for tip in clusters[:8]]
    leaves = np.repeat(clusters, 70, axis=0)
    leaves = leaves + rng.normal(0, 0.28, leaves.shape)
    half = rng.uniform(0.03, 0.07, (len(leaves), 1))
    across = rng.normal(size=leaves.shape)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(across, rng.normal(size=leaves.shape))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    u, v = half * across, half * along
    parts.append(quads(np.stack([leaves - u - v, leaves + u - v, leaves + u + v, leaves - u + v], axis=1), "leaf"))
    return merge(parts)


def _in_ball(rng: Generator, count: int) -> Array64:
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * rng.uniform(size=(count, 1)) ** (1 / 3)


def _poles_and_wires(settings: SceneSettings, rng: Generator) -> list[Mesh]:
    """Lamp poles with half-metre heads over the road on one side, and a sagging wire along them and across."""
    parts: list[Mesh] = []
    side = float(rng.choice([-1, 1]))
    y = side * (settings.road_width_m / 2 + 0.5)
    height = rng.uniform(6.5, 9.0)
    reach = y - side * rng.uniform(0.8, 1.8)
    xs = np.arange(-120.0 + rng.uniform(0, settings.pole_spacing_m), 120.0, settings.pole_spacing_m)
    for x in xs:
        head = (x - 0.25, reach - 0.13, height), (x + 0.25, reach + 0.13, height + 0.12)
        parts += [
            rod((x, y, 0), (x, y, height), 0.08, "metal"),
            rod((x, y, height), (x, reach, height + 0.1), 0.03, "metal"),
            box(*head, "metal"),
        ]
    ends = np.column_stack([xs, np.full(len(xs), y), np.full(len(xs), height - 0.4)])
    for a, b in pairwise(ends):
        parts += _wire(a, b)
    for x in rng.uniform(-60, 60, 3):
        wall = settings.road_width_m / 2 + settings.pavement_width_m
        parts += _wire(np.array([x, -wall, 5.8]), np.array([x, wall, 5.8]))
    return parts


def _wire(start_m: Array64, end_m: Array64) -> list[Mesh]:
    """A 16 mm wire hanging 1.5 % of its length."""
    t = np.linspace(0, 1, 9)[:, None]
    points = start_m + t * (end_m - start_m)
    points[:, 2] -= 4 * 0.015 * np.linalg.norm(end_m - start_m) * (t * (1 - t))[:, 0]
    return [rod(a, b, 0.008, "wire", sides=3) for a, b in pairwise(points)]


def _cars(settings: SceneSettings, side: int, rng: Generator) -> list[Mesh]:
    y = side * (settings.road_width_m / 2 - 1.0)
    places = [x for x in np.arange(-95.0, 95.0, 6.0) if abs(x) > 6.0]  # none on top of the vehicle
    return [_car(rng).moved((x, y, 0)) for x in places if rng.uniform() < settings.parked_cars]


def _car(rng: Generator) -> Mesh:
    length, height = rng.uniform(3.8, 4.8), rng.uniform(1.4, 1.8)
    paint = str(rng.choice(["paint_dark", "paint_light"]))
    parts = [
        box((-length / 2, -0.88, 0.25), (length / 2, 0.88, 0.85), paint),
        box((-length / 2 + 0.3, -0.8, 0.85), (length / 2 - 1.2, 0.8, height - 0.05), "glass", taper=0.2),
        box((-length / 2 + 0.6, -0.65, height - 0.05), (length / 2 - 1.5, 0.65, height), paint),
    ]
    for x in (-0.3 * length, 0.3 * length):
        parts += [rod((x, y - 0.1, 0.3), (x, y + 0.1, 0.3), 0.3, "rubber", sides=10) for y in (-0.8, 0.8)]
    return merge(parts)
