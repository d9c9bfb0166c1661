"""A vehicle and a drone on a synthetic path: outputs of their sensors, image by image, without noise."""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import rotation_from_rpy_deg, rotation_z
from stages.messages import CameraMount, DroneFix, VanishingDirections, VehicleMotion, VisualMotion

START_NS = 1_700_000_000 * 10**9
PERIOD_NS = 100_000_000


def image_ns(k: int) -> int:
    return START_NS + k * PERIOD_NS


class Flight:
    """The drone flies straight and may turn, the vehicle drives along x and may turn; both at image k."""

    def __init__(self, drone_yaw_deg=0.0, speed_mps=(2.0, 1.0, 0.1), vehicle_mps=0.5, vehicle_dps=5.0, drone_dps=0.0):
        self.drone_yaw_deg, self.speed_mps = drone_yaw_deg, np.array(speed_mps)
        self.vehicle_mps, self.vehicle_dps, self.drone_dps = vehicle_mps, vehicle_dps, drone_dps

    def R_vehicle(self, k):
        return rotation_z(np.radians(self.vehicle_dps * 0.1 * k))

    def t_vehicle(self, k):
        return np.array([self.vehicle_mps * 0.1 * k, 0.0, 0.0])

    def R_drone(self, k):
        return rotation_from_rpy_deg((3.0, -2.0, self.drone_yaw_deg + self.drone_dps * 0.1 * k))

    def t_drone(self, k):
        return np.array([4.0, 2.0, 12.0]) + self.speed_mps * 0.1 * k

    def R_vehicle_drone(self, k):
        return self.R_vehicle(k).T @ self.R_drone(k)

    def fix(self, k, track_id=1) -> DroneFix:
        return DroneFix(
            stamp_ns=image_ns(k),
            xyz_vehicle_m=self.R_vehicle(k).T @ (self.t_drone(k) - self.t_vehicle(k)),
            covariance_m2=0.01 * np.eye(3),
            hits=5,
            track_id=track_id,
        )

    def vehicle(self, k) -> VehicleMotion:
        return VehicleMotion(
            stamp_ns=image_ns(k), xyz_map_m=self.t_vehicle(k), R_map_vehicle=self.R_vehicle(k), covariance=None
        )

    def motion(self, i, j) -> VisualMotion:
        step = self.R_drone(i).T @ (self.t_drone(j) - self.t_drone(i))
        length = np.linalg.norm(step)
        return VisualMotion(
            stamp_ns=image_ns(j),
            from_ns=image_ns(i),
            R_from_to=self.R_drone(i).T @ self.R_drone(j),
            covariance_rad2=1e-6 * np.eye(3),
            direction_from=step / length if length > 1e-9 else None,
            direction_sigma_rad=0.02 if length > 1e-9 else None,
            matches=100,
            reason="",
        )

    def seen(self, camera_mount, k) -> VanishingDirections:
        """The world's axes, a row each, in the camera_mount's."""
        R = self.R_vehicle(k) if camera_mount is CameraMount.VEHICLE else self.R_drone(k)
        return vanishing(camera_mount, image_ns(k), R)


def vanishing(camera_mount, stamp_ns, directions, reason="") -> VanishingDirections:
    found = np.asarray(directions, dtype=np.float64).reshape(-1, 3)
    n = len(found)
    return VanishingDirections(
        stamp_ns=stamp_ns,
        camera_mount=camera_mount,
        direction=found,
        sigma_rad=np.full(n, 0.01),
        is_vertical=np.zeros(n, dtype=np.bool_),
        frame=np.zeros(n, dtype=np.int64),
        line_normal=np.empty((0, 3)),
        line_end=np.empty((0, 2, 3)),
        line_sigma_rad=np.empty(0),
        line_direction=np.empty(0, dtype=np.int64),
        reason=reason,
    )
