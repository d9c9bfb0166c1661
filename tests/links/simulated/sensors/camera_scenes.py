"""Small scenes with known objects at known positions, for the tests of the camera."""

from __future__ import annotations

import numpy as np

from links.simulated.sensors.camera import Camera, CameraSettings, CamerasSettings, build_cameras
from links.simulated.sensors.camera_paint import Street
from links.simulated.world.drone import DroneModel
from links.simulated.world.mesh import box, merge
from links.simulated.world.path import Path, Waypoint
from links.simulated.world.scene import Scene, Truth, drone_shapes
from links.simulated.world.vehicle import vehicle_mesh, vehicle_mesh_from_camera
from links.simulated.world.weather import Weather
from stages.geometry.frames import LidarMount, Pose

START_NS = 1_750_000_000_000_000_000
HEIGHT_M = 1.8
MOUNT = LidarMount(T_vehicle_turntable=Pose(xyz_m=(0, 0, 0.25)), T_turntable_lidar=Pose(xyz_m=(0, 0, 0.1)))
QUIET = {"read_noise_e": 0.0, "shot_noise": False, "vignetting": 0.0, "jpeg_quality": 100}


def still(xyz_m=(0.0, 0.0, 0.0), yaw_deg=0.0):
    return Path(waypoints=(Waypoint(t_s=0.0, xyz_m=xyz_m, yaw_deg=yaw_deg),))


def moving(first, last, yaw_deg=(0.0, 0.0), duration_s=1.0):
    a = Waypoint(t_s=0.0, xyz_m=first, yaw_deg=yaw_deg[0])
    return Path(waypoints=(a, Waypoint(t_s=duration_s, xyz_m=last, yaw_deg=yaw_deg[1])))


def cube(centre, half_m=0.2, surface="latex"):
    return box(np.subtract(centre, half_m), np.add(centre, half_m), surface)


def ground():
    return box((-80, -80, -HEIGHT_M - 0.1), (80, 80, -HEIGHT_M), "concrete")


def scene_cameras(objects, vehicle=None, drone=None, weather=None, seed=1, **settings) -> dict[str, Camera]:
    """Both cameras (the drone's when there is one) in a world of `objects` on flat ground."""
    truth = Truth(START_NS, vehicle or still(), drone)
    shapes = drone_shapes(0.5, DroneModel()) if drone else ()
    scene = Scene(merge([ground(), *objects]), vehicle_mesh(HEIGHT_M), shapes, truth)
    one = CameraSettings.model_validate({"size_px": 360, "sensor": QUIET} | settings)
    seen = vehicle_mesh_from_camera(HEIGHT_M, MOUNT)
    street = Street(0.0, 0.0, -HEIGHT_M, 0.0)
    settings = CamerasSettings(vehicle=one, drone=one if drone else None)
    cameras = build_cameras(settings, scene, street, weather or Weather(), seen, START_NS, seed)
    return dict(zip(("vehicle", "drone"), cameras, strict=False))


def pixel_of(camera, point_world_m, stamp_ns):
    """Pixel of a world point at a time, by the lens model."""
    R, t = camera.T_world_camera(np.array([stamp_ns]))
    ray = R[0].T @ (np.asarray(point_world_m, dtype=np.float64) - t[0])
    return camera.settings.true_lens.project(ray[None])[0]


def centroid(weight):
    """(column, row) of a weight image."""
    row, column = np.mgrid[: weight.shape[0], : weight.shape[1]]
    return np.array([(weight * column).sum(), (weight * row).sum()]) / weight.sum()


def redness(image):
    """Fraction of a red object in each pixel; 0 for grey, green and blue."""
    red, green, blue = image.astype(np.float64).transpose(2, 0, 1)
    excess = red - np.maximum(green, blue)
    return np.where(excess > 25, excess, 0.0)
