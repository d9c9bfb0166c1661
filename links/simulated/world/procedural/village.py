"""A village with its own movers: a second generator, for evaluation only; no detector is trained on it.

It shares no drawing code with the other scenes: gabled houses, conifers, street lamps with arms, wires between poles
with birds on them, a crane, flags. Its movers are steered by random accelerations instead of following drawn paths.

Source: ours. Scene frame: the vehicle's road along x, z = 0 on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from links.simulated.kernels.motion import rotations_z
from links.simulated.world.mesh import Mesh, box, merge, quads, rod
from links.simulated.world.motion import interpolate
from links.simulated.world.procedural.settings import SceneSettings, VehicleCorridor
from stages.geometry.frames import Array64

STEP_S = 0.05
LASTS_S = 90.0


def village(settings: SceneSettings, corridor: VehicleCorridor, rng: Generator) -> list[Mesh]:
    """Static mesh of the village."""
    parts = [quads([[(-150, -150, 0), (150, -150, 0), (150, 150, 0), (-150, 150, 0)]], "grass")]
    parts.append(quads([[(-150, -3.5, 0.01), (150, -3.5, 0.01), (150, 3.5, 0.01), (-150, 3.5, 0.01)]], "asphalt"))
    for side in (-1.0, 1.0):
        x = -80.0
        while x < 80.0:
            x += rng.uniform(13, 30)
            y = side * rng.uniform(13, 24)
            if corridor.allows(x, y, 9.0):
                parts.append(_house(rng).moved((x, y, 0.0)))
    for _ in range(22):
        x, y = rng.uniform([-70, -55], [70, 55]).tolist()
        if abs(y) > 6 and corridor.allows(x, y, 3.0):
            parts.append(_conifer(rng).moved((x, y, 0.0)))
    poles = [(x, 5.6) for x in np.arange(-75.0, 76.0, 25.0) if corridor.allows(x, 5.6, 0.5)]
    for x, y in poles:
        parts.append(rod((x, y, 0), (x, y, 7.5), 0.11, "bark"))
    for (x0, y0), (x1, y1) in pairwise(poles):
        for z in (7.3, 6.6):
            parts.append(rod((x0, y0, z), (x1, y1, z), 0.006, "wire", sides=3))
        for share in rng.uniform(0.1, 0.9, rng.integers(0, 4)):
            parts.append(_sitting_bird().moved((x0 + share * (x1 - x0), y0, 7.31)))
    for x in np.arange(-60.0, 61.0, 24.0):
        if corridor.allows(x, -5.4, 0.5):
            parts.append(_lamp(rng.uniform(4.0, 9.0), rng.uniform(0.8, 2.4)).moved((x, -5.4, 0.0)))
    for _ in range(2):
        x, y = rng.uniform([-40, 7], [40, 12]).tolist()
        if corridor.allows(x, y, 0.5):
            parts.append(_flag(rng.uniform(6, 10)).moved((x, y, 0.0)))
    parts.append(_crane(rng.uniform(18, 26), rng.uniform(15, 28)).moved((rng.uniform(-40, 40), -30.0, 0.0)))
    return parts


def _house(rng: Generator) -> Mesh:
    w, d, h, ridge = rng.uniform(4, 7), rng.uniform(3.5, 5.5), rng.uniform(2.8, 6.0), rng.uniform(1.8, 3.5)
    roof = [
        [(-w, -d, h), (w, -d, h), (w, 0, h + ridge), (-w, 0, h + ridge)],
        [(-w, d, h), (w, d, h), (w, 0, h + ridge), (-w, 0, h + ridge)],
        [(-w, -d, h), (-w, d, h), (-w, 0, h + ridge), (-w, 0, h + ridge)],
        [(w, -d, h), (w, d, h), (w, 0, h + ridge), (w, 0, h + ridge)],
    ]
    x = rng.uniform(-0.6, 0.6) * w
    chimney = box((x - 0.3, -0.3, h), (x + 0.3, 0.3, h + ridge + rng.uniform(0.5, 1.2)), "brick")
    aerial = rod((0.5 * w, 0, h + ridge), (0.5 * w, 0, h + ridge + rng.uniform(0.8, 2.2)), 0.02, "metal", sides=4)
    return merge([box((-w, -d, 0), (w, d, h), "plaster"), quads(roof, "roof"), chimney, aerial])


def _conifer(rng: Generator) -> Mesh:
    height, wide = rng.uniform(5, 14), rng.uniform(1.2, 2.4)
    layers = [rod((0, 0, 0), (0, 0, height), 0.15, "bark", sides=5)]
    for z in np.arange(1.2, height, 0.35):
        reach = wide * (1 - z / height) + 0.1
        for angle in rng.uniform(0, 2 * np.pi, 7):
            tip = np.array([reach * np.cos(angle), reach * np.sin(angle), z - 0.25 * reach])
            side = 0.12 * np.array([-np.sin(angle), np.cos(angle), 0.3])
            layers.append(quads([[(0, 0, z), tip - side, tip, tip + side]], "leaf"))
    return merge(layers)


def _lamp(height_m: float, arm_m: float) -> Mesh:
    end = (0.0, arm_m, height_m + 0.4)
    head = box((-0.15, arm_m - 0.3, height_m + 0.3), (0.15, arm_m + 0.3, height_m + 0.42), "metal")
    return merge([rod((0, 0, 0), (0, 0, height_m), 0.06, "metal"), rod((0, 0, height_m), end, 0.025, "metal"), head])


def _flag(height_m: float) -> Mesh:
    cloth = [[(0, 0.02, height_m), (0.5, 0.2, height_m - 0.1), (0.5, 0.2, height_m - 0.9), (0, 0.02, height_m - 0.8)]]
    return merge([rod((0, 0, 0), (0, 0, height_m + 0.1), 0.03, "metal", sides=5), quads(cloth, "latex")])


def _crane(height_m: float, jib_m: float) -> Mesh:
    hook = height_m - 6.0
    return merge([
        box((-0.8, -0.8, 0), (0.8, 0.8, height_m), "metal"),
        box((-6, -0.4, height_m), (jib_m, 0.4, height_m + 1), "metal"),
        rod((0.7 * jib_m, 0, height_m), (0.7 * jib_m, 0, hook), 0.008, "wire", sides=3),
        box((0.7 * jib_m - 0.2, -0.2, hook - 0.4), (0.7 * jib_m + 0.2, 0.2, hook), "metal"),
    ])  # fmt: skip


def _sitting_bird() -> Mesh:
    return box((-0.1, -0.05, 0.0), (0.1, 0.05, 0.2), "feather", taper=0.4)


@dataclass(frozen=True)
class Steered:
    """A mover steered by random accelerations, computed in advance on a time grid."""

    name: str
    meshes: tuple[Mesh, ...]
    xyz_m: Array64  # (n, 3) world, one per STEP_S
    yaw_rad: Array64  # (n,), not wrapped
    speed_mps: float
    flaps_hz: float
    small: bool = True

    def poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        """T_world_body at times (n,): rotations (n, 3, 3), positions (n, 3) [m]."""
        return rotations_z(interpolate(self.yaw_rad, STEP_S, time_s)), interpolate(self.xyz_m, STEP_S, time_s)

    def shape(self, time_s: Array64) -> NDArray[np.int64]:
        """Index into `meshes` at times (n,)."""
        return np.floor(np.mod(self.flaps_hz * time_s, 1.0) * len(self.meshes)).astype(np.int64)


# speed [m/s], relaxation of velocity [s], random acceleration level and up [m/s^2], span [m], flaps [Hz], share
MANNERS = {
    "gull": (5.0, 8.0, 0.5, 0.3, 1.1, 0.0),
    "glider": (3.2, 20.0, 0.15, 0.1, 0.35, 0.0),
    "crow": (9.0, 5.0, 1.2, 0.5, 0.8, 4.0),
    "pigeon": (11.0, 4.0, 2.0, 0.7, 0.6, 6.0),
    "swift": (8.0, 1.5, 5.0, 1.5, 0.35, 3.0),
    "hoverer": (0.2, 2.0, 0.3, 0.2, 0.6, 7.0),
    "bag": (2.0, 3.0, 0.8, 0.5, 0.5, 0.0),
    "balloon": (0.3, 1.5, 0.5, 0.1, 0.4, 0.0),
}


def village_movers(rng: Generator, count: int) -> list[Steered]:
    """`count` movers of random manners around the start of the vehicle."""
    return [_steered(str(rng.choice(list(MANNERS))), rng) for _ in range(count)]


def _steered(manner: str, rng: Generator) -> Steered:
    mean, relax_s, level, up, span, flaps = MANNERS[manner]
    speed, steps = mean * rng.uniform(0.7, 1.3), int(LASTS_S / STEP_S)
    home = np.array([rng.uniform(-30, 30), rng.uniform(-30, 30), rng.uniform(5, 24)])
    x, heading = home + rng.normal(0, 4, 3), rng.uniform(0, 2 * np.pi)
    v = speed * np.array([np.cos(heading), np.sin(heading), 0.0])
    xyz, yaw = np.empty((steps, 3)), np.empty(steps)
    noise = rng.standard_normal((steps, 3)) * [level, level, up] * np.sqrt(2.0 / STEP_S)
    for k in range(steps):
        xyz[k], yaw[k] = x, np.arctan2(v[1], v[0])
        flat = np.hypot(v[0], v[1]) + 1e-9
        a = v * [(speed - flat) / flat / relax_s] * np.array([1, 1, 0]) - [0, 0, v[2] / relax_s] + noise[k] * 0.4
        a[:2] += 0.02 * (home - x)[:2] * (np.hypot(*(home - x)[:2]) > 25)
        a[2] += 0.05 * (home[2] - x[2])
        v, x = v + STEP_S * a, x + STEP_S * v
        x[2] = max(x[2], 1.0)
    return Steered(manner, _shapes(manner, span * rng.uniform(0.8, 1.2), flaps), xyz, np.unwrap(yaw), 25.0, flaps)


def _shapes(manner: str, span: float, flaps: float) -> tuple[Mesh, ...]:
    half = span / 2
    if manner == "bag":
        return (box((-half, -0.7 * half, -half), (half, 0.7 * half, half), "latex", taper=0.5),)
    if manner == "balloon":
        return (rod((0, 0, -half), (0, 0, half), half, "latex", sides=12),)
    body = rod((-0.4 * half, 0, 0), (0.4 * half, 0, 0), 0.12 * half, "feather", sides=5)
    shapes: list[Mesh] = []
    for raised in np.sin(2 * np.pi * np.arange(6) / 6) * (0.7 if flaps else 0.0):
        tips = [(0.0, s * half * np.cos(raised), half * np.sin(raised)) for s in (-1.0, 1.0)]
        wings = [[(0.2 * half, 0, 0), tip, tip, (-0.25 * half, 0, 0)] for tip in tips]
        shapes.append(merge([body, quads(wings, "feather")]))
    return tuple(shapes)
