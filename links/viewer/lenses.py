"""The cameras as the viewer needs them, and great-circle arcs as strips: on the unit sphere, and through a lens.

Source: ours; lenses: stages/geometry/lens.py; a line of the world is a great circle of rays, P IV.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from stages.geometry.frames import Array64, Pose
from stages.geometry.lens import Lens
from stages.messages import CameraMount

STEP_RAD = np.deg2rad(4.0)  # between points of an arc; a fisheye bends it by less than a tenth of a pixel within that


class _Camera(BaseModel):
    """One camera of the rig file. Its other keys are for the stages."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    lens: Lens
    size_px: int | None = Field(None, ge=1)  # of the square pictures that the lens was calibrated with

    def pose(self) -> Pose:
        raise NotImplementedError


class VehicleCamera(_Camera):
    """The camera on the vehicle."""

    T_vehicle_camera: Pose

    def pose(self) -> Pose:
        """T_mount_camera."""
        return self.T_vehicle_camera


class DroneCamera(_Camera):
    """The camera under the drone."""

    T_drone_camera: Pose

    def pose(self) -> Pose:
        """T_mount_camera."""
        return self.T_drone_camera


class Cameras(BaseModel):
    """The rig file's `cameras:`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    vehicle: VehicleCamera | None = None
    drone: DroneCamera | None = None

    def of(self, camera_mount: CameraMount) -> VehicleCamera | DroneCamera | None:
        """The camera on this camera_mount."""
        return self.vehicle if camera_mount is CameraMount.VEHICLE else self.drone

    def named(self) -> list[str]:
        """Frame ids of the pictures."""
        return [f"camera_{camera_mount.value}" for camera_mount in CameraMount if self.of(camera_mount) is not None]


def pixels_of(camera: VehicleCamera | DroneCamera, rays_carrier: Array64) -> Array64:
    """Pixels (n, 2) of rays (n, 3) in the camera_mount's axes; NaN where the lens does not see them."""
    R_carrier_camera = camera.pose().matrix()[:3, :3]
    return camera.lens.project(rays_carrier @ R_carrier_camera)


def arcs(ends: Array64, step_rad: float = STEP_RAD) -> tuple[Array64, NDArray[np.int64]]:
    """Points (k, 3) on the shorter great-circle arcs between unit rays (m, 2, 3), and which arc each is of (k,).

    p(s) = a cos(s) + q sin(s), q the unit vector from a towards b, s from 0 to the angle between them.
    """
    a, b = ends[:, 0], ends[:, 1]
    along = np.sum(a * b, axis=1, keepdims=True)
    q = b - along * a
    across = np.linalg.norm(q, axis=1, keepdims=True)
    q /= np.maximum(across, 1e-12)
    angle = np.arctan2(across, along)[:, 0]
    count = 2 + np.floor(angle / step_rad).astype(np.int64)
    arc = np.repeat(np.arange(len(ends)), count)
    nth = np.arange(len(arc)) - np.repeat(np.cumsum(count) - count, count)
    s = (angle[arc] * nth / (count[arc] - 1))[:, None]
    return a[arc] * np.cos(s) + q[arc] * np.sin(s), arc


def strips(points: Array64, arc: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]:
    """Points (m, d) of points (k, d) strip after strip, how many each strip has (s,), and the arc that it is of (s,).

    A point that is NaN breaks its arc's strip, one that is then alone is none.
    """
    seen = np.asarray(np.isfinite(points).all(axis=1), dtype=np.bool_)
    begins = np.append([True], (arc[1:] != arc[:-1]) | ~seen[:-1])[: len(points)]
    _, first, strip, length = np.unique(
        np.cumsum(begins)[seen], return_index=True, return_inverse=True, return_counts=True
    )
    drawn = length > 1
    return points[seen][drawn[strip]].astype(np.float32), length[drawn], arc[seen][first[drawn]]
