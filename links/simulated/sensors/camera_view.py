"""One camera frame as linear radiance: one ray per pixel, more where one is not enough.

Source: ours. Pixels on edges, on moving bodies, and pixels that move during the exposure are averaged over 4 or 16
jittered rays, distributed over the exposure as well: anti-aliasing and motion blur in one step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from links.simulated.kernels.camera_image import FEW, pixel_rays
from links.simulated.kernels.camera_rays import edges, image_motion
from links.simulated.kernels.ray_casting import Array32
from links.simulated.sensors.camera_rays import LEAF_ROW, WORLD, CameraScene, Samples
from stages.geometry.frames import Array64
from stages.geometry.lens import Equidistant, KannalaBrandt, OCam

BATCH_RAYS = 262_144
MANY = 16  # rays through a pixel that needs more than FEW
BLUR_PX = 0.5  # a pixel that moves more than this during the exposure is averaged over it
LONG_BLUR_PX = 2.0
TINY_PX = 16.0  # the first rays may miss a small body whose apparent radius is below this
SPEED_MPS = 15.0  # speed bound of small bodies, for the margin around them

Poses = Callable[
    [NDArray[np.int64]], tuple[Array64, Array64]
]  # times (n,) [ns] -> R (n, 3, 3), t (n, 3) of T_world_camera


class RenderRays:
    """Rays of all pixels within the lens circle, in the camera frame, and their derivatives over a pixel."""

    def __init__(self, lens: Equidistant | KannalaBrandt | OCam, size_px: int) -> None:
        column, row = np.meshgrid(np.arange(size_px, dtype=np.float64), np.arange(size_px, dtype=np.float64))
        pixels = np.column_stack([column.ravel(), row.ravel()])
        rays = lens.unproject(pixels)
        inside = np.nonzero(np.isfinite(rays[:, 0]))[0]
        self.size_px = size_px
        self.rows, self.columns = inside // size_px, inside % size_px
        self.index = np.full((size_px, size_px), -1, dtype=np.int64)
        self.index[self.rows, self.columns] = np.arange(len(inside))
        self.direction = rays[inside].astype(np.float32)
        self.per_column = self._slope(lens, pixels[inside], rays[inside], (1.0, 0.0))
        self.per_row = self._slope(lens, pixels[inside], rays[inside], (0.0, 1.0))
        self.pixel_rad = float(
            np.sqrt(np.mean(np.linalg.norm(self.per_column, axis=1) * np.linalg.norm(self.per_row, axis=1)))
        )
        self.off_axis_rad = np.arctan2(np.hypot(rays[inside, 0], rays[inside, 1]), rays[inside, 2])

    @staticmethod
    def _slope(lens: Any, pixels: Array64, rays: Array64, step: tuple[float, float]) -> Array32:
        """Change of the ray per pixel, from a neighbour within the lens circle."""
        ahead, behind = lens.unproject(pixels + step) - rays, rays - lens.unproject(pixels - np.array(step))
        slope = np.where(np.isfinite(ahead), ahead, behind)
        return np.nan_to_num(slope).astype(np.float32)

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True)
class Shutter:
    """Exposure time of each row; its middle is middle_ns + (row - (rows - 1) / 2) * row_s."""

    middle_ns: int
    exposure_s: float
    row_s: float  # 0: a global shutter

    def moments(self, rows: int, parts: int) -> tuple[NDArray[np.int64], int]:
        """Middles (m,) [ns] of `parts` equal parts of each row's exposure; moments per row (0: common to all rows)."""
        within_s = ((np.arange(parts) + 0.5) / parts - 0.5) * self.exposure_s
        if self.row_s == 0.0:
            return self.middle_ns + np.rint(1e9 * within_s).astype(np.int64), 0
        row_s = (np.arange(rows) - 0.5 * (rows - 1)) * self.row_s
        return self.middle_ns + np.rint(1e9 * (row_s[:, None] + within_s)).astype(np.int64).ravel(), parts


@dataclass(frozen=True)
class View:
    """A camera in its scene."""

    scene: CameraScene
    pixels: RenderRays
    poses: Poses
    own: int  # index of the body that is the platform of the camera
    covered: NDArray[np.bool_]  # (n,) pixels that always show that body


def render(view: View, shutter: Shutter, rng: Generator) -> Array32:
    """Linear RGB (size, size, 3); 0 outside the lens circle."""
    pixels, scene = view.pixels, view.scene
    moment_ns, per_row = shutter.moments(pixels.size_px, 1)
    R, t = view.poses(moment_ns)
    centre = Samples.empty(len(pixels))
    colours = np.empty((len(pixels), 3), dtype=np.float32)
    for only, share in ((None, ~view.covered), (view.own, view.covered)):
        for pick in _batches(np.nonzero(share)[0], 1):
            moment = pixels.rows[pick] * per_row
            samples = scene.trace(*world_rays(pixels, pick, None, moment, R, t), moment, moment_ns, only)
            colours[pick] = scene.radiance(samples, pixels.pixel_rad)
            centre.put(pick, samples)
    few, many = _where_more(view, shutter, centre, colours)
    for pick, rays_each in ((np.nonzero(few & ~many)[0], FEW), (np.nonzero(many)[0], MANY)):
        _refine(view, shutter, pick, rays_each, rng, colours)
    image = np.zeros((pixels.size_px, pixels.size_px, 3), dtype=np.float32)
    image[pixels.rows, pixels.columns] = colours
    return image


def mean_radiance(view: View, stamp_ns: int, step: int = 13) -> float:
    """Light meter: mean over every `step`-th pixel in both directions, without the platform of the camera.

    Each pixel is limited to the radiance of white in full sun.
    """
    pixels, scene = view.pixels, view.scene
    pick = np.nonzero((pixels.rows % step == 0) & (pixels.columns % step == 0) & ~view.covered)[0]
    at = np.array([stamp_ns])
    moment = np.zeros(len(pick), dtype=np.int64)
    samples = scene.trace(*world_rays(pixels, pick, None, moment, *view.poses(at)), moment, at)
    rgb = scene.radiance(samples, step * pixels.pixel_rad)[samples.body != view.own + 1]
    return float(np.minimum(rgb, 1.0).mean(dtype=np.float64)) if len(rgb) else 0.0


def _batches(pick: NDArray[np.intp], rays_each: int) -> list[NDArray[np.intp]]:
    step = max(1, BATCH_RAYS // rays_each)
    return [pick[i : i + step] for i in range(0, len(pick), step)]


def _where_more(
    view: View, shutter: Shutter, centre: Samples, colours: Array32
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks of the pixels that need FEW and MANY more rays."""
    pixels = view.pixels
    few = edges(
        pixels.rows, pixels.columns, pixels.index,
        centre.normals, centre.points, centre.ranges, centre.body, centre.surface, centre.lit, colours, LEAF_ROW,
    )  # fmt: skip
    own = centre.body == view.own + 1
    few |= (centre.body > WORLD) & ~own
    moment_ns, per_row = shutter.moments(pixels.size_px, 1)
    half = round(0.5e9 * shutter.exposure_s)
    first, last = view.poses(moment_ns - half), view.poses(moment_ns + half)
    moved_px = image_motion(centre.points, pixels.rows * per_row, *first, *last) / pixels.pixel_rad
    moved_px[own] = 0.0
    few |= moved_px > BLUR_PX
    many = moved_px > LONG_BLUR_PX
    now = np.array([shutter.middle_ns])
    R, t = (part[0] for part in view.poses(now))
    for index, body in enumerate(view.scene.bodies):
        if body.small and index != view.own:
            towards = R.T @ (body.pose(now)[1][0] - t)
            distance = float(np.linalg.norm(towards))
            reach_m = body.radius_m + 0.5 * shutter.row_s * pixels.size_px * SPEED_MPS
            angle = math.atan2(reach_m, distance) + 3 * pixels.pixel_rad
            if angle < TINY_PX * pixels.pixel_rad:  # the first rays cannot miss a larger one
                many |= pixels.direction @ (towards / distance).astype(np.float32) > math.cos(angle)
    return few, many & ~view.covered


def _refine(
    view: View, shutter: Shutter, pick: NDArray[np.intp], rays_each: int, rng: Generator, colours: Array32
) -> None:
    """Average picked pixels over more rays, each at its own time of the exposure: FEW plus the first one, or MANY."""
    moment_ns, per_row = shutter.moments(view.pixels.size_px, rays_each)
    R, t = view.poses(moment_ns)
    slots = rng.permutation(rays_each)
    kept = 1 if rays_each == FEW else 0
    for some in _batches(pick, rays_each):
        jitter = rng.random((len(some), rays_each, 2), dtype=np.float32)
        moment = (view.pixels.rows[some][:, None] * per_row + slots).ravel()
        rays = world_rays(view.pixels, some, jitter, moment, R, t)
        samples = view.scene.trace(*rays, moment, moment_ns)
        rgb = view.scene.radiance(samples, view.pixels.pixel_rad / math.sqrt(rays_each + kept))
        total = rgb.reshape(len(some), rays_each, 3).sum(axis=1) + kept * colours[some]
        colours[some] = total / np.float32(rays_each + kept)


def world_rays(
    pixels: RenderRays,
    pick: NDArray[np.intp],
    jitter: Array32 | None,
    moment: NDArray[np.int64],
    R: Array64,
    t: Array64,
) -> tuple[Array32, Array32]:
    """Origins and unit directions (n * rays_each, 3) in the world.

    `jitter` (n, rays_each, 2) in [0, 1) moves each ray within its part of the pixel; None: one ray at the centre.
    FEW rays lie on a ring around the centre; MANY are placed so that no two share a row or column of the pixel:
    Kensler, Correlated multi-jittered sampling, Pixar 13-01 (2013), the canonical arrangement.
    """
    placed = np.full((len(pick), 1, 2), 0.5, dtype=np.float32) if jitter is None else jitter
    return pixel_rays(pick, placed, moment, R, t, pixels.direction, pixels.per_column, pixels.per_row)
