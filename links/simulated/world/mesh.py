"""Triangle meshes with a surface material per triangle, and ray casting against them.

Source: ours; reflectivities at 903 nm are typical values of published spectral libraries (USGS, ECOSTRESS), rounded.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flow.link import LinkError
from links.simulated.kernels.ray_casting import Array32, ranges_and_fractions
from stages.geometry.frames import Array64

try:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene
except ImportError as error:
    raise LinkError("the simulator needs embreex: pip install -e '.[simulate]'") from error

SURFACES: dict[str, tuple[float, float]] = {  # name: (diffuse reflectivity, specular part)
    "asphalt": (0.16, 0.0),
    "paving": (0.30, 0.0),
    "kerb": (0.35, 0.0),
    "brick": (0.35, 0.0),
    "plaster": (0.55, 0.0),
    "concrete": (0.38, 0.0),
    "glass": (0.03, 0.50),
    "roof": (0.20, 0.0),
    "leaf": (0.45, 0.0),
    "bark": (0.30, 0.0),
    "metal": (0.30, 0.10),
    "wire": (0.10, 0.0),
    "rubber": (0.05, 0.0),
    "paint_dark": (0.08, 0.30),
    "paint_light": (0.50, 0.20),
    "carbon": (0.12, 0.0),
    "grass": (0.40, 0.0),
    "marking": (0.55, 0.0),
    "feather": (0.25, 0.0),
    "latex": (0.40, 0.15),
    "dark_shell": (0.06, 0.05),
    "grey_shell": (0.20, 0.05),
    "light_shell": (0.60, 0.10),
    "print": (0.40, 0.0),
}
WET_DIFFUSE = 0.45  # fraction of its diffuse reflectivity that a fully wet, porous surface keeps
POROUS = ("asphalt", "paving", "kerb", "brick", "plaster", "concrete", "roof", "bark", "grass", "marking")
_ROW = {name: row for row, name in enumerate(SURFACES)}
_DIFFUSE, _GLOSS = np.array(list(SURFACES.values()), dtype=np.float32).T
_POROUS = np.array([name in POROUS for name in SURFACES])
SURFACE_NAMES = tuple(SURFACES)


@dataclass(frozen=True)
class Mesh:
    """Triangles in metres; `surface` is the row of SURFACES per face."""

    vertices_m: Array64  # (v, 3)
    faces: NDArray[np.int32]  # (f, 3)
    surface: NDArray[np.uint8]  # (f,)

    def moved(self, xyz_m: ArrayLike = (0.0, 0.0, 0.0), rotation: Array64 | None = None) -> Mesh:
        """The mesh rotated by `rotation` (3, 3), then translated."""
        turned = self.vertices_m if rotation is None else self.vertices_m @ rotation.T
        return Mesh(turned + np.asarray(xyz_m, dtype=np.float64), self.faces, self.surface)

    def normals(self) -> Array64:
        """Unit normal per face (f, 3). Its sign is arbitrary."""
        a, b, c = (self.vertices_m[self.faces[:, i]] for i in range(3))
        n = np.cross(b - a, c - a)
        return n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-20)

    def only(self, faces: NDArray[np.bool_]) -> Mesh:
        """The mesh of the selected faces (f,)."""
        return Mesh(self.vertices_m, self.faces[faces], self.surface[faces])

    def is_surface(self, *names: str) -> NDArray[np.bool_]:
        """Mask (f,) of the faces with one of these surfaces."""
        return np.isin(self.surface, [_ROW[name] for name in names])


def merge(meshes: Iterable[Mesh]) -> Mesh:
    """All meshes as one mesh."""
    parts = list(meshes)
    first = np.cumsum([0] + [len(part.vertices_m) for part in parts[:-1]])
    return Mesh(
        np.concatenate([part.vertices_m for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, first, strict=True)]).astype(np.int32),
        np.concatenate([part.surface for part in parts]),
    )


def quads(corners_m: ArrayLike, surface: str) -> Mesh:
    """Plane quadrilaterals (q, 4, 3), the corners of each in order around it."""
    corners = np.asarray(corners_m, dtype=np.float64).reshape(-1, 4, 3)
    start = 4 * np.arange(len(corners), dtype=np.int32)[:, None, None]
    faces = (start + np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)).reshape(-1, 3)
    return Mesh(corners.reshape(-1, 3), faces, np.full(len(faces), _ROW[surface], dtype=np.uint8))


def box(low_m: ArrayLike, high_m: ArrayLike, surface: str, taper: float = 0.0) -> Mesh:
    """A box between two corners, axes aligned; `taper` shrinks its top by that fraction in x and y."""
    low, high = np.asarray(low_m, dtype=np.float64), np.asarray(high_m, dtype=np.float64)
    middle = (low + high) / 2
    unit = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], dtype=np.float64)
    v = low + unit * (high - low)
    v[4:, :2] = middle[:2] + (v[4:, :2] - middle[:2]) * (1 - taper)
    sides = [[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
    return quads(v[np.array(sides)], surface)


def rod(start_m: ArrayLike, end_m: ArrayLike, radius_m: float, surface: str, sides: int = 6) -> Mesh:
    """An open prism of `sides` faces from start to end."""
    a, b = np.asarray(start_m, dtype=np.float64), np.asarray(end_m, dtype=np.float64)
    axis = (b - a) / np.linalg.norm(b - a)
    across = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    angle = 2 * np.pi * np.arange(sides + 1) / sides
    ring = radius_m * (np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(axis, across))
    return quads(np.stack([a + ring[:-1], a + ring[1:], b + ring[1:], b + ring[:-1]], axis=1), surface)


class RayScene:
    """A mesh prepared for ray casting (Embree, single precision)."""

    def __init__(self, mesh: Mesh, wetness: float = 0.0) -> None:
        """`wetness`, 0 to 1, darkens porous surfaces, as rain does."""
        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, mesh.vertices_m.astype(np.float32), mesh.faces.astype(np.int32))
        darker = np.where(_POROUS, 1 - wetness * (1 - WET_DIFFUSE), 1.0).astype(np.float32)
        self._diffuse = (_DIFFUSE * darker)[mesh.surface]
        self._gloss = _GLOSS[mesh.surface]
        self.radius_m = float(np.linalg.norm(mesh.vertices_m, axis=1).max())

    def cast(self, origins: Array32, directions: Array32, max_range_m: float | Array32) -> tuple[Array32, Array32]:
        """First hit of rays (n, 3) with unit directions: range (n,) [m] (inf: none) and returned fraction (n,).

        The maximum range is common to all rays or one per ray (n,). The returned fraction is reflected back to the
        origin of the ray: diffuse cos(a) + gloss cos(a)^60 at incidence angle a.
        """
        limit = np.broadcast_to(np.asarray(max_range_m, dtype=np.float32), len(origins)).copy()
        hit = self._scene.run(origins, directions, dists=limit, output=True)
        return ranges_and_fractions(directions, hit["tfar"], hit["primID"], hit["Ng"], self._diffuse, self._gloss)

    def hits(
        self, origins: Array32, directions: Array32, max_range_m: float
    ) -> tuple[Array32, NDArray[np.int32], Array32, Array32]:
        """First hit of rays (n, 3): range (n,) [m], face (n,) (-1: none), barycentric u and v (n,) on that face."""
        limit = np.full(len(origins), max_range_m, dtype=np.float32)
        hit = self._scene.run(origins, directions, dists=limit, output=True)
        return hit["tfar"], hit["primID"], hit["u"], hit["v"]

    def blocked(self, origins: Array32, directions: Array32, max_range_m: float) -> NDArray[np.bool_]:
        """Mask (n,) of the rays (n, 3) that hit anything."""
        limit = np.full(len(origins), max_range_m, dtype=np.float32)
        return self._scene.run(origins, directions, dists=limit, query="OCCLUDED") != -1
