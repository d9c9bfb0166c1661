"""Appearance of surfaces: material table, shading table of a mesh, and the radiance of camera samples.

Source: ours; brick and slab sizes are common ones, lane marks follow the German RMS (0.12 m lines, 3 m dashes, 6 m
gaps).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from links.simulated.kernels import camera_paint as kernels
from links.simulated.kernels.camera_paint import BRICK, GLASS, GRASS, LEAF, PAINT, PLAIN, PRINT, RENDERED, ROAD, SLABS
from links.simulated.kernels.ray_casting import Array32
from links.simulated.world.mesh import SURFACES, Mesh
from links.simulated.world.procedural import SceneSettings
from links.simulated.world.sky import Light, noise_tile
from stages.geometry.frames import Array64

MATERIALS: dict[str, tuple[int, tuple[float, float, float], tuple[float, float, float]]] = {
    # name in SURFACES: texture, base colour, second colour; each object gets a colour between the two (linear RGB)
    "asphalt": (ROAD, (0.10, 0.10, 0.11), (0.10, 0.10, 0.11)),
    "paving": (SLABS, (0.34, 0.32, 0.29), (0.34, 0.32, 0.29)),
    "kerb": (PLAIN, (0.42, 0.41, 0.39), (0.42, 0.41, 0.39)),
    "brick": (BRICK, (0.32, 0.12, 0.08), (0.45, 0.28, 0.16)),
    "plaster": (RENDERED, (0.75, 0.70, 0.60), (0.60, 0.45, 0.30)),
    "concrete": (RENDERED, (0.38, 0.38, 0.36), (0.55, 0.54, 0.50)),
    "glass": (GLASS, (0.02, 0.025, 0.03), (0.05, 0.05, 0.05)),
    "roof": (PLAIN, (0.20, 0.12, 0.09), (0.14, 0.14, 0.15)),
    "leaf": (LEAF, (0.07, 0.16, 0.03), (0.16, 0.22, 0.05)),
    "bark": (PLAIN, (0.12, 0.09, 0.06), (0.16, 0.13, 0.10)),
    "metal": (PLAIN, (0.32, 0.33, 0.34), (0.25, 0.26, 0.26)),
    "wire": (PLAIN, (0.04, 0.04, 0.04), (0.04, 0.04, 0.04)),
    "rubber": (PLAIN, (0.03, 0.03, 0.03), (0.03, 0.03, 0.03)),
    "paint_dark": (PAINT, (0.03, 0.04, 0.10), (0.12, 0.02, 0.02)),
    "paint_light": (PAINT, (0.62, 0.63, 0.64), (0.45, 0.46, 0.48)),
    "carbon": (PLAIN, (0.03, 0.03, 0.035), (0.03, 0.03, 0.035)),
    "feather": (PLAIN, (0.05, 0.05, 0.06), (0.5, 0.5, 0.5)),
    "latex": (PLAIN, (0.65, 0.05, 0.06), (0.10, 0.20, 0.60)),
    "grass": (GRASS, (0.09, 0.15, 0.03), (0.09, 0.15, 0.03)),
    "dark_shell": (PLAIN, (0.03, 0.03, 0.03), (0.03, 0.03, 0.03)),
    "light_shell": (PLAIN, (0.6, 0.6, 0.6), (0.6, 0.6, 0.6)),
    "print": (PRINT, (0.80, 0.78, 0.70), (0.55, 0.18, 0.10)),
    "marking": (PLAIN, (0.75, 0.75, 0.72), (0.75, 0.75, 0.72)),
}
_OBJECT_ENDS = ("roof", "rubber")  # a run of these faces ends an object in a mesh: a building, a car
_NOISE = noise_tile(np.random.default_rng([20, 1]), falloff=1.1).astype(np.float32)
NO_MIRROR: Array32 = np.empty((0, 3), dtype=np.float32)

MaterialTable = tuple[NDArray[np.int64], Array32, Array32]


def _material_table(surfaces: dict[str, tuple[float, float]]) -> MaterialTable:
    """Rows of texture, base and second colour in the order of `surfaces`; a surface without a material is grey."""
    kinds, colours, others = [], [], []
    for name, (diffuse, _) in surfaces.items():
        grey = (diffuse, diffuse, diffuse)
        kind, colour, other = MATERIALS.get(name, (PLAIN, grey, grey))
        kinds.append(kind)
        colours.append(colour)
        others.append(other)
    return np.array(kinds), np.array(colours, dtype=np.float32), np.array(others, dtype=np.float32)


_KIND, _COLOUR, _OTHER = _material_table(SURFACES)


@dataclass(frozen=True)
class Faces:
    """What shading needs of each triangle, in the frame of its body."""

    normal: Array32  # (f, 3) unit
    surface: NDArray[np.uint8]  # (f,)
    tint: Array32  # (f,) 0 to 1, one value per object
    half: NDArray[np.int8]  # (f,) 0 and 1: first and second half of a quadrilateral; -1: none
    side_m: Array32  # (f, 2) side lengths of the quadrilateral


def faces_of(mesh: Mesh) -> Faces:
    """The shading table of a mesh."""
    a, b, c = (mesh.vertices_m[mesh.faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    f = mesh.faces
    first = np.zeros(len(f), dtype=np.bool_)
    first[:-1] = (f[:-1, 0] == f[1:, 0]) & (f[:-1, 2] == f[1:, 1])
    half = np.where(first, 0, -1).astype(np.int8)
    half[1:][first[:-1]] = 1
    side = np.zeros((len(f), 2), dtype=np.float32)
    at = np.nonzero(first)[0]
    side[at, 0] = np.linalg.norm((b - a)[at], axis=1)
    side[at, 1] = np.linalg.norm((c - a)[at + 1], axis=1)
    side[at + 1] = side[at]
    names = list(SURFACES)
    ends = np.isin(mesh.surface, [names.index(name) for name in _OBJECT_ENDS if name in names])
    started = np.concatenate([[False], ends[1:] & ~ends[:-1]])
    tint = _hash01(np.cumsum(started))
    own = mesh.is_surface("leaf", "print")  # each quadrilateral has a colour of its own
    tint[own] = _hash01(np.arange(len(f)) // 2)[own]
    return Faces(normal.astype(np.float32), mesh.surface, tint.astype(np.float32), half, side)


def _hash01(number: NDArray[np.int64]) -> Array64:
    return ((number.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(40)).astype(np.float64) / 2**24


@dataclass(frozen=True)
class Street:
    """Position of the lane marks: the pose of the street frame in the world. Half width 0: no marks."""

    yaw_rad: float
    y_m: float  # y of the world origin in the street frame
    ground_z_m: float
    half_width_m: float

    @classmethod
    def of(cls, settings: SceneSettings, camera_height_m: float) -> Street:
        """The street of a scene. Only the plain street has painted marks; those of other kinds are faces."""
        half_width_m = settings.road_width_m / 2 if settings.kind == "street" else 0.0
        yaw_rad = math.radians(settings.vehicle_yaw_deg)
        return cls(yaw_rad, settings.vehicle_lane_y_m, -camera_height_m, half_width_m)

    def numbers(self) -> Array64:
        """The values as an array, for compiled code."""
        return np.array([math.cos(self.yaw_rad), math.sin(self.yaw_rad), self.y_m, self.ground_z_m, self.half_width_m])


def radiance(
    directions: Array32,
    points: Array32,
    normals: Array32,
    ranges: Array32,
    surface: NDArray[np.int64],
    tint: Array32,
    window: Array32,
    lit: NDArray[np.bool_],
    pixel_rad: float,
    street: Street,
    light: Light,
    mirrored: Array32 = NO_MIRROR,
) -> Array32:
    """Linear RGB (n, 3) of samples: world directions, hit points and normals (n, 3), ranges (n,).

    `surface` (n,) is the row of SURFACES, -1 for sky. `window` (n, 4): position on the quadrilateral and its sides [m].
    `lit` marks the samples in direct sun. `mirrored` (n, 3): what a glossy sample reflects; -1, or empty: the sky.
    """
    return kernels.shade(
        directions, points, normals, ranges, surface, tint, window, lit, pixel_rad, street.numbers(),
        _KIND, _COLOUR, _OTHER, _NOISE,
        light.sun_direction, light.sun_rgb, light.above_rgb, light.below_rgb, light.haze_rgb,
        light.extinction_per_m, light.sky, mirrored,
    )  # fmt: skip
