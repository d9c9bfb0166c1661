"""A street whose blocks are rotated by odd angles: several pairs of horizontal directions instead of one.

Source: ours; "Atlanta world" as Schindler and Dellaert, CVPR 2004.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from links.simulated.world.mesh import Mesh, box
from links.simulated.world.procedural.parts import building_row, dashes, grove
from links.simulated.world.procedural.settings import HALF_LENGTH_M, KERB_HEIGHT_M, SceneSettings, VehicleCorridor
from links.simulated.world.procedural.street import ground, parked_cars, poles_and_wires, road_marks, with_parking
from stages.geometry.frames import Array64, rotation_z

FAMILIES = 4
MIN_SEPARATION_DEG = 14.0  # between two families, and between a family and the road


def atlanta(settings: SceneSettings, corridor: VehicleCorridor, rng: Generator) -> list[Mesh]:
    """One road with kerbs and marks; along it, blocks of buildings, each rotated by one of a few odd angles."""
    wide = with_parking(settings)
    front = wide.road_width_m / 2 + wide.pavement_width_m
    turns = odd_angles_deg(rng)
    parts = [ground(wide), *road_marks(settings, rng), *poles_and_wires(wide, rng)]
    for side in (-1, 1):
        parts += parked_cars(wide, side, corridor, rng)
        x = -HALF_LENGTH_M + 20.0 + rng.uniform(0, 10)
        while x < HALF_LENGTH_M - 20.0:
            turn = np.radians(float(rng.choice(turns)))
            width, depth = rng.uniform(18, 42), rng.uniform(10, 14)
            row = building_row(width, depth, settings.building_height_m, rng)
            block, (low, high) = _rotated(row, turn + (np.pi if side < 0 else 0.0))
            y = front + rng.uniform(0.3, 2.5) - low[1] if side > 0 else -front - rng.uniform(0.3, 2.5) - high[1]
            parts.append(block.moved((x - low[0], y, KERB_HEIGHT_M)))
            corner = (x + high[0] - low[0] + 3.0, side * front)
            end = np.array(corner) + 45 * np.array([-side * np.sin(turn), side * np.cos(turn)])
            parts += dashes(corner, (float(end[0]), float(end[1])), KERB_HEIGHT_M + 0.004)  # lane between blocks
            x += high[0] - low[0] + rng.uniform(3, 8)
        for x in np.arange(-120, 120, 34.0):  # second row
            width, height = rng.uniform(15, 28), rng.uniform(10, 30)
            turn = np.radians(float(rng.choice(turns)))
            far, _ = _rotated(box((-width / 2, -7, 0), (width / 2, 7, height), "concrete"), turn)
            parts.append(far.moved((x + rng.uniform(-4, 4), side * (front + rng.uniform(58, 72)), 0)))
        row = np.arange(-90.0, 90.0, settings.tree_spacing_m)
        y = np.full(len(row), side * (wide.road_width_m / 2 + 0.9))
        positions = np.column_stack([row + rng.uniform(-3, 3, len(row)), y])
        parts += grove(positions[rng.uniform(size=len(row)) < 0.6], KERB_HEIGHT_M, rng)
    return parts


def odd_angles_deg(rng: Generator) -> Array64:
    """Angles between -45 and 45 deg, separated from each other (modulo 90) and from the road's 0."""
    while True:
        angles = rng.uniform(-45, 45, FAMILIES)
        folded = np.sort(np.append(angles, 0.0))
        if np.min(np.diff(np.append(folded, folded[0] + 90.0))) >= MIN_SEPARATION_DEG:
            return angles


def _rotated(mesh: Mesh, turn_rad: float) -> tuple[Mesh, tuple[Array64, Array64]]:
    rotated = mesh.moved(rotation=rotation_z(turn_rad))
    return rotated, (rotated.vertices_m.min(axis=0), rotated.vertices_m.max(axis=0))
