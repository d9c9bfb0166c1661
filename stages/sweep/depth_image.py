"""The depth image: the returns of a sweep as a pinhole image from the turntable, looking up.

A plane at height h above the turntable is divided into N x N pixels of size res, so that focal_px = h / res; for a
field of view of 2 theta_max, focal_px = N / (2 tan theta_max). Depth is height above the turntable; a pixel keeps the
nearest of its returns.

Source: P III.A; DESIGN, "Depth image N=512, FOV 2 theta_max = 120 deg".
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.kernels.sweep.depth_image import keep_nearest
from stages.messages import DepthImage


def focal_length_px(size_px: int, fov_deg: float) -> float:
    """Focal length N / (2 tan(fov / 2)) [px]: pixels per unit of x / z."""
    return size_px / (2.0 * math.tan(math.radians(fov_deg) / 2.0))


def unproject(image: DepthImage, row: int, column: int) -> NDArray[np.float64]:
    """The point (3,) [m], vehicle frame, at the centre of a pixel and its depth."""
    height, width = image.depth_m.shape
    depth = float(image.depth_m[row, column])
    x = (column + 0.5 - width / 2) / image.focal_px * depth
    y = (row + 0.5 - height / 2) / image.focal_px * depth
    return image.origin_vehicle_m + np.array([x, y, depth])


class DepthCanvas:
    """A depth image drawn slice by slice, so that the end of a sweep needs no extra computation."""

    def __init__(self, size_px: int, fov_deg: float, origin_vehicle_m: NDArray[np.float64]) -> None:
        self._size_px = size_px
        self._focal_px = focal_length_px(size_px, fov_deg)
        self._origin_vehicle_m = origin_vehicle_m
        self.clear()

    def clear(self) -> None:
        """Start an empty image."""
        self._depth_m = np.zeros((self._size_px, self._size_px), dtype=np.float32)
        self._start_ns: int | None = None
        self._points = self._returns = self._lost_packets = 0

    def draw(self, first_pulse_ns: int, xyz_vehicle_m: NDArray[np.float32], lost_packets: int) -> None:
        """Add the returns (n, 3) of one slice."""
        if self._start_ns is None:
            self._start_ns = first_pulse_ns
            lost_packets = 0  # lost before the sweep, not within it
        self._points += keep_nearest(xyz_vehicle_m, self._origin_vehicle_m, self._focal_px, self._depth_m)
        self._returns += len(xyz_vehicle_m)
        self._lost_packets += lost_packets

    def take(self, end_ns: int, turned_rad: float) -> DepthImage:
        """Return the image drawn so far and start an empty one."""
        image = DepthImage(
            stamp_ns=end_ns,
            start_ns=end_ns if self._start_ns is None else self._start_ns,
            depth_m=self._depth_m,
            focal_px=self._focal_px,
            origin_vehicle_m=self._origin_vehicle_m,
            points=self._points,
            returns=self._returns,
            turned_rad=turned_rad,
            lost_packets=self._lost_packets,
        )
        self.clear()
        return image
