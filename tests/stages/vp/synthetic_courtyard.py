"""Images of a chequered courtyard through a fisheye: every edge is parallel to one of its three axes."""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import Pose
from stages.geometry.lens import Equidistant
from stages.messages import Image

SIZE_PX = 480
LENS = Equidistant(focal_px=116.0, centre_px=(239.5, 239.5), max_off_axis_deg=117.5)
HALF_M = np.array([9.0, 6.0, 5.0])  # of the courtyard: ground, walls, and sky above
TILE_M = np.array([4.5, 3.0, 1.7])
LOOKS_UP = Pose(rpy_deg=(0.0, 0.0, 90.0))
LOOKS_DOWN = Pose(rpy_deg=(180.0, 0.0, -90.0))


def courtyard(R_yard_camera, stamp_ns=0, camera_mount="vehicle", seen_m=(0.7, 0.3, -0.2)) -> Image:
    """Image of a camera at `seen_m`, with 3 x 3 samples per pixel."""
    offsets = np.linspace(-1 / 3, 1 / 3, 3)
    column, row = np.meshgrid(np.arange(SIZE_PX, dtype=np.float64), np.arange(SIZE_PX, dtype=np.float64))
    total = np.zeros(SIZE_PX * SIZE_PX)
    for dx in offsets:
        for dy in offsets:
            rays = LENS.unproject(np.stack([(column + dx).ravel(), (row + dy).ravel()], axis=1)) @ R_yard_camera.T
            total += _tiles(rays, np.asarray(seen_m))
    grey = (total / 9).reshape(SIZE_PX, SIZE_PX).astype(np.uint8)
    return Image(stamp_ns=stamp_ns, frame_id=f"camera_{camera_mount}", grey=grey)


def _tiles(rays, at):
    """Brightness along rays (n, 3): walls are chequered, ground and sky plain; 0 outside the lens."""
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (np.sign(rays) * HALF_M - at) / rays
    reach[~np.isfinite(reach)] = np.inf
    wall = np.argmin(reach, axis=1)
    hit = at + rays * reach[np.arange(len(rays)), wall][:, None]
    parity = sum(np.where(wall == axis, 0.0, np.floor(np.nan_to_num(hit[:, axis]) / TILE_M[axis])) for axis in range(3))
    bright = np.where(wall == 2, np.where(rays[:, 2] > 0, 235.0, 40.0), 80.0 + 90.0 * (parity % 2) + 25.0 * wall)
    return np.where(np.isfinite(rays).all(axis=1), bright, 0.0)


def plain(level=128, size_px=SIZE_PX) -> Image:
    """An image of constant brightness."""
    return Image(stamp_ns=5, frame_id="camera_vehicle", grey=np.full((size_px, size_px), level, dtype=np.uint8))
