"""Rectified views: square pinhole images resampled from a fisheye, and the line segments in them.

The optical axis of a view is `off_axis_deg` away from the optical axis of the lens, towards `azimuth_deg` in the image
(0 right, 90 down). Pixel (column u, row v) of a view has the ray

    R_camera_view ((u - c) / f, (v - c) / f, 1),   c = (N - 1) / 2,   f = N / (2 tan(fov / 2))

Source: P IV (three rectified views of 428 x 428 px, lines by LSD). LSD: Grompone von Gioi et al., PAMI 2010, as in
OpenCV.
"""

from __future__ import annotations

import math
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flow.stage import StrictModel
from stages.geometry.frames import Array64
from stages.geometry.lens import Equidistant, KannalaBrandt, OCam

END_NOISE_PX = 0.5  # standard deviation of a segment's end across the segment
RIM_PX = 6  # segments this close to the edge of the field of view are dropped


class ViewDirection(StrictModel):
    """Direction of the optical axis of one rectified view."""

    azimuth_deg: float = Field(ge=-360, le=360)  # in the image: 0 right, 90 down
    off_axis_deg: float = Field(ge=0, le=150)

    def rotation(self) -> Array64:
        """R_camera_view (3, 3): z along the view, y away from the axis of the lens, which is up in the view."""
        azimuth, off = math.radians(self.azimuth_deg), math.radians(self.off_axis_deg)
        c, s = math.cos(azimuth), math.sin(azimuth)
        x = np.array([-s, c, 0.0])
        y = np.array([c * math.cos(off), s * math.cos(off), -math.sin(off)])
        return np.stack([-x, y, np.cross(-x, y)], axis=1)


class RectifiedView:
    """One pinhole view of a fisheye image, with its remap table."""

    def __init__(
        self,
        direction: ViewDirection,
        lens: Equidistant | KannalaBrandt | OCam,
        R_mount_camera: Array64,
        size_px: int,
        fov_deg: float,
    ) -> None:
        self._focal_px = size_px / (2 * math.tan(math.radians(fov_deg) / 2))
        self._centre_px = (size_px - 1) / 2
        R_camera_view = direction.rotation()
        self.R_mount_view: Array64 = R_mount_camera @ R_camera_view
        v, u = np.mgrid[0:size_px, 0:size_px]
        pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
        found = lens.project(self._rays(pixels) @ R_camera_view.T).astype(np.float32)
        visible = np.isfinite(found).all(axis=1).reshape(size_px, size_px)
        self._map = np.where(np.isfinite(found), found, -1e4).astype(np.float32).reshape(size_px, size_px, 2)
        rim = np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), dtype=np.uint8)
        self._inside = cv2.erode(visible.astype(np.uint8), rim, borderType=cv2.BORDER_REPLICATE).astype(np.bool_)
        self._detector = cv2.createLineSegmentDetector()

    @property
    def visible_share(self) -> float:
        """Share of the view inside the field of view of the lens."""
        return float(self._inside.mean())

    def rectify(self, grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The view (N, N) of a fisheye image."""
        view = cv2.remap(grey, self._map, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)  # pyright: ignore
        return np.asarray(view, dtype=np.uint8)

    def segments(self, view: NDArray[np.uint8], min_length_px: float, max_lines: int) -> Array64:
        """The longest `max_lines` segments (n, 4) u1, v1, u2, v2 of at least `min_length_px`, longest first."""
        raw = cast("NDArray[np.float32] | None", self._detector.detect(view)[0])
        if raw is None:
            return np.empty((0, 4))
        found = np.asarray(raw, dtype=np.float64).reshape(-1, 4)
        length = segment_length_px(found)
        pixel = np.clip(np.rint(found), 0, len(self._inside) - 1).astype(np.int64)
        inside = self._inside[pixel[:, 1], pixel[:, 0]] & self._inside[pixel[:, 3], pixel[:, 2]]
        kept = np.flatnonzero(inside & (length >= min_length_px))
        order = np.argsort(-length[kept], kind="stable")[:max_lines]
        return found[kept[order]]

    def ends(self, segments: Array64) -> Array64:
        """Unit rays (n, 2, 3) of the ends of segments (n, 4), in the axes of the camera mount."""
        return self.directions(segments.reshape(-1, 2)).reshape(-1, 2, 3)

    def directions(self, pixels: Array64) -> Array64:
        """Unit rays (n, 3) of pixels (n, 2) u, v, in the axes of the camera mount."""
        rays = self._rays(pixels) @ self.R_mount_view.T
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def _rays(self, pixels: Array64) -> Array64:
        return np.column_stack([(pixels - self._centre_px) / self._focal_px, np.ones(len(pixels))])

    def normal_sigma_rad(self, segments: Array64) -> Array64:
        """(n,) sigma of the rotation of a segment's great circle about its middle: sqrt(2) end noise / length."""
        return math.sqrt(2.0) * END_NOISE_PX / segment_length_px(segments)


def segment_length_px(segments: Array64) -> Array64:
    """(n,) lengths of segments (n, 4)."""
    return np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])


def great_circles(ends: Array64) -> Array64:
    """Unit normals (n, 3) of the planes through the lens and each pair of rays (n, 2, 3)."""
    normal = np.cross(ends[:, 0], ends[:, 1])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)
