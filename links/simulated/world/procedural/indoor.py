"""A closed room with tables and shelves, like those of the real captures; not a scene for drones.

Source: ours.
"""

from __future__ import annotations

import numpy as np

from links.simulated.world.mesh import Mesh, box, merge

LENGTH_M, WIDTH_M, HEIGHT_M = 12.0, 6.0, 2.7


def indoor_mesh(sensor_height_m: float, seed: int) -> Mesh:
    """The room around a sensor at the origin, its floor `sensor_height_m` below."""
    rng = np.random.default_rng([seed, 1])
    x, y = LENGTH_M / 2, WIDTH_M / 2
    parts = [
        box((-x, -y, 0.0), (x, y, HEIGHT_M), "plaster"),
        box((-1.5, y - 0.05, 1.0), (1.5, y - 0.02, 2.2), "glass"),
        box((x - 0.15, -1.0, 0.0), (x - 0.02, 0.0, 2.1), "paint_light"),  # a door
    ]
    for position in ((-4.0, 1.9), (-1.4, -1.6), (1.6, 1.5), (4.2, -1.6)):
        size = np.array([rng.uniform(0.5, 0.9), rng.uniform(0.35, 0.5)])
        low, high = position - size, position + size
        parts.append(box((*low, 0.70), (*high, 0.74), "paving"))
        legs = [(a, b) for a in (low[0], high[0]) for b in (low[1], high[1])]
        parts += [box((a - 0.03, b - 0.03, 0), (a + 0.03, b + 0.03, 0.7), "metal") for a, b in legs]
    for side in (-1, 1):
        for start in rng.uniform(-5, 3.5, 2):
            parts.append(box((start, side * y - 0.4, 0), (start + 1.2, side * y + 0.4, rng.uniform(1.2, 2.2)), "bark"))
    return merge(parts).moved((0, 0, -sensor_height_m))
