"""A straight street between two rows of buildings: `street` is plain, `manhattan` has parking, marks and crossings.

Source: ours. Scene frame: road axis along x, z = 0 on the carriageway.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.random import Generator

from links.simulated.world.mesh import Mesh, box, merge, quads
from links.simulated.world.procedural.parts import MARK_ABOVE_M, building, car, dashes, lamp_pole, strip, tree, wire
from links.simulated.world.procedural.settings import HALF_LENGTH_M, KERB_HEIGHT_M, SceneSettings, VehicleCorridor
from stages.geometry.frames import rotation_z

PARKING_M = 2.2  # width of the parking lane on each side


def street(settings: SceneSettings, corridor: VehicleCorridor, rng: Generator) -> list[Mesh]:
    """The plain street; cars park at the edge of the carriageway."""
    parts = [ground(settings)]
    for side in (-1, 1):
        parts += _buildings(settings, side, rng)
        parts += _trees(settings, side, rng)
        parts += parked_cars(settings, side, corridor, rng)
    return parts + poles_and_wires(settings, rng)


def manhattan(settings: SceneSettings, corridor: VehicleCorridor, rng: Generator) -> list[Mesh]:
    """The street with a parking lane on each side and marks on the road."""
    return [*street(with_parking(settings), corridor, rng), *road_marks(settings, rng)]


def with_parking(settings: SceneSettings) -> SceneSettings:
    """The same street with its kerbs moved outwards for two parking lanes."""
    return settings.model_copy(update={"road_width_m": settings.road_width_m + 2 * PARKING_M})


def road_marks(settings: SceneSettings, rng: Generator) -> list[Mesh]:
    """Centre line, edge lines, and zebra crossings."""
    half, far = settings.road_width_m / 2, HALF_LENGTH_M
    parts = dashes((-far, 0.0), (far, 0.0))
    parts += [strip((-far, y), (far, y), 0.12, "marking", MARK_ABOVE_M) for y in (-half, half)]
    for x in rng.uniform(-60, 60, 2):
        bars = np.arange(-half + 0.5, half - 0.4, 1.0)
        parts += [strip((x, y), (x + 4.0, y), 0.5, "marking", 1.5 * MARK_ABOVE_M) for y in bars]
    return parts


def ground(settings: SceneSettings) -> Mesh:
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


def _buildings(settings: SceneSettings, side: int, rng: Generator) -> list[Mesh]:
    parts: list[Mesh] = []
    front = settings.road_width_m / 2 + settings.pavement_width_m
    x = -HALF_LENGTH_M + rng.uniform(0, 10)
    while x < HALF_LENGTH_M:
        width, depth = rng.uniform(10, 28), rng.uniform(10, 14)
        height = rng.uniform(*settings.building_height_m)
        set_back = rng.choice([0.0, 0.0, rng.uniform(0.3, 2.5)])
        surface = str(rng.choice(["brick", "plaster", "concrete"]))
        block = building(width, depth, height, surface, rng)
        if side < 0:
            block = block.moved(rotation=rotation_z(np.pi)).moved((width, 0, 0))
        parts.append(block.moved((x, side * (front + set_back), KERB_HEIGHT_M)))
        x += width + (rng.uniform(4, 10) if rng.uniform() < settings.side_streets else 0.0)
    x = -HALF_LENGTH_M
    while x < HALF_LENGTH_M:  # second row, visible through the gaps
        width, height, y = rng.uniform(12, 30), rng.uniform(8, 30), front + rng.uniform(28, 40)
        parts.append(
            box((x, min(side * y, side * (y + 12)), 0), (x + width, max(side * y, side * (y + 12)), height), "concrete")
        )
        x += width + rng.uniform(0, 6)
    return parts


def _trees(settings: SceneSettings, side: int, rng: Generator) -> list[Mesh]:
    parts: list[Mesh] = []
    for x in np.arange(-100.0, 100.0, settings.tree_spacing_m):
        if rng.uniform() < 0.7:
            y = side * (settings.road_width_m / 2 + rng.uniform(0.6, 1.2))
            parts.append(tree(rng).moved((x + rng.uniform(-3, 3), y, KERB_HEIGHT_M)))
    return parts


def poles_and_wires(settings: SceneSettings, rng: Generator) -> list[Mesh]:
    """Lamp poles with half-metre heads over the road on one side, and sagging wires along them and across."""
    parts: list[Mesh] = []
    side = float(rng.choice([-1, 1]))
    y = side * (settings.road_width_m / 2 + 0.5)
    height = rng.uniform(6.5, 9.0)
    reach = y - side * rng.uniform(0.8, 1.8)
    xs = np.arange(-120.0 + rng.uniform(0, settings.pole_spacing_m), 120.0, settings.pole_spacing_m)
    for x in xs:
        parts += [part.moved((x, y, 0)) for part in lamp_pole(height, reach - y)]
    ends = np.column_stack([xs, np.full(len(xs), y), np.full(len(xs), height - 0.4)])
    for a, b in pairwise(ends):
        parts += wire(a, b)
    for x in rng.uniform(-60, 60, 3):
        wall = settings.road_width_m / 2 + settings.pavement_width_m
        parts += wire(np.array([x, -wall, 5.8]), np.array([x, wall, 5.8]))
    return parts


def parked_cars(settings: SceneSettings, side: int, corridor: VehicleCorridor, rng: Generator) -> list[Mesh]:
    """Parked cars along the kerb, clear of the vehicle."""
    y = side * (settings.road_width_m / 2 - 1.0)
    positions = [x for x in np.arange(-95.0, 95.0, 6.0) if abs(x) > 6.0]
    cars = [(x, car(rng)) for x in positions if rng.uniform() < settings.parked_cars]
    return [parked.moved((x, y, 0)) for x, parked in cars if corridor.allows(np.array([x - 1.5, x, x + 1.5]), y, 0.95)]
