"""Tables of a lens for images of one size: the ray of each pixel, and the mask of usable pixels.

Source: ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.geometry.lens import Array64, Lens, Polygon
from stages.kernels.vp.arcs import STEP_PX

RIM_PX = 7  # width of the excluded rim of the image circle; more than the diagonal of a table cell


@dataclass(frozen=True)
class PixelRays:
    """Rays and usable pixels of a lens for images of one size."""

    rays: NDArray[np.float32]  # (h / STEP_PX, w / STEP_PX, 3) camera frame, of every STEP_PX-th pixel
    usable: NDArray[np.uint8]  # (h, w) 1 where the scene is visible
    pixel_rad: float  # median angle of a usable pixel


def make_pixel_rays(
    lens: Lens, shape: tuple[int, int], max_off_axis_deg: float | None, masked_px: tuple[Polygon, ...]
) -> PixelRays:
    """Tables for images of `shape` (h, w). Polygons (column, row) mask the body of the vehicle or drone.

    Raises ValueError when no usable pixel is left.
    """
    height, width = shape
    rays = _rays(lens, np.arange(height), np.arange(width))
    rim = np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), dtype=np.uint8)
    usable = cv2.erode(np.isfinite(rays[:, :, 2]).astype(np.uint8), rim)  # the image border is not part of the rim
    if max_off_axis_deg is not None:
        usable[~(rays[:, :, 2] > math.cos(math.radians(max_off_axis_deg)))] = 0
    for polygon in masked_px:
        cv2.fillPoly(usable, [np.round(np.array(polygon)).astype(np.int32)], 0)  # pyright: ignore
    usable = np.ascontiguousarray(usable, dtype=np.uint8)
    table = _rays(lens, np.arange(0, height + STEP_PX, STEP_PX), np.arange(0, width + STEP_PX, STEP_PX))
    return PixelRays(np.nan_to_num(table).astype(np.float32), usable, _pixel_rad(lens, usable))


def _rays(lens: Lens, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Array64:
    """Rays (rows, columns, 3) of a grid of pixels, NaN outside the image circle."""
    column, row = np.meshgrid(columns.astype(np.float64), rows.astype(np.float64))
    return lens.unproject(np.column_stack([column.ravel(), row.ravel()])).reshape(len(rows), len(columns), 3)


def _pixel_rad(lens: Lens, usable: NDArray[np.uint8]) -> float:
    """Square root of the median solid angle of a sample of usable pixels."""
    pixels = 8.0 * np.argwhere(usable[::8, ::8])[:, ::-1].astype(np.float64)
    if len(pixels) == 0:
        raise ValueError("masked_px and max_off_axis_deg leave no usable pixel: draw smaller polygons")
    rays = lens.unproject(pixels)
    right, down = (lens.unproject(pixels + np.array(step)) - rays for step in ((1.0, 0.0), (0.0, 1.0)))
    return float(np.sqrt(np.nanmedian(np.linalg.norm(np.cross(right, down), axis=1))))
