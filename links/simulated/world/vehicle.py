"""Mesh of the ground vehicle, which blocks the lower half of the LiDAR's view.

Source: ours, a compact estate car. Frame: vehicle (origin at the roof camera, x forward, y left, z up).
"""

from __future__ import annotations

import numpy as np

from links.simulated.world.mesh import Mesh, box, merge, rod
from stages.geometry.frames import LidarMount

ROOF_BELOW_CAMERA_M = 0.15
LIDAR_RADIUS_M = 0.052


def vehicle_mesh(camera_height_m: float) -> Mesh:
    """Car body, roof rack and turntable mast; the road is `camera_height_m` below the camera."""
    roof = -ROOF_BELOW_CAMERA_M
    return merge(
        [
            *_car(camera_height_m),
            rod((0.0, 0.0, roof), (0.0, 0.0, 0.25), 0.03, "metal"),  # mast and servo
            box((-0.04, -0.04, -0.03), (0.04, 0.04, 0.03), "metal"),  # camera
        ]
    )


def vehicle_mesh_from_camera(camera_height_m: float, mount: LidarMount) -> Mesh:
    """The vehicle as its roof camera sees it: the LiDAR turns above the camera on an arm that comes from behind.

    The LiDAR is the box within which it turns. Nothing encloses the camera.
    """
    foot = np.array([-0.25, 0.0, -ROOF_BELOW_CAMERA_M])
    turntable = np.array(mount.T_vehicle_turntable.xyz_m)
    axis = mount.T_vehicle_turntable.matrix()[:3, :3]
    lidar = turntable + axis @ [0.0, 0.0, mount.T_turntable_lidar.xyz_m[2]]
    corner = np.array([foot[0], foot[1], turntable[2]])
    return merge(
        [
            *_car(camera_height_m),
            rod(foot, corner, 0.012, "metal"),
            rod(corner, turntable, 0.012, "metal"),
            box(lidar - LIDAR_RADIUS_M, lidar + LIDAR_RADIUS_M, "metal"),
        ]
    )


def _car(camera_height_m: float) -> list[Mesh]:
    roof, road = -ROOF_BELOW_CAMERA_M, -camera_height_m
    belt = road + 0.9
    return [
        box((-2.3, -0.9, road + 0.25), (2.1, 0.9, belt), "paint_light"),
        box((-2.2, -0.85, belt), (0.9, 0.85, roof), "paint_light", taper=0.15),
        box((-0.3, -0.4, roof), (0.3, 0.4, roof + 0.03), "metal"),  # rack plate
    ]
