"""Where a camera sees its own platform: the mask that a user would draw for the rig file.

    masked_px           polygons (column, row) around parts in the view: mast, LiDAR, landing gear
    max_off_axis_deg    beyond this angle the platform fills most of the ring

Source: ours. Without a mask the edges of the platform's roof count as lines of the street.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from links.simulated.world.mesh import Mesh, RayScene
from stages.geometry.frames import Pose
from stages.geometry.lens import Lens

GRID = 360  # rays across the image
REACH_M = 5.0
MARGIN = 2  # grid cells, for moving parts and a coarse mask
MOST_OF_A_RING = 0.6
CORNER_PX = 1.0  # grid cells: tolerance of the polygons
RING_DEG = 0.5
MARGIN_DEG = 1.0


def own_body(
    lens: Lens, size_px: int, T_mount_camera: Pose, meshes: Iterable[Mesh]
) -> tuple[list[list[list[float]]], float]:
    """(masked_px, max_off_axis_deg) of a square image; the meshes are the moving platform in its own frame."""
    step = size_px / GRID
    at = (np.arange(GRID) + 0.5) * step - 0.5
    column, row = np.meshgrid(at, at)
    rays = lens.unproject(np.column_stack([column.ravel(), row.ravel()]).astype(np.float64))
    inside = np.isfinite(rays[:, 0])
    T = T_mount_camera.matrix()
    directions = (rays[inside] @ T[:3, :3].T).astype(np.float32)
    origins = np.tile(T[:3, 3], (len(directions), 1)).astype(np.float32)
    own = np.zeros(GRID * GRID, dtype=np.uint8)
    for mesh in meshes:
        own[inside] |= np.isfinite(RayScene(mesh).cast(origins, directions, REACH_M)[0])
    kernel = np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), dtype=np.uint8)
    own = cv2.dilate(own.reshape(GRID, GRID), kernel)
    off_deg = np.full(GRID * GRID, np.inf)
    off_deg[inside] = np.degrees(np.arctan2(np.hypot(rays[inside, 0], rays[inside, 1]), rays[inside, 2]))
    off_deg = off_deg.reshape(GRID, GRID)
    widest = limit = float(off_deg[np.isfinite(off_deg)].max())
    while own[(off_deg > limit - RING_DEG) & (off_deg <= limit)].mean() > MOST_OF_A_RING:
        limit -= RING_DEG
    limit -= MARGIN_DEG if limit < widest else 0.0
    own[off_deg > limit] = 0
    polygons = []
    for outline in cv2.findContours(own, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]:
        corners = cv2.approxPolyDP(outline, CORNER_PX, True)[:, 0]
        if len(corners) >= 3:
            polygons.append(np.round((corners + 0.5) * step - 0.5, 1).tolist())
    return polygons, round(limit, 1)
