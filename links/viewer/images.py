"""The sensor's and the detector's images as Rerun shows them: zero is nothing, single pixels stay visible.

Source: ours; geometry of the depth image: `stages.messages.DepthImage`, P III.A.
"""

from __future__ import annotations

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from links.viewer import colours
from stages.messages import DepthImage, LidarFirings, ScoreImage

STEP_M = 0.002  # one count of the u16 images: the VLP-16's own resolution
COLUMNS = 900  # of the range image: 0.4 deg, the spacing of firings at 20 turns a second

# VLP-16 user manual 63-9243, table 9-1: elevation of the 16 lasers in the packet's order.
ELEVATION_DEG = np.array([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])
ROW_OF_LASER = (15 - ELEVATION_DEG) // 2  # top row: the highest beam


def _counts(distance_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    return np.clip(np.nan_to_num(distance_m) / STEP_M + 0.5, 0, 65535).astype(np.uint16)


def _thicken(image: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Give empty pixels their largest neighbour: a lone pixel would vanish when the view is smaller than the image."""
    grown = cv2.dilate(image, np.ones((3, 3), np.uint8))
    return np.where(image > 0, image, grown).astype(np.uint16)


def range_counts(firings: LidarFirings) -> NDArray[np.uint16]:
    """Range by laser (rows, highest beam on top) and azimuth (columns, 0 along +y_lidar); the newest return wins."""
    image = np.zeros((16, COLUMNS), dtype=np.uint16)
    seen = (firings.range_m > 0) & (firings.return_kind == 0)
    column = (firings.azimuth_rad[seen] / (2 * np.pi) * COLUMNS).astype(np.int64) % COLUMNS
    image[ROW_OF_LASER[firings.laser[seen] % 16], column] = _counts(firings.range_m[seen])
    return image


def depth_counts(message: DepthImage) -> NDArray[np.uint16]:
    """Depth in steps of 2 mm; an empty pixel takes its nearest neighbour's depth, if it has one."""
    counts = _counts(message.depth_m)
    nearness = _thicken(np.where(counts > 0, 65535 - counts, 0).astype(np.uint16))
    return np.where(nearness > 0, 65535 - nearness, 0).astype(np.uint16)


def score_counts(message: ScoreImage) -> NDArray[np.uint16]:
    """How drone-like each candidate pixel is: best 65535, worst a fifth of it (logarithmic), no candidate 0."""
    known = np.isfinite(message.score)
    counts = np.zeros(message.score.shape, dtype=np.uint16)
    if known.any():
        worse = np.log1p(message.score[known] - message.score[known].min())
        counts[known] = np.round(65535 * (1 - 0.8 * worse / max(float(worse.max()), 1e-9)))
    return _thicken(counts)


def range_image(firings: LidarFirings) -> rr.Tensor:
    """One slice of firings as a picture; a tensor, because its view stretches 16 rows to a readable height."""
    return rr.Tensor(range_counts(firings), dim_names=("laser", "azimuth"), value_range=(0.0, 60.0 / STEP_M))


def depth_image(message: DepthImage) -> rr.DepthImage:
    """The sweep as a picture; the colours span what it holds, without its farthest 2 %."""
    counts = depth_counts(message)
    far = float(np.percentile(counts[counts > 0], 98)) if counts.any() else 1.0
    colormap = rr.components.Colormap.Turbo
    return rr.DepthImage(counts, meter=1.0 / STEP_M, colormap=colormap, depth_range=(0.0, far))


def score_image(message: ScoreImage) -> rr.DepthImage:
    """The score as a picture."""
    return rr.DepthImage(score_counts(message), colormap=rr.components.Colormap.Inferno, depth_range=(0.0, 65535.0))


def project(image: DepthImage, xyz_vehicle_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Pixels (n, 2) as (u, v) with the top left corner at 0, and which of them lie in the image. P III.A."""
    height_px, width_px = image.depth_m.shape
    ray = xyz_vehicle_m - image.origin_vehicle_m
    above = ray[:, 2] > 0
    pixels = image.focal_px * ray[:, :2] / np.where(above, ray[:, 2], 1.0)[:, None] + [width_px / 2, height_px / 2]
    inside = above & (pixels >= 0).all(axis=1) & (pixels < [width_px, height_px]).all(axis=1)
    return pixels, inside


def axes(image: DepthImage) -> rr.Arrows2D:
    """Where the vehicle's forward and left point in the image."""
    height_px, width_px = image.depth_m.shape
    corner = [[0.03 * width_px, 0.03 * height_px]] * 2
    return rr.Arrows2D(
        origins=corner,
        vectors=[[0.12 * width_px, 0.0], [0.0, 0.12 * height_px]],
        colors=colours.AXES[:2],
        labels=["forward", "left"],
        show_labels=True,
        draw_order=40,
    )
