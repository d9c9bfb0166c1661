"""Scenes with much open sky: a campus, a street along a park, an open lot.

Source: ours. Scene frame: the vehicle's road along x, z = 0 on it.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.random import Generator

from links.simulated.world.mesh import Mesh, box, rod
from links.simulated.world.procedural.parts import (
    MARK_ABOVE_M,
    building,
    car,
    dashes,
    grove,
    hedge,
    lamp_pole,
    plain,
    scattered,
    strip,
)
from links.simulated.world.procedural.settings import HALF_LENGTH_M, KERB_HEIGHT_M, SceneSettings, VehicleCorridor
from links.simulated.world.procedural.street import ground, parked_cars, poles_and_wires, road_marks, with_parking
from stages.geometry.frames import Array64, rotation_z

FAR = (-HALF_LENGTH_M, HALF_LENGTH_M)


def campus(settings: SceneSettings, corridor: VehicleCorridor, rng: Generator) -> list[Mesh]:
    """Large, widely spaced buildings in two directions; lawns, footpaths, trees, lamps."""
    half = settings.road_width_m / 2
    parts = [plain(FAR, (-half, half), "asphalt"), *dashes((-HALF_LENGTH_M, 0), (HALF_LENGTH_M, 0))]
    for side in (-1, 1):
        parts.append(plain(FAR, _between(side * half, side * HALF_LENGTH_M), "grass", 0.02))
        path_y = side * (half + 4.0)
        parts.append(strip((-HALF_LENGTH_M, path_y), (HALF_LENGTH_M, path_y), 2.5, "paving", 0.03))
    tilt = rng.uniform(20, 40)
    taken: list[Array64] = []
    for position in scattered(rng, 9, (-95, 95), (-75, 75), 46.0):
        width, depth, height = rng.uniform(25, 44), rng.uniform(14, 20), rng.uniform(9, 18)
        reach = np.hypot(width, depth) / 2
        y = position[1] if abs(position[1]) > reach + half + 7 else np.copysign(reach + half + 7, position[1])
        if any(np.hypot(position[0] - x, y - v) < reach + r + 4 for x, v, r in taken):
            continue
        taken.append(np.array([position[0], y, reach]))
        turn = rotation_z(np.radians(float(rng.choice([0.0, tilt])) + (180.0 if y < 0 else 0.0)))  # faces the road
        block = building(width, depth, height, str(rng.choice(["concrete", "brick"])), rng)
        parts.append(block.moved((-width / 2, -depth / 2, 0)).moved((position[0], y, 0), turn))
        parts.append(strip((position[0], y), (position[0], np.sign(y) * half), 2.0, "paving", 0.035))
    positions = scattered(rng, 45, (-85, 85), (-60, 60), 6.0)
    free = [p for p in positions if abs(p[1]) > half + 6 and all(np.hypot(*(p - t[:2])) > t[2] + 2 for t in taken)]
    parts += grove(np.array(free).reshape(-1, 2), 0.0, rng)
    for x in np.arange(-90, 91, settings.pole_spacing_m):
        parts += [p.moved((x, half + 2.2, 0)) for p in lamp_pole(rng.uniform(4.5, 6.0), 0.4)]
    return parts


def park_edge(settings: SceneSettings, corridor: VehicleCorridor, rng: Generator) -> list[Mesh]:
    """Trees, hedges and lawn on one side, a few detached buildings on the other: hardly any straight line."""
    wide = with_parking(settings)
    half = wide.road_width_m / 2
    front = half + wide.pavement_width_m
    parts = [ground(wide), *road_marks(settings, rng), *poles_and_wires(wide, rng)]
    park = float(rng.choice([-1, 1]))
    parts += parked_cars(wide, int(-park), corridor, rng)
    parts.append(plain(FAR, _between(park * front, park * HALF_LENGTH_M), "grass", KERB_HEIGHT_M + 0.01))
    for x in np.arange(-75.0, 76.0, 50.0):
        block = building(rng.uniform(10, 14), rng.uniform(9, 12), rng.uniform(5, 8), "plaster", rng)
        turn = rotation_z(np.radians(rng.uniform(-8, 8)) + (0.0 if park < 0 else np.pi))
        position = x + rng.uniform(-12, 12), -park * (front + rng.uniform(10, 16)), KERB_HEIGHT_M
        parts.append(block.moved(position, turn))
    wood = scattered(rng, 55, (-80, 80), _between(park * (front + 1.5), park * (front + 50)), 4.5)
    garden = scattered(rng, 14, (-80, 80), _between(-park * (front + 1.0), -park * (front + 8)), 6.0)
    parts += grove(np.vstack([wood, garden]), KERB_HEIGHT_M, rng)
    for x in np.arange(-60.0, 60.0, 20.0):
        y = park * (front + 0.8)
        parts.append(hedge((x, y), (x + rng.uniform(8, 18), y), rng).moved((0, 0, KERB_HEIGHT_M)))
    return parts


def open_lot(settings: SceneSettings, corridor: VehicleCorridor, rng: Generator) -> list[Mesh]:
    """Asphalt with parking bays, some cars, tall lamps and a fence; distant buildings."""
    parts = [plain(FAR, FAR, "asphalt")]
    for row in np.arange(-48.0, 49.0, 16.0):
        y = row + 8.0 + settings.vehicle_lane_y_m  # the vehicle starts between two rows
        parts.append(strip((-50, y), (50, y), 0.12, "marking", MARK_ABOVE_M))
        for x in np.arange(-50.0, 51.0, 2.5):
            parts.append(strip((x, y - 5.0), (x, y + 5.0), 0.10, "marking", 1.5 * MARK_ABOVE_M))
            for side in (-1, 1):
                if rng.uniform() < 0.4 * settings.parked_cars:
                    position = (x + 1.25, y + side * 2.5)
                    parked = car(rng).moved((*position, 0), rotation_z(np.pi / 2))
                    if corridor.allows(*position, 2.4):
                        parts.append(parked)
    for x in np.arange(-48.75, 50, 32.5):
        for y in (-24.0, 24.0):
            position = (float(x), y + 0.1 + settings.vehicle_lane_y_m)
            if corridor.allows(*position, 0.3):
                parts += [p.moved((*position, 0)) for p in lamp_pole(10.0, 1.0)]
    fence = np.array([(-62.0, -62.0), (62.0, -62.0), (62.0, 62.0), (-62.0, 62.0), (-62.0, -62.0)])
    for a, b in pairwise(fence):
        for share in np.linspace(0, 1, 42)[:-1]:
            x, y = a + share * (b - a)
            parts.append(rod((x, y, 0), (x, y, 1.8), 0.025, "metal", sides=3))
        parts += [rod((*a, z), (*b, z), 0.012, "wire", sides=3) for z in (0.4, 1.0, 1.6)]
    for angle in np.radians(np.arange(0, 360, 45) + rng.uniform(-8, 8, 8)):
        offset = rng.uniform(90, 120)
        size = rng.uniform(10, 30), rng.uniform(8, 14), rng.uniform(5, 12)
        block = box((-size[0] / 2, 0, 0), (size[0] / 2, size[1], size[2]), "concrete")
        parts.append(block.moved((offset * np.cos(angle), offset * np.sin(angle), 0), rotation_z(angle - np.pi / 2)))
    parts += grove(scattered(rng, 10, (-75, 75), (64, 80), 6.0), 0.0, rng)
    return parts


def _between(a_m: float, b_m: float) -> tuple[float, float]:
    return min(a_m, b_m), max(a_m, b_m)
