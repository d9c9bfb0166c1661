"""Clutter of built-up scenes: furniture, planters, signs, boards and banners at odd angles, climbing plants, people.

Source: ours; walking speed: Bohannon, Age and Ageing 26 (1997) 15 (1.2 to 1.5 m/s). Everything static stands on the
pavements, clear of the vehicle's corridor, or hangs at 2.2 to 7 m over them; oblique wires cross the road at 3.8 to
5.4 m, with a sag of 1.5 % of their length. The clutter has random numbers of its own: the rest of a scene is the same
with and without it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from links.simulated.kernels.motion import rotations_z
from links.simulated.world.mesh import Mesh, box, merge, quads, rod
from links.simulated.world.procedural.parts import hedge, in_ball, leaves, wire
from links.simulated.world.procedural.settings import KERB_HEIGHT_M, SceneSettings, VehicleCorridor
from stages.geometry.frames import Array64, rotation_from_rpy_deg, rotation_z

REACH_M = 45.0  # of the clutter along the road, each way
PER_100_M2 = 7.0  # static objects on the pavements
OBLIQUE_WIRES = 8
PEOPLE = 16
WALLED = ("street", "manhattan", "atlanta")  # with a wall behind the pavement, for plates to hang on
GAIT_STEPS = 4
GAIT_HZ = 0.9  # full cycles of two steps


def clutter(settings: SceneSettings, corridor: VehicleCorridor, rng: Generator) -> list[Mesh]:
    """Static clutter on both pavements, scene frame."""
    low, high = _pavement_m(settings)
    parts: list[Mesh] = []
    objects = (_table_and_chairs, _bench, _crates, _planter, _sign, _sign, _board, _awning, _climber, _bicycle)
    for side in (-1.0, 1.0):
        for _ in range(round(PER_100_M2 * 2 * REACH_M * (high - low) / 100.0)):
            x, y = rng.uniform(-REACH_M, REACH_M), side * rng.uniform(low, high)
            made = objects[rng.integers(len(objects))](rng)
            radius_m = float(np.hypot(*made.vertices_m[:, :2].T).max())
            turned = made.moved((x, y, KERB_HEIGHT_M), rotation_z(rng.uniform(0, 2 * np.pi)))
            if corridor.allows(x, y, radius_m):
                parts.append(turned)
            if settings.kind in WALLED and rng.uniform() < 0.4:
                at = rng.uniform(-REACH_M, REACH_M), side * (high + 0.5), rng.uniform(2.8, 7.0)
                parts.append(_hung(rng).moved(at, rotation_z(rng.normal(0, 0.6))))
        x = rng.uniform(-REACH_M, REACH_M)
        if corridor.allows(np.linspace(x, x + 6.0, 7), side * low, 0.5):
            parts.append(hedge((x, side * low), (x + 6.0, side * (low + 0.4)), rng).moved((0, 0, KERB_HEIGHT_M)))
    for x in rng.uniform(-REACH_M, REACH_M, OBLIQUE_WIRES):
        away, z = rng.uniform(-14, 14), rng.uniform(3.8, 5.4, 2)
        parts += wire(np.array([x, -high - 0.8, z[0]]), np.array([x + away, high + 0.8, z[1]]))
    return parts


def _pavement_m(settings: SceneSettings) -> tuple[float, float]:
    """Distance of both edges of a pavement from the road's axis, with a margin; parking lanes count as road."""
    parking = 0.0 if settings.kind == "street" else 2.2
    inner = settings.road_width_m / 2 + parking + 0.5
    return inner, inner + settings.pavement_width_m - 0.8


def _table_and_chairs(rng: Generator) -> Mesh:
    """A table with a parasol or without, and chairs around it, each at its own angle."""
    size = rng.uniform(0.35, 0.5)
    parts = [box((-size, -size, 0.70), (size, size, 0.74), "bark"), rod((0, 0, 0), (0, 0, 0.7), 0.04, "metal")]
    for angle in np.radians(np.arange(0, 360, 90) + rng.uniform(-25, 25, 4)):
        seat = merge(
            [box((-0.2, -0.2, 0.42), (0.2, 0.2, 0.46), "metal"), box((0.16, -0.2, 0.46), (0.2, 0.2, 0.9), "bark")]
        )
        legs = merge([rod((x, y, 0), (x, y, 0.42), 0.015, "metal", 3) for x in (-0.18, 0.18) for y in (-0.18, 0.18)])
        at = 0.85 * np.array([np.cos(angle), np.sin(angle), 0.0])
        parts.append(merge([seat, legs]).moved(at, rotation_z(angle + rng.uniform(-0.5, 0.5))))
    if rng.uniform() < 0.6:
        cloth = box((-1.1, -1.1, 2.1), (1.1, 1.1, 2.5), "print", taper=0.95)
        parts += [rod((0, 0, 0.7), (0, 0, 2.4), 0.03, "metal"), cloth]
    return merge(parts)


def _bench(rng: Generator) -> Mesh:
    slats = [box((-0.8, y, 0.44), (0.8, y + 0.09, 0.47), "bark") for y in (-0.22, -0.1, 0.02, 0.14)]
    back = [box((-0.8, 0.25, z), (0.8, 0.28, z + 0.1), "bark") for z in (0.6, 0.75)]
    feet = [box((x, -0.22, 0), (x + 0.05, 0.26, 0.44), "metal") for x in (-0.7, 0.65)]
    return merge([*slats, *back, *feet])


def _crates(rng: Generator) -> Mesh:
    """A pile of boxes and bins, none parallel to another."""
    parts: list[Mesh] = []
    height = 0.0
    for size in np.sort(rng.uniform(0.3, 0.7, rng.integers(2, 5)))[::-1]:
        surface = str(rng.choice(["print", "bark", "paint_dark", "paint_light"]))
        block = box((-size / 2, -size / 2.6, 0), (size / 2, size / 2.6, 0.6 * size), surface)
        parts.append(block.moved((rng.normal(0, 0.05), rng.normal(0, 0.05), height), rotation_z(rng.uniform(0, 3))))
        height += 0.6 * size
    return merge(parts)


def _planter(rng: Generator) -> Mesh:
    tub = box((-0.4, -0.3, 0), (0.4, 0.3, 0.5), "concrete", taper=-0.1)
    green = np.array([0, 0, 0.8]) + in_ball(rng, 260) * [0.5, 0.4, 0.45]
    return merge([tub, leaves(green, rng)])


def _tilted(mesh: Mesh, rng: Generator, sigma_deg: float, up_m: float) -> Mesh:
    """The mesh tilted about its origin, then raised."""
    roll, pitch = rng.normal(0, sigma_deg, 2)
    return mesh.moved((0, 0, up_m), rotation_from_rpy_deg((float(roll), float(pitch), 0.0)))


def _sign(rng: Generator) -> Mesh:
    """A pole, out of plumb, with one or two printed plates turned against it."""
    parts = [rod((0, 0, -2.5), (0, 0, 0.9), 0.03, "metal")]
    for k in range(rng.integers(1, 3)):
        half, high = rng.uniform(0.25, 0.6), rng.uniform(0.25, 0.45)
        plate = merge([box((-half, 0.04, -high), (half, 0.06, high), "print"), _frame(half, high)])
        parts.append(
            plate.moved((0, 0, 0.5 - 1.0 * k), rotation_from_rpy_deg((0, rng.normal(0, 6), rng.uniform(0, 360))))
        )
    return _tilted(merge(parts), rng, 3.0, 2.5)


def _frame(half: float, high: float) -> Mesh:
    corners = [(-half, 0.07, -high), (half, 0.07, -high), (half, 0.07, high), (-half, 0.07, high)]
    return merge([rod(corners[k - 1], corners[k], 0.02, "marking", 3) for k in range(4)])


def _board(rng: Generator) -> Mesh:
    """A hoarding of 2 to 3.5 m on two posts, leaning."""
    half, high = rng.uniform(1.0, 1.75), rng.uniform(0.6, 1.1)
    posts = [rod((x, 0, -1.6), (x, 0, high), 0.05, "bark") for x in (-0.7 * half, 0.7 * half)]
    return _tilted(merge([*posts, box((-half, 0.05, -high), (half, 0.1, high), "print")]), rng, 4.0, 1.6)


def _hung(rng: Generator) -> Mesh:
    """A printed plate in front of a wall, turned in its plane, or a bracket sign that sticks out of it."""
    half, high = rng.uniform(0.3, 1.4), rng.uniform(0.2, 0.6)
    if rng.uniform() < 0.5:
        plate = box((-half, -0.03, -high), (half, 0.0, high), "print")
        return plate.moved(rotation=rotation_from_rpy_deg((rng.normal(0, 3), rng.normal(0, 14), 0)))
    plate = box((0.1, -0.03, -high), (0.1 + half, 0.03, high), "print")
    return merge([plate, rod((0, 0, high), (0.1 + half, 0, high), 0.02, "metal", 4)]).moved(
        rotation=rotation_from_rpy_deg((rng.normal(0, 4), rng.normal(0, 5), 90 + rng.normal(0, 20)))
    )


def _awning(rng: Generator) -> Mesh:
    """A sloping cloth on two legs, or a banner that hangs askew between two poles."""
    half, drop = rng.uniform(0.8, 1.5), rng.uniform(0.3, 0.7)
    if rng.uniform() < 0.5:
        sheet = quads([[(-half, 0, 2.9), (half, 0, 2.9), (half, -1.2, 2.9 - drop), (-half, -1.2, 2.9 - drop)]], "print")
        legs = [
            rod((x, y, 0), (x, y, z), 0.02, "metal", 4)
            for x in (-half, half)
            for y, z in ((0, 2.9), (-1.2, 2.9 - drop))
        ]
        return merge([sheet, *legs])
    sag = rng.normal(0, 0.25)
    sheet = quads([[(-half, 0, 3.2), (half, 0, 3.2 + sag), (half, 0.1, 4.0 + sag), (-half, 0.1, 4.0)]], "print")
    return merge([sheet, *(rod((x, 0.05, 0), (x, 0.05, 4.1), 0.03, "metal", 4) for x in (-half, half))])


def _climber(rng: Generator) -> Mesh:
    """A column of leaves on a leaning stake."""
    green = np.array([0, 0, 1.4]) + in_ball(rng, 420) * [0.45, 0.45, 1.3]
    return _tilted(merge([rod((0, 0, 0), (0, 0, 2.8), 0.02, "bark", 3), leaves(green, rng)]), rng, 5.0, 0.0)


def _bicycle(rng: Generator) -> Mesh:
    turn = np.linspace(0, 2 * np.pi, 13)
    ring = [(0.33 * np.cos(a), 0.33 * np.sin(a)) for a in turn]
    wheels = [
        rod((x + a, 0, 0.33 + b), (x + c, 0, 0.33 + d), 0.02, "rubber", 3)
        for x in (-0.5, 0.5)
        for (a, b), (c, d) in pairwise(ring)
    ]
    tubes = [
        ((-0.5, 0.33), (-0.1, 0.85)),
        ((-0.1, 0.85), (0.4, 0.9)),
        ((0.4, 0.9), (0.5, 0.33)),
        ((-0.1, 0.4), (0.4, 0.85)),
    ]
    frame = [rod((a[0], 0, a[1]), (b[0], 0, b[1]), 0.02, "paint_dark", 3) for a, b in tubes]
    return _tilted(merge([*wheels, *frame]), rng, 6.0, 0.0)


@dataclass(frozen=True)
class Pedestrian:
    """Walks to and fro on a pavement, with a gait."""

    meshes: tuple[Mesh, ...]
    start_m: Array64  # (3,) world
    end_m: Array64
    speed_mps: float
    phase: float  # 0 to 1, of both walk and gait
    name: str = "person"
    small: bool = False

    def poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        """T_world_body at times (n,): rotations (n, 3, 3), positions (n, 3) [m]."""
        along = self.end_m - self.start_m
        length_m = float(np.linalg.norm(along))
        walked = np.mod(time_s * self.speed_mps / length_m + 2 * self.phase, 2.0)
        back = walked > 1.0
        share = np.where(back, 2.0 - walked, walked)
        yaw = np.arctan2(along[1], along[0]) + np.where(back, np.pi, 0.0)
        return rotations_z(yaw), self.start_m + share[:, None] * along

    def shape(self, time_s: Array64) -> NDArray[np.int64]:
        """Index into `meshes` at times (n,)."""
        return np.floor(np.mod(time_s * GAIT_HZ + self.phase, 1.0) * GAIT_STEPS).astype(np.int64)


def person_mesh(rng: Generator) -> tuple[Mesh, ...]:
    """A walking person of 1.5 to 1.9 m, `GAIT_STEPS` shapes; some carry a bag."""
    scale = rng.uniform(0.88, 1.12)
    coat, trousers = (str(rng.choice(["print", "paint_dark", "paint_light", "latex", "feather"])) for _ in range(2))
    bag = [box((-0.1, 0.28, 0.5), (0.25, 0.42, 0.9), "latex")] if rng.uniform() < 0.4 else []
    shapes: list[Mesh] = []
    for step in range(GAIT_STEPS):
        swing = 0.32 * np.sin(2 * np.pi * (step + 0.5) / GAIT_STEPS)
        legs = [rod((0, y, 0.88), (s * swing, y, 0.03), 0.075, trousers) for y, s in ((-0.1, 1), (0.1, -1))]
        arms = [rod((0, y, 1.4), (-s * swing, 1.15 * y, 0.85), 0.045, coat) for y, s in ((-0.24, 1), (0.24, -1))]
        torso = box((-0.13, -0.2, 0.85), (0.13, 0.2, 1.48), coat, taper=-0.12)
        head = box((-0.1, -0.08, 1.52), (0.1, 0.08, 1.76), "bark", taper=0.25)
        whole = merge([*legs, *arms, torso, head, *bag])
        shapes.append(Mesh(scale * whole.vertices_m, whole.faces, whole.surface))
    return tuple(shapes)


def people(
    settings: SceneSettings, corridor: VehicleCorridor, T_world_scene: tuple[Array64, Array64], rng: Generator
) -> Iterator[Pedestrian]:
    """Pedestrians on both pavements, world frame; `T_world_scene` is rotation (3, 3) and translation (3,)."""
    R, t = T_world_scene
    low, high = _pavement_m(settings)
    for _ in range(PEOPLE):
        y, x = rng.choice([-1.0, 1.0]) * rng.uniform(low, high), rng.uniform(-REACH_M, REACH_M)
        far = x + rng.choice([-1.0, 1.0]) * rng.uniform(6.0, 30.0)
        ends = np.array([[x, y, KERB_HEIGHT_M], [far, y + rng.normal(0, 0.2), KERB_HEIGHT_M]]) @ R.T + t
        walker = Pedestrian(person_mesh(rng), ends[0], ends[1], rng.uniform(1.2, 1.5), rng.uniform())
        if corridor.allows(np.linspace(x, far, 40), y, 0.6):
            yield walker
