"""How surfaces look: colour and texture per sample, computed from where the sample lies, and light on it.

Textures are filtered by hand: every stripe (joint, mark, frame) is averaged over the sample's own width on the surface,
so what a pixel cannot resolve fades to its mean instead of shimmering.

Source: ours; brick and slab sizes are the usual ones, lane marks as German RMS (0.12 m lines, 3 m dashes, 6 m gaps).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from links.simulated.world.mesh import SURFACES, Array32, Array64, Mesh
from links.simulated.world.procedural import SceneSettings
from links.simulated.world.sky import LOWEST_SKY_DEG, SKY_PX, Light, cloud_noise
from stages.compiled import compiled

_PLAIN, _BRICK, _RENDERED, _GLASS, _ROAD, _SLABS, _LEAF, _PAINT, _GRASS = range(9)

LOOKS: dict[str, tuple[int, tuple[float, float, float], tuple[float, float, float]]] = {
    # name in SURFACES: texture, colour, the colour it varies towards from one object to the next (linear RGB)
    "asphalt": (_ROAD, (0.10, 0.10, 0.11), (0.10, 0.10, 0.11)),
    "paving": (_SLABS, (0.34, 0.32, 0.29), (0.34, 0.32, 0.29)),
    "kerb": (_PLAIN, (0.42, 0.41, 0.39), (0.42, 0.41, 0.39)),
    "brick": (_BRICK, (0.32, 0.12, 0.08), (0.45, 0.28, 0.16)),
    "plaster": (_RENDERED, (0.75, 0.70, 0.60), (0.60, 0.45, 0.30)),
    "concrete": (_RENDERED, (0.38, 0.38, 0.36), (0.55, 0.54, 0.50)),
    "glass": (_GLASS, (0.02, 0.025, 0.03), (0.05, 0.05, 0.05)),
    "roof": (_PLAIN, (0.20, 0.12, 0.09), (0.14, 0.14, 0.15)),
    "leaf": (_LEAF, (0.07, 0.16, 0.03), (0.16, 0.22, 0.05)),
    "bark": (_PLAIN, (0.12, 0.09, 0.06), (0.16, 0.13, 0.10)),
    "metal": (_PLAIN, (0.32, 0.33, 0.34), (0.25, 0.26, 0.26)),
    "wire": (_PLAIN, (0.04, 0.04, 0.04), (0.04, 0.04, 0.04)),
    "rubber": (_PLAIN, (0.03, 0.03, 0.03), (0.03, 0.03, 0.03)),
    "paint_dark": (_PAINT, (0.03, 0.04, 0.10), (0.12, 0.02, 0.02)),
    "paint_light": (_PAINT, (0.62, 0.63, 0.64), (0.45, 0.46, 0.48)),
    "carbon": (_PLAIN, (0.03, 0.03, 0.035), (0.03, 0.03, 0.035)),
    "feather": (_PLAIN, (0.05, 0.05, 0.06), (0.5, 0.5, 0.5)),
    "latex": (_PLAIN, (0.65, 0.05, 0.06), (0.10, 0.20, 0.60)),
    "grass": (_GRASS, (0.09, 0.15, 0.03), (0.09, 0.15, 0.03)),
    "dark_shell": (_PLAIN, (0.03, 0.03, 0.03), (0.03, 0.03, 0.03)),
    "light_shell": (_PLAIN, (0.6, 0.6, 0.6), (0.6, 0.6, 0.6)),
    "marking": (_PLAIN, (0.75, 0.75, 0.72), (0.75, 0.75, 0.72)),
}
_OBJECT_ENDS = ("roof", "rubber")  # a run of these faces ends an object in a mesh: a house, a car
_FRAME_M = 0.07  # width of a window's frame
_NOISE = cloud_noise(np.random.default_rng([20, 1]), falloff=1.1).astype(np.float32)

Look = tuple[NDArray[np.int64], Array32, Array32]


def _looks(surfaces: dict[str, tuple[float, float]]) -> Look:
    """Rows of texture, colour and other colour as `surfaces` has them; one without a look is a plain grey."""
    kinds, colours, others = [], [], []
    for name, (diffuse, _) in surfaces.items():
        grey = (diffuse, diffuse, diffuse)
        kind, colour, other = LOOKS.get(name, (_PLAIN, grey, grey))
        kinds.append(kind)
        colours.append(colour)
        others.append(other)
    return np.array(kinds), np.array(colours, dtype=np.float32), np.array(others, dtype=np.float32)


_KIND, _COLOUR, _OTHER = _looks(SURFACES)


@dataclass(frozen=True)
class Faces:
    """What shading needs of each triangle, in its body's frame."""

    normal: Array32  # (f, 3) unit
    surface: NDArray[np.uint8]  # (f,)
    tint: Array32  # (f,) 0..1, one number for each object
    half: NDArray[np.int8]  # (f,) 0 and 1: first and second half of a quadrilateral; -1: none
    side_m: Array32  # (f, 2) lengths of the quadrilateral's two sides


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
    leaf = mesh.surface == names.index("leaf")
    tint[leaf] = _hash01(np.arange(len(f)) // 2)[leaf]
    return Faces(normal.astype(np.float32), mesh.surface, tint.astype(np.float32), half, side)


def _hash01(number: NDArray[np.int64]) -> Array64:
    return ((number.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(40)).astype(np.float64) / 2**24


@dataclass(frozen=True)
class Street:
    """Where lane marks lie: the street's frame seen from the world. Half width 0: no marks."""

    yaw_rad: float
    y_m: float  # the world's origin in the street frame
    ground_z_m: float
    half_width_m: float

    @classmethod
    def of(cls, settings: SceneSettings, camera_height_m: float) -> Street:
        """The street of a scene. Only the plain street has its marks painted here: other kinds have them as faces."""
        half_width_m = settings.road_width_m / 2 if settings.kind == "street" else 0.0
        yaw_rad = math.radians(settings.vehicle_yaw_deg)
        return cls(yaw_rad, settings.vehicle_lane_y_m, -camera_height_m, half_width_m)

    def numbers(self) -> Array64:
        """For compiled code."""
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
) -> Array32:
    """Linear RGB (n, 3) of samples: world directions, hit points and normals (n, 3), ranges (n,).

    `surface` (n,) is the row of SURFACES, -1 for sky. `window` (n, 4): place on the quadrilateral and its sides [m].
    `lit` says which samples see the sun.
    """
    return _radiance(
        directions, points, normals, ranges, surface, tint, window, lit, pixel_rad, street.numbers(),
        _KIND, _COLOUR, _OTHER, _NOISE,
        light.sun_direction, light.sun_rgb, light.above_rgb, light.below_rgb, light.haze_rgb,
        light.extinction_per_m, light.sky,
    )  # fmt: skip


@compiled
def _radiance(
    directions, points, normals, ranges, surface, tint, window, lit, pixel_rad, street,
    kinds, colours, others, noise, sun, sun_rgb, above, below, haze, extinction, sky,
):  # fmt: skip
    out = np.empty((len(surface), 3), dtype=np.float32)
    colour, seen = np.empty(3), np.empty(3)
    for i in range(len(surface)):
        d = directions[i]
        s = surface[i]
        if s < 0:
            _sky(d[0], d[1], d[2], sky, haze, seen)
            out[i, 0], out[i, 1], out[i, 2] = seen[0], seen[1], seen[2]
            continue
        n0, n1, n2 = normals[i, 0], normals[i, 1], normals[i, 2]
        facing = -(n0 * d[0] + n1 * d[1] + n2 * d[2])
        if facing < 0.0:
            n0, n1, n2, facing = -n0, -n1, -n2, -facing
        width = ranges[i] * pixel_rad / math.sqrt(max(facing, 0.05))
        kind = kinds[s]
        for j in range(3):
            colour[j] = colours[s, j] + tint[i] * (others[s, j] - colours[s, j])
        gloss = _texture(kind, colour, points[i], n0, n1, n2, width, window[i], street, noise)

        towards = n0 * sun[0] + n1 * sun[1] + n2 * sun[2]
        direct = max(towards, 0.0) if lit[i] else 0.0
        if kind == _LEAF and lit[i]:
            direct = max(direct, 0.5 * abs(towards))  # light comes through leaves
        up = 0.5 * (1.0 + n2)
        for j in range(3):
            seen[j] = colour[j] * (direct * sun_rgb[j] + up * above[j] + (1.0 - up) * below[j])
        if gloss > 0.0:
            mirror = gloss * (0.08 + 0.92 * (1.0 - facing) ** 5)  # Schlick, two faces of a pane
            r0, r1, r2 = d[0] + 2 * facing * n0, d[1] + 2 * facing * n1, d[2] + 2 * facing * n2
            _sky(r0, r1, r2, sky, haze, colour)
            for j in range(3):
                seen[j] = (1.0 - mirror) * seen[j] + mirror * min(colour[j], 4.0)
        clear = math.exp(-extinction * ranges[i])
        for j in range(3):
            out[i, j] = clear * seen[j] + (1.0 - clear) * haze[j]
    return out


@compiled
def _texture(kind, colour, p, n0, n1, n2, width, window, street, noise):
    """Changes `colour` in place; returns how glossy the surface is (1: window glass)."""
    x = street[0] * p[0] - street[1] * p[1]
    y = street[1] * p[0] + street[0] * p[1] + street[2]
    z = p[2] - street[3]
    if abs(n2) < 0.7:  # a wall: u along it, v up
        level = math.sqrt(n0 * n0 + n1 * n1)
        u, v = (-n1 * p[0] + n0 * p[1]) / level, z
    else:
        u, v = x, y
    if kind == _GLASS:
        return _glass(colour, width, window)
    if kind == _BRICK:
        joint = _stripes(v, 0.075, 0.011, width)
        course = math.floor(v / 0.075)
        upright = _stripes(u + 0.125 * (course % 2), 0.25, 0.011, width)
        mortar = joint + upright - joint * upright
        grain = 1.0 + 0.35 * (_noise(u / 2, v / 2, width / 2, noise) - 0.5)
        for j in range(3):
            colour[j] = (1.0 - mortar) * colour[j] * grain + mortar * 0.42
    elif kind == _RENDERED:
        stain = 1.0 + 0.30 * (_noise(u / 6, v / 9, width / 6, noise) - 0.5)
        joint = 0.35 * _stripes(v, 3.0, 0.03, width)
        for j in range(3):
            colour[j] *= stain * (1.0 - joint)
    elif kind == _ROAD:
        grain = 1.0 + 0.5 * (_noise(x / 1.5, y / 1.5, width / 1.5, noise) - 0.5)
        grain *= 1.0 + 0.35 * (_noise(x / 40, y / 10, width / 10, noise) - 0.5)
        mark = _lane_marks(x, y, z, width, street[4])
        for j in range(3):
            colour[j] = (1.0 - mark) * colour[j] * grain + mark * 0.70
    elif kind == _SLABS:
        a, b = _stripes(x, 0.5, 0.012, width), _stripes(y, 0.5, 0.012, width)
        joint = a + b - a * b
        grain = 1.0 + 0.25 * (_noise(x / 3, y / 3, width / 3, noise) - 0.5)
        for j in range(3):
            colour[j] *= grain * (1.0 - 0.5 * joint)
    elif kind == _GRASS:
        grain = 1.0 + 0.8 * (_noise(x / 1.2, y / 1.2, width / 1.2, noise) - 0.5)
        for j in range(3):
            colour[j] *= grain
    elif kind == _PAINT:
        return 0.3
    return 0.0


@compiled
def _glass(colour, width, window):
    """A frame around the pane and a mullion in its middle. window: place (2) and sides (2) of the pane [m]."""
    w, h = window[2], window[3]
    if w <= 0.0:
        return 1.0
    frame = 0.0
    for along, side in ((window[0], w), (window[1], h)):
        inside = _overlap(along, _FRAME_M, side - _FRAME_M, width)
        frame = max(frame, 1.0 - inside)
    frame = max(frame, _overlap(window[0], 0.5 * w - 0.03, 0.5 * w + 0.03, width))
    for j in range(3):
        colour[j] = (1.0 - frame) * colour[j] + frame * 0.62
    return 1.0 - frame


@compiled
def _lane_marks(x, y, z, width, half):
    """Share of paint: dashes in the middle, lines along the edges, a zebra crossing every 60 m. Street frame."""
    if half <= 0.0 or abs(y) > half or abs(z) > 0.05:
        return 0.0
    dash = _overlap(y, -0.06, 0.06, width) * _stripes(x, 9.0, 3.0, width)
    edge = _overlap(abs(y), half - 0.30, half - 0.18, width)
    along = x - 60.0 * math.floor(x / 60.0 + 0.5) - 18.0
    zebra = _overlap(along, -1.5, 1.5, width) * _stripes(y + 0.25, 1.0, 0.5, width)
    return max(max(dash, edge), zebra)


@compiled
def _overlap(x, low, high, width):
    """Share of [x - width / 2, x + width / 2] that lies in [low, high]."""
    return max(0.0, min(x + 0.5 * width, high) - max(x - 0.5 * width, low)) / width


@compiled
def _stripes(x, period, stripe, width):
    """Mean over `width` of stripes of width `stripe` that start at multiples of `period`."""
    a, b = x - 0.5 * width, x + 0.5 * width
    ka, kb = math.floor(a / period), math.floor(b / period)
    whole = (kb - ka) * stripe
    return (whole + min(b - kb * period, stripe) - min(a - ka * period, stripe)) / width


@compiled
def _noise(x, y, width, tile):
    """The noise tile (one a unit) at (x, y), faded to its mean 0.5 when the sample is wider than its grain."""
    size = len(tile)
    fade = max(0.0, 1.0 - 6.0 * width)
    if fade == 0.0:
        return 0.5
    u, v = x * size, y * size
    fu, fv = math.floor(u), math.floor(v)
    a, b = u - fu, v - fv
    i, j = int(fu) % size, int(fv) % size
    i1, j1 = (i + 1) % size, (j + 1) % size
    top = tile[j, i] * (1 - a) + tile[j, i1] * a
    low = tile[j1, i] * (1 - a) + tile[j1, i1] * a
    return 0.5 + fade * (top * (1 - b) + low * b - 0.5)


@compiled
def _sky(x, y, z, sky, haze, rgb):
    """Sky radiance along a unit direction, bilinear in the sky map; below the map, the distant ground's haze."""
    lowest = 0.5 * math.pi + math.radians(LOWEST_SKY_DEG)
    off = math.acos(min(max(z, -1.0), 1.0))
    if off >= lowest:
        for j in range(3):
            rgb[j] = 0.5 * haze[j]
        return
    across = math.sqrt(x * x + y * y)
    r = off / lowest
    c, s = (x / across, y / across) if across > 0.0 else (0.0, 0.0)
    u = min(max((r * c + 1.0) * 0.5 * SKY_PX - 0.5, 0.0), SKY_PX - 1.001)
    v = min(max((r * s + 1.0) * 0.5 * SKY_PX - 0.5, 0.0), SKY_PX - 1.001)
    i, j = int(u), int(v)
    a, b = u - i, v - j
    for k in range(3):
        top = sky[j, i, k] * (1 - a) + sky[j, i + 1, k] * a
        low = sky[j + 1, i, k] * (1 - a) + sky[j + 1, i + 1, k] * a
        rgb[k] = top * (1 - b) + low * b
