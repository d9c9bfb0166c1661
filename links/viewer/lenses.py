"""Great-circle arcs as line strips on the unit sphere and in the image.

Source: ours; lenses: stages/geometry/lens.py; a straight line in space is a great circle of rays, P IV.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.geometry.rig import DroneCamera, VehicleCamera

ARC_STEP_RAD = np.deg2rad(4.0)  # spacing of the points of an arc; a fisheye bends a chord by less than 0.1 px


def pixels_of(camera: VehicleCamera | DroneCamera, rays_mount: Array64) -> Array64:
    """Pixels (n, 2) of rays (n, 3) in the mount's axes; NaN for rays outside the field of view."""
    R_mount_camera = camera.pose().matrix()[:3, :3]
    return camera.lens.project(rays_mount @ R_mount_camera)


def arcs(ends: Array64, step_rad: float = ARC_STEP_RAD) -> tuple[Array64, NDArray[np.int64]]:
    """Points (k, 3) on the shorter great-circle arcs between unit rays (m, 2, 3), and the arc index of each point (k,).

    p(s) = a cos(s) + q sin(s), q the unit vector from a towards b, s from 0 to the angle between them.
    """
    a, b = ends[:, 0], ends[:, 1]
    cosine = np.sum(a * b, axis=1, keepdims=True)
    q = b - cosine * a
    sine = np.linalg.norm(q, axis=1, keepdims=True)
    q /= np.maximum(sine, 1e-12)
    angle = np.arctan2(sine, cosine)[:, 0]
    count = 2 + np.floor(angle / step_rad).astype(np.int64)
    arc = np.repeat(np.arange(len(ends)), count)
    nth = np.arange(len(arc)) - np.repeat(np.cumsum(count) - count, count)
    s = (angle[arc] * nth / (count[arc] - 1))[:, None]
    return a[arc] * np.cos(s) + q[arc] * np.sin(s), arc


def strips(points: Array64, arc: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]:
    """Strips of points (k, d): concatenated points (m, d), length of each strip (s,), arc index of each strip (s,).

    A NaN point splits the strip of its arc; a strip of a single point is dropped.
    """
    valid = np.asarray(np.isfinite(points).all(axis=1), dtype=np.bool_)
    begins = np.append([True], (arc[1:] != arc[:-1]) | ~valid[:-1])[: len(points)]
    _, first, strip, length = np.unique(
        np.cumsum(begins)[valid], return_index=True, return_inverse=True, return_counts=True
    )
    drawn = length > 1
    return points[valid][drawn[strip]].astype(np.float32), length[drawn], arc[valid][first[drawn]]
