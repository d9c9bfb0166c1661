"""Rays of a camera against the world and everything that moves, each ray at its own moment.

Source: ours. A body is cast in its own frame with the pose of each ray's moment, so it moves within an exposure and
between the rows of a rolling shutter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from links.simulated.sensors.camera_paint import Faces, Street, faces_of, radiance
from links.simulated.world.mesh import SURFACES, Array32, Array64, Mesh, RayScene
from links.simulated.world.scene import Body
from links.simulated.world.sky import Light
from stages.compiled import compiled

FAR_M = 400.0
SHADOW_REACH_M = 120.0
CONTRAST = 0.02  # half of the relative difference, linear, below which an edge is left as it is
LIFT_M = 0.01  # shadow rays start this far off the surface
LEAF = list(SURFACES).index("leaf")
SKY, WORLD = -1, 0  # bodies count from 1


@dataclass
class Samples:
    """What rays (n,) met."""

    directions: Array32  # (n, 3) world
    points: Array32  # (n, 3) world
    normals: Array32  # (n, 3) world, on either side
    ranges: Array32  # (n,) inf: sky
    body: NDArray[np.int32]
    surface: NDArray[np.int64]  # row of SURFACES, -1: sky
    tint: Array32
    window: Array32  # (n, 4) place on the quadrilateral and its sides [m]
    lit: NDArray[np.bool_]

    @classmethod
    def empty(cls, count: int) -> Samples:
        """Room for `count` samples; each sees the sky."""
        return cls(
            directions=np.zeros((count, 3), np.float32),
            points=np.zeros((count, 3), np.float32),
            normals=np.zeros((count, 3), np.float32),
            ranges=np.full(count, np.inf, np.float32),
            body=np.full(count, SKY, dtype=np.int32),
            surface=np.full(count, -1, dtype=np.int64),
            tint=np.zeros(count, np.float32),
            window=np.zeros((count, 4), np.float32),
            lit=np.zeros(count, dtype=np.bool_),
        )

    def put(self, pick: NDArray[np.intp], other: Samples) -> None:
        """Set samples `pick` to all of another's, as far as finding edges needs them."""
        for name in ("points", "normals", "ranges", "body", "surface", "lit"):
            getattr(self, name)[pick] = getattr(other, name)

    def describe(self, pick: NDArray[np.intp], face: NDArray[np.int32], u: Array32, v: Array32, faces: Faces) -> None:
        """Fill in what is known of the faces that samples `pick` met; normals stay in the body's frame."""
        _describe(
            pick, face, u, v, faces.normal, faces.surface, faces.tint, faces.half, faces.side_m,
            self.normals, self.surface, self.tint, self.window,
        )  # fmt: skip


class CameraScene:
    """Everything a camera can see, ready for rays."""

    def __init__(self, world: RayScene, world_mesh: Mesh, bodies: Sequence[Body], street: Street, light: Light) -> None:
        self.bodies = tuple(bodies)
        self.light = light
        self.street = street
        self._world = world
        self._world_faces = faces_of(world_mesh)
        self._faces = [[faces_of(mesh) for mesh in body.meshes] for body in self.bodies]

    def always_hit(self, index: int, origin: Array64, directions: Array64) -> NDArray[np.bool_]:
        """Rays (n, 3) in a body's own frame that meet it in whichever of its shapes."""
        origins = np.tile(origin.astype(np.float32), (len(directions), 1))
        hit = np.ones(len(directions), dtype=np.bool_)
        for scene in self.bodies[index].scenes:
            hit &= scene.blocked(origins, directions.astype(np.float32), FAR_M)
        return hit

    def trace(
        self,
        origins: Array32,
        directions: Array32,
        moment: NDArray[np.int64],
        moment_ns: NDArray[np.int64],
        only: int | None = None,
    ) -> Samples:
        """Cast rays (n, 3) in the world frame; ray i leaves at time moment_ns[moment[i]]. `only`: against one body."""
        samples = Samples.empty(len(directions))
        samples.directions = directions
        if only is None:
            samples.ranges, face, u, v = self._world.hits(origins, directions, FAR_M)
            samples.ranges[face < 0] = np.inf
            samples.body[face >= 0] = WORLD
            samples.describe(np.arange(len(face)), face, u, v, self._world_faces)
        if only is None:
            self._meet_all(origins, samples, moment, moment_ns)
        else:
            self._meet(only, np.arange(len(directions)), origins, samples, moment, moment_ns)
        _points(origins, directions, samples.ranges, samples.points)
        if self.light.sun_rgb.any():
            self._shine(samples, moment_ns)
        return samples

    def radiance(self, samples: Samples, pixel_rad: float) -> Array32:
        """Linear RGB (n, 3)."""
        s = samples
        return radiance(
            s.directions, s.points, s.normals, s.ranges, s.surface, s.tint, s.window, s.lit,
            pixel_rad, self.street, self.light,
        )  # fmt: skip

    def _meet_all(
        self, origins: Array32, samples: Samples, moment: NDArray[np.int64], moment_ns: NDArray[np.int64]
    ) -> None:
        """Every body against the rays that pass it: those within a cone that holds it at all moments."""
        if not self.bodies or not len(origins):
            return
        low, high = origins.min(axis=0), origins.max(axis=0)
        places = [body.pose(moment_ns)[1] for body in self.bodies]
        middles = np.array([(t.min(axis=0) + t.max(axis=0)) / 2 for t in places])
        spreads = np.array([np.linalg.norm(np.ptp(t, axis=0)) / 2 for t in places])
        towards = middles - (low + high) / 2
        distance = np.maximum(np.linalg.norm(towards, axis=1), 1e-9)
        reach = np.array([body.radius_m for body in self.bodies]) + spreads + np.linalg.norm(high - low) / 2
        cosine = np.sqrt(np.maximum(1 - (reach / distance) ** 2, 0.0)) - 1e-5
        cosine[reach >= distance] = -2.0  # the rays start within its reach
        along = samples.directions @ (towards / distance[:, None]).T.astype(np.float32)
        for index in range(len(self.bodies)):
            among = np.nonzero(along[:, index] > cosine[index])[0]
            if len(among):
                self._meet(index, among, origins, samples, moment, moment_ns)

    def _meet(
        self,
        index: int,
        among: NDArray[np.intp],
        origins: Array32,
        samples: Samples,
        moment: NDArray[np.int64],
        moment_ns: NDArray[np.int64],
    ) -> None:
        """Nearer hits of the rays `among` on a body replace what was found."""
        body = self.bodies[index]
        R, t = body.pose(moment_ns)
        shape_of_moment = np.zeros(len(moment_ns), dtype=np.int64) if body.shape is None else body.shape(moment_ns)
        for shape in np.unique(shape_of_moment):
            right = shape_of_moment == shape
            pick, local_o, local_d = _towards(
                among, origins, samples.directions, moment, right, R, t, *body.box_m, body.radius_m, samples.ranges
            )
            if not len(pick):
                continue
            found, face, u, v = body.scenes[shape].hits(local_o, local_d, FAR_M)
            nearer = (face >= 0) & (found < samples.ranges[pick])
            pick = pick[nearer]
            samples.ranges[pick] = found[nearer]
            samples.body[pick] = index + 1
            samples.describe(pick, face[nearer], u[nearer], v[nearer], self._faces[index][shape])
            _turn(pick, moment, R, samples.normals)

    def _shine(self, samples: Samples, moment_ns: NDArray[np.int64]) -> None:
        """Which samples see the sun: nothing stands between, bodies as they are in the middle of the exposure."""
        sun = self.light.sun_direction
        pick, origins = _sunny_side(
            samples.points, samples.normals, samples.directions, samples.surface, samples.ranges, sun
        )
        towards = np.tile(sun.astype(np.float32), (len(pick), 1))
        dark = self._world.blocked(origins, towards, SHADOW_REACH_M)
        middle_ns = moment_ns[len(moment_ns) // 2 : len(moment_ns) // 2 + 1]
        now = np.zeros(len(pick), dtype=np.int64)
        right, everything = np.ones(1, dtype=np.bool_), np.arange(len(pick))
        for body in self.bodies:
            R, t = body.pose(middle_ns)
            shape = 0 if body.shape is None else int(body.shape(middle_ns)[0])
            limit = np.where(dark, 0.0, SHADOW_REACH_M).astype(np.float32)
            some, o, d = _towards(everything, origins, towards, now, right, R, t, *body.box_m, body.radius_m, limit)
            if len(some):
                dark[some] |= body.scenes[shape].blocked(o, d, SHADOW_REACH_M)
        samples.lit[pick] = ~dark


@compiled
def _describe(pick, face, u, v, normal, surface, tint, half, side, normals_out, surface_out, tint_out, window_out):
    """Copy what is known of each hit face to samples pick[i]; the place on a quadrilateral from the barycentrics."""
    for i in range(len(pick)):
        f, k = face[i], pick[i]
        if f < 0:
            continue
        for j in range(3):
            normals_out[k, j] = normal[f, j]
        surface_out[k] = surface[f]
        tint_out[k] = tint[f]
        if half[f] == 0:  # P = v0 + u (v1 - v0) + v (v2 - v0)
            s, t = u[i] + v[i], v[i]
        else:  # P = v0 + u (v2 - v0) + v (v3 - v0)
            s, t = u[i], u[i] + v[i]
        a, b = (side[f, 0], side[f, 1]) if half[f] >= 0 else (0.0, 0.0)
        window_out[k, 0], window_out[k, 1], window_out[k, 2], window_out[k, 3] = s * a, t * b, a, b


@compiled
def _turn(pick, moment, R, normals):
    """Normals of samples `pick` from the body's frame to the world's."""
    for k in pick:
        a, b, c = normals[k, 0], normals[k, 1], normals[k, 2]
        r = R[moment[k]]
        for j in range(3):
            normals[k, j] = r[j, 0] * a + r[j, 1] * b + r[j, 2] * c


@compiled
def _points(origins, directions, ranges, points):
    for i in range(len(ranges)):
        reach = ranges[i] if ranges[i] < FAR_M else np.float32(FAR_M)
        for j in range(3):
            points[i, j] = origins[i, j] + reach * directions[i, j]


@compiled
def _towards(among, origins, directions, moment, right, R, t, low_m, high_m, reach_m, limit_m):
    """Rays of `among` at moments of the right shape that meet the body's box before their limit, in its frame."""
    pick = np.empty(len(among), dtype=np.int64)
    local_o = np.empty((len(among), 3), dtype=np.float32)
    local_d = np.empty((len(among), 3), dtype=np.float32)
    o, d = np.empty(3), np.empty(3)
    count = 0
    for i in among:
        m = moment[i]
        if not right[m]:
            continue
        a0, a1, a2 = t[m, 0] - origins[i, 0], t[m, 1] - origins[i, 1], t[m, 2] - origins[i, 2]
        ahead = a0 * directions[i, 0] + a1 * directions[i, 1] + a2 * directions[i, 2]
        square = a0 * a0 + a1 * a1 + a2 * a2
        if square - ahead * ahead > reach_m * reach_m or (ahead < 0.0 and square > reach_m * reach_m):
            continue
        r = R[m]
        enter, leave = 0.0, float(limit_m[i])
        for j in range(3):
            o[j] = -(r[0, j] * a0 + r[1, j] * a1 + r[2, j] * a2)
            d[j] = r[0, j] * directions[i, 0] + r[1, j] * directions[i, 1] + r[2, j] * directions[i, 2]
            if abs(d[j]) < 1e-12:
                if o[j] < low_m[j] or o[j] > high_m[j]:
                    leave = -1.0
                continue
            one, two = (low_m[j] - o[j]) / d[j], (high_m[j] - o[j]) / d[j]
            enter, leave = max(enter, min(one, two)), min(leave, max(one, two))
        if enter > leave:
            continue
        pick[count] = i
        for j in range(3):
            local_o[count, j], local_d[count, j] = o[j], d[j]
        count += 1
    return pick[:count], local_o[:count], local_d[:count]


@compiled
def _sunny_side(points, normals, directions, surface, ranges, sun):
    """Samples whose seen side faces the sun, and where their shadow rays start."""
    pick = np.empty(len(surface), dtype=np.int64)
    origins = np.empty((len(surface), 3), dtype=np.float32)
    count = 0
    for i in range(len(surface)):
        if surface[i] < 0:
            continue
        n, d = normals[i], directions[i]
        side = -1.0 if n[0] * d[0] + n[1] * d[1] + n[2] * d[2] > 0.0 else 1.0
        towards = n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2]
        if side * towards <= 0.0:
            continue
        lift = side * (LIFT_M + 2e-5 * ranges[i])
        pick[count] = i
        for j in range(3):
            origins[count, j] = points[i, j] + lift * n[j]
        count += 1
    return pick[:count], origins[:count]


@compiled
def edges(rows, columns, index, normals, points, ranges, body, surface, lit, colours):
    """Pixels (n,) that differ from one of their four neighbours in body, surface, plane or light, and in colour.

    Leaf beside leaf is no edge: every pixel would be one.
    """
    found = np.zeros(len(rows), dtype=np.bool_)
    for i in range(len(rows)):
        for step in range(2):
            y, x = rows[i] + step, columns[i] + 1 - step
            if y >= index.shape[0] or x >= index.shape[1]:
                continue
            j = index[y, x]
            if j < 0 or (surface[i] == surface[j] and (surface[i] < 0 or surface[i] == LEAF)):
                continue
            differs = body[i] != body[j] or surface[i] != surface[j] or lit[i] != lit[j]
            if not differs:
                alike, off = 0.0, 0.0
                for k in range(3):
                    alike += normals[i, k] * normals[j, k]
                    off += normals[i, k] * (points[j, k] - points[i, k])
                differs = abs(alike) < 0.99 or abs(off) > 0.01 + 0.002 * ranges[i]
            visibly = False
            for k in range(3):
                visibly |= abs(colours[i, k] - colours[j, k]) > CONTRAST * (colours[i, k] + colours[j, k])
            if differs and visibly:
                found[i] = True
                found[j] = True
    return found


@compiled
def image_motion(points, moment, R0, t0, R1, t1):
    """Angle (n,) [rad] by which standing points turn in the camera between two poses per moment."""
    angle = np.empty(len(moment))
    for i in range(len(moment)):
        m = moment[i]
        a = _seen_from(points[i], R0[m], t0[m])
        b = _seen_from(points[i], R1[m], t1[m])
        angle[i] = math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)
    return angle


@compiled
def _seen_from(point, R, t):
    """Unit vector R^T (p - t)."""
    x, y, z = point[0] - t[0], point[1] - t[1], point[2] - t[2]
    scale = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-9)
    x, y, z = x * scale, y * scale, z * scale
    return (
        R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
        R[0, 1] * x + R[1, 1] * y + R[2, 1] * z,
        R[0, 2] * x + R[1, 2] * y + R[2, 2] * z,
    )
