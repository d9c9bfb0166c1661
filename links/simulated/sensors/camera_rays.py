"""Camera rays against the world and the moving bodies, each ray at its own time.

Source: ours. A body is cast in its own frame with its pose at the time of each ray, so it moves within an exposure and
between the rows of a rolling shutter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from links.simulated.kernels.camera_rays import (
    FAR_M,
    LIFT_M,
    describe_hits,
    hit_points,
    rays_into_body,
    rotate_normals,
    shadow_rays,
)
from links.simulated.kernels.ray_casting import Array32
from links.simulated.sensors.camera_paint import NO_MIRROR, Faces, Street, faces_of, radiance
from links.simulated.world.mesh import SURFACES, Mesh, RayScene
from links.simulated.world.scene import Body
from links.simulated.world.sky import Light
from stages.geometry.frames import Array64

SHADOW_REACH_M = 120.0
LEAF_ROW = list(SURFACES).index("leaf")
GLASS_ROW = list(SURFACES).index("glass")
SKY, WORLD = -1, 0  # bodies are numbered from 1


@dataclass
class Samples:
    """Hits of rays (n,)."""

    directions: Array32  # (n, 3) world
    points: Array32  # (n, 3) world
    normals: Array32  # (n, 3) world, of either sign
    ranges: Array32  # (n,) inf: sky
    body: NDArray[np.int32]
    surface: NDArray[np.int64]  # row of SURFACES, -1: sky
    tint: Array32
    window: Array32  # (n, 4) position on the quadrilateral and its sides [m]
    lit: NDArray[np.bool_]

    @classmethod
    def empty(cls, count: int) -> Samples:
        """`count` samples of the sky."""
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
        """Set the attributes of samples `pick` that edge detection needs."""
        for name in ("points", "normals", "ranges", "body", "surface", "lit"):
            getattr(self, name)[pick] = getattr(other, name)

    def describe(self, pick: NDArray[np.intp], face: NDArray[np.int32], u: Array32, v: Array32, faces: Faces) -> None:
        """Set the face attributes of samples `pick`; normals stay in the frame of the body."""
        describe_hits(
            pick, face, u, v, faces.normal, faces.surface, faces.tint, faces.half, faces.side_m,
            self.normals, self.surface, self.tint, self.window,
        )  # fmt: skip


class CameraScene:
    """Everything a camera can see, prepared for ray casting."""

    def __init__(
        self,
        world: RayScene,
        world_mesh: Mesh,
        bodies: Sequence[Body],
        street: Street,
        light: Light,
        *,
        reflections: bool = False,
    ) -> None:
        """With `reflections` window glass reflects the static world, otherwise the sky alone."""
        self._reflections = reflections
        self.bodies = tuple(bodies)
        self.light = light
        self.street = street
        self._world = world
        self._world_faces = faces_of(world_mesh)
        self._faces = [[faces_of(mesh) for mesh in body.meshes] for body in self.bodies]

    def always_hit(self, index: int, origin: Array64, directions: Array64) -> NDArray[np.bool_]:
        """Mask of the rays (n, 3), in the frame of a body, that hit it in all of its shapes."""
        origins = np.tile(origin.astype(np.float32), (len(directions), 1))
        hit = np.ones(len(directions), dtype=np.bool_)
        for scene in self.bodies[index].scenes:
            hit &= scene.blocked(origins, directions.astype(np.float32), FAR_M)
        return hit

    def sees_sun(self, origin: Array64, stamp_ns: NDArray[np.int64]) -> bool:
        """Whether nothing is between a position (3,) and the sun at a time (1,) [ns]."""
        towards = self.light.sun_direction.astype(np.float32)[None]
        sample = self.trace(origin.astype(np.float32)[None], towards, np.zeros(1, dtype=np.int64), stamp_ns)
        return bool(sample.surface[0] < 0)

    def trace(
        self,
        origins: Array32,
        directions: Array32,
        moment: NDArray[np.int64],
        moment_ns: NDArray[np.int64],
        only: int | None = None,
    ) -> Samples:
        """Cast rays (n, 3) in the world frame; ray i has the time moment_ns[moment[i]]. `only`: against one body."""
        samples = Samples.empty(len(directions))
        samples.directions = directions
        if only is None:
            samples.ranges, face, u, v = self._world.hits(origins, directions, FAR_M)
            samples.ranges[face < 0] = np.inf
            samples.body[face >= 0] = WORLD
            samples.describe(np.arange(len(face)), face, u, v, self._world_faces)
        if only is None:
            self._cast_bodies(origins, samples, moment, moment_ns)
        else:
            self._cast_body(only, np.arange(len(directions)), origins, samples, moment, moment_ns)
        hit_points(origins, directions, samples.ranges, samples.points)
        if self.light.sun_rgb.any():
            self._light_samples(samples, moment_ns)
        return samples

    def radiance(self, samples: Samples, pixel_rad: float) -> Array32:
        """Linear RGB (n, 3)."""
        return self._shade(samples, pixel_rad, self._mirrored(samples, pixel_rad) if self._reflections else NO_MIRROR)

    def _shade(self, samples: Samples, pixel_rad: float, mirrored: Array32) -> Array32:
        s = samples
        return radiance(
            s.directions, s.points, s.normals, s.ranges, s.surface, s.tint, s.window, s.lit,
            pixel_rad, self.street, self.light, mirrored,
        )  # fmt: skip

    def _mirrored(self, samples: Samples, pixel_rad: float) -> Array32:
        """Linear RGB (n, 3) that glass reflects of the static world; -1: the sky, or no glass."""
        mirrored = np.full((len(samples.surface), 3), -1.0, dtype=np.float32)
        glass = np.nonzero(samples.surface == GLASS_ROW)[0]
        if not len(glass):
            return mirrored
        d, n = samples.directions[glass], samples.normals[glass]
        n = n * -np.sign(np.einsum("ni,ni->n", d, n))[:, None].astype(np.float32)
        reflected = d - 2 * np.einsum("ni,ni->n", d, n)[:, None] * n
        origins = samples.points[glass] + (LIFT_M + 2e-5 * samples.ranges[glass])[:, None].astype(np.float32) * n
        found = Samples.empty(len(glass))
        found.directions = reflected
        found.ranges, face, u, v = self._world.hits(origins, reflected, FAR_M)
        found.ranges[face < 0] = np.inf
        found.describe(np.arange(len(face)), face, u, v, self._world_faces)
        hit_points(origins, reflected, found.ranges, found.points)
        if self.light.sun_rgb.any():
            self._light_samples(found, None)
        seen = face >= 0
        found.ranges += samples.ranges[glass]  # the size of a sample and the haze are those of the whole path
        mirrored[glass[seen]] = self._shade(found, pixel_rad, NO_MIRROR)[seen]
        return mirrored

    def _cast_bodies(
        self, origins: Array32, samples: Samples, moment: NDArray[np.int64], moment_ns: NDArray[np.int64]
    ) -> None:
        """Cast the rays that may hit a body: those within a cone that contains it at all times."""
        if not self.bodies or not len(origins):
            return
        low, high = origins.min(axis=0), origins.max(axis=0)
        positions = [body.pose(moment_ns)[1] for body in self.bodies]
        middles = np.array([(t.min(axis=0) + t.max(axis=0)) / 2 for t in positions])
        spreads = np.array([np.linalg.norm(np.ptp(t, axis=0)) / 2 for t in positions])
        towards = middles - (low + high) / 2
        distance = np.maximum(np.linalg.norm(towards, axis=1), 1e-9)
        reach = np.array([body.radius_m for body in self.bodies]) + spreads + np.linalg.norm(high - low) / 2
        cosine = np.sqrt(np.maximum(1 - (reach / distance) ** 2, 0.0)) - 1e-5
        cosine[reach >= distance] = -2.0  # the rays start within its radius
        along = samples.directions @ (towards / distance[:, None]).T.astype(np.float32)
        for index in range(len(self.bodies)):
            candidates = np.nonzero(along[:, index] > cosine[index])[0]
            if len(candidates):
                self._cast_body(index, candidates, origins, samples, moment, moment_ns)

    def _cast_body(
        self,
        index: int,
        candidates: NDArray[np.intp],
        origins: Array32,
        samples: Samples,
        moment: NDArray[np.int64],
        moment_ns: NDArray[np.int64],
    ) -> None:
        """Replace the hits of candidate rays by nearer ones on a body."""
        body = self.bodies[index]
        R, t = body.pose(moment_ns)
        shape_of_moment = np.zeros(len(moment_ns), dtype=np.int64) if body.shape is None else body.shape(moment_ns)
        for shape in np.unique(shape_of_moment):
            active = shape_of_moment == shape
            pick, local_o, local_d = rays_into_body(
                candidates,
                origins,
                samples.directions,
                moment,
                active,
                R,
                t,
                *body.box_m,
                body.radius_m,
                samples.ranges,
            )
            if not len(pick):
                continue
            found, face, u, v = body.scenes[shape].hits(local_o, local_d, FAR_M)
            nearer = (face >= 0) & (found < samples.ranges[pick])
            pick = pick[nearer]
            samples.ranges[pick] = found[nearer]
            samples.body[pick] = index + 1
            samples.describe(pick, face[nearer], u[nearer], v[nearer], self._faces[index][shape])
            rotate_normals(pick, moment, R, samples.normals)

    def _light_samples(self, samples: Samples, moment_ns: NDArray[np.int64] | None) -> None:
        """Mark the samples in direct sun; bodies cast shadows as in the middle of the exposure; None: no bodies."""
        sun = self.light.sun_direction
        pick, origins = shadow_rays(
            samples.points, samples.normals, samples.directions, samples.surface, samples.ranges, sun
        )
        towards = np.tile(sun.astype(np.float32), (len(pick), 1))
        dark = self._world.blocked(origins, towards, SHADOW_REACH_M)
        if moment_ns is None:
            samples.lit[pick] = ~dark
            return
        middle_ns = moment_ns[len(moment_ns) // 2 : len(moment_ns) // 2 + 1]
        now = np.zeros(len(pick), dtype=np.int64)
        active, everything = np.ones(1, dtype=np.bool_), np.arange(len(pick))
        for body in self.bodies:
            R, t = body.pose(middle_ns)
            shape = 0 if body.shape is None else int(body.shape(middle_ns)[0])
            limit = np.where(dark, 0.0, SHADOW_REACH_M).astype(np.float32)
            some, o, d = rays_into_body(
                everything, origins, towards, now, active, R, t, *body.box_m, body.radius_m, limit
            )
            if len(some):
                dark[some] |= body.scenes[shape].blocked(o, d, SHADOW_REACH_M)
        samples.lit[pick] = ~dark
