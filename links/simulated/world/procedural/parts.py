"""Parts of scenes: buildings with recessed windows, trees, cars, lamp poles, wires, road marks.

Source: ours. Everything rests on z = 0 at the origin unless stated otherwise.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.random import Generator

from links.simulated.world.mesh import Mesh, box, merge, quads, rod
from stages.geometry.frames import Array64, rotation_z

LEAST_M = 1e-6  # shortest part
MARK_ABOVE_M = 0.004  # height of marks above the road, so that rays hit them first


def building(width_m: float, depth_m: float, height_m: float, surface: str, rng: Generator) -> Mesh:
    """One building: front at y = 0 (facing -y), x from 0 to width, with cornice, parapet and chimneys."""
    floors = max(1, int(height_m // rng.uniform(2.9, 3.6)))
    recess = rng.uniform(0.08, 0.25)
    front = facade(width_m, height_m, floors, recess, surface, rng)
    left = facade(depth_m, height_m, floors, recess, surface, rng).moved(rotation=rotation_z(-np.pi / 2))
    right = facade(depth_m, height_m, floors, recess, surface, rng).moved(rotation=rotation_z(np.pi / 2))
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


def facade(width_m: float, height_m: float, floors: int, recess_m: float, surface: str, rng: Generator) -> Mesh:
    """A wall in the plane y = 0 facing -y, one row of recessed windows per floor; the glass is at y = recess."""
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
        wall += [upright(0.0, width_m, floor * storey, z0), upright(0.0, width_m, z1, top)]
        wall += [upright(a, b, z0, z1) for a, b in zip(wall_x0, wall_x1, strict=True)]
        for a, b in zip(x0, x1, strict=True):
            outer, inner = upright(a, b, z0, z1), upright(a, b, z0, z1, recess_m)
            glass.append(inner)
            for i in range(4):
                j = (i + 1) % 4
                wall.append(np.array([outer[i], outer[j], inner[j], inner[i]]))
    return merge([quads(np.array(wall), surface), quads(np.array(glass), "glass")])


def upright(x0: float, x1: float, z0: float, z1: float, y: float = 0.0) -> Array64:
    return np.array([(x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1)])


def tree(rng: Generator) -> Mesh:
    """Trunk, a few boughs, and clusters of loose leaves: small quads of random orientation with gaps between."""
    height, crown = rng.uniform(5.0, 10.0), rng.uniform(1.4, 2.6)
    centre = np.array([0.0, 0.0, height - crown])
    clusters = centre + in_ball(rng, int(rng.integers(20, 40))) * [crown, crown, crown * 1.2]
    parts = [rod((0, 0, 0), centre, rng.uniform(0.08, 0.16), "bark")]
    parts += [rod(centre - [0, 0, 0.8], tip, 0.03, "bark", sides=4) for tip in clusters[:8]]
    middle = np.repeat(clusters, 70, axis=0)
    parts.append(leaves(middle + rng.normal(0, 0.28, middle.shape), rng))
    return merge(parts)


def leaves(middle_m: Array64, rng: Generator) -> Mesh:
    """A small quad of random orientation at each position (n, 3)."""
    half = rng.uniform(0.03, 0.07, (len(middle_m), 1))
    across = rng.normal(size=middle_m.shape)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(across, rng.normal(size=middle_m.shape))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    u, v = half * across, half * along
    return quads(np.stack([middle_m - u - v, middle_m + u - v, middle_m + u + v, middle_m - u + v], axis=1), "leaf")


def in_ball(rng: Generator, count: int) -> Array64:
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * rng.uniform(size=(count, 1)) ** (1 / 3)


def wire(start_m: Array64, end_m: Array64) -> list[Mesh]:
    """A 16 mm wire with a sag of 1.5 % of its length."""
    t = np.linspace(0, 1, 9)[:, None]
    points = start_m + t * (end_m - start_m)
    points[:, 2] -= 4 * 0.015 * np.linalg.norm(end_m - start_m) * (t * (1 - t))[:, 0]
    return [rod(a, b, 0.008, "wire", sides=3) for a, b in pairwise(points)]


def car(rng: Generator) -> Mesh:
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


def lamp_pole(height_m: float, reach_m: float) -> list[Mesh]:
    """A pole at the origin whose arm holds a half-metre lamp head `reach_m` along y."""
    head = (-0.25, reach_m - 0.13, height_m), (0.25, reach_m + 0.13, height_m + 0.12)
    return [
        rod((0, 0, 0), (0, 0, height_m), 0.08, "metal"),
        rod((0, 0, height_m), (0, reach_m, height_m + 0.1), 0.03, "metal"),
        box(*head, "metal"),
    ]


def strip(start_m: tuple[float, float], end_m: tuple[float, float], width_m: float, surface: str, z_m: float) -> Mesh:
    """A flat strip along a line."""
    a, b = np.array(start_m), np.array(end_m)
    along = (b - a) / np.linalg.norm(b - a)
    side = np.array([-along[1], along[0]]) * width_m / 2
    corners = [a - side, b - side, b + side, a + side]
    return quads([[(x, y, z_m) for x, y in corners]], surface)


def dashes(start_m: tuple[float, float], end_m: tuple[float, float], z_m: float = MARK_ABOVE_M) -> list[Mesh]:
    """A dashed lane line: 0.12 m wide, dashes of 3 m, gaps of 6 m."""
    a, b = np.array(start_m), np.array(end_m)
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length
    return [
        strip(tuple(a + s * along), tuple(a + min(s + 3.0, length) * along), 0.12, "marking", z_m)
        for s in np.arange(0.0, length - LEAST_M, 9.0)
    ]


def building_row(width_m: float, depth_m: float, heights_m: tuple[float, float], rng: Generator) -> Mesh:
    """Terraced buildings, front on y = 0 facing -y, from x = 0 to the width."""
    parts: list[Mesh] = []
    x = 0.0
    while width_m - x > LEAST_M:  # ignores a remainder from rounding
        width = min(rng.uniform(10, 24), width_m - x)
        width = width_m - x if width_m - x - width < 6 else width
        surface = str(rng.choice(["brick", "plaster", "concrete"]))
        parts.append(building(width, depth_m, rng.uniform(*heights_m), surface, rng).moved((x, 0, 0)))
        x += width
    return merge(parts)


def plain(x_m: tuple[float, float], y_m: tuple[float, float], surface: str, z_m: float = 0.0) -> Mesh:
    """A level rectangle."""
    (x0, x1), (y0, y1) = x_m, y_m
    return quads([[(x0, y0, z_m), (x1, y0, z_m), (x1, y1, z_m), (x0, y1, z_m)]], surface)


def grove(positions_m: Array64, z_m: float, rng: Generator, kinds: int = 8) -> list[Mesh]:
    """Trees at positions (n, 2): a few kinds, each with a random yaw."""
    grown = [tree(rng) for _ in range(min(kinds, len(positions_m)))]
    return [
        grown[i % len(grown)].moved((x, y, z_m), rotation_z(rng.uniform(0, 2 * np.pi)))
        for i, (x, y) in enumerate(positions_m)
    ]


def hedge(start_m: tuple[float, float], end_m: tuple[float, float], rng: Generator) -> Mesh:
    """Leaves up to about a metre high along a line, with gaps between."""
    a, b = np.array([*start_m, 0.0]), np.array([*end_m, 0.0])
    count = int(220 * np.linalg.norm(b - a))
    middle = a + rng.uniform(size=(count, 1)) * (b - a) + rng.uniform((-0.3, -0.3, 0.05), (0.3, 0.3, 1.1), (count, 3))
    return leaves(middle, rng)


def scattered(
    rng: Generator, count: int, x_m: tuple[float, float], y_m: tuple[float, float], spacing_m: float
) -> Array64:
    """Up to `count` positions (n, 2) in a rectangle, at least `spacing_m` from each other."""
    positions: list[Array64] = []
    for position in rng.uniform((x_m[0], y_m[0]), (x_m[1], y_m[1]), (20 * count, 2)):
        if len(positions) < count and all(np.hypot(*(position - other)) >= spacing_m for other in positions):
            positions.append(position)
    return np.array(positions).reshape(-1, 2)
