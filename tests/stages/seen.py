"""A textured room and the outputs of cameras and LiDAR in it: images, rays of points, swept points."""

from __future__ import annotations

import functools
import math

import cv2
import numpy as np

from stages.geometry.frames import Pose
from stages.geometry.lens import Equidistant, KannalaBrandt
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import Image, SweptPoints

SIZE_PX = 400
HALF_M = np.array([9.0, 7.0, 5.0])
LENS = Equidistant(focal_px=(SIZE_PX / 2 - 2) / math.radians(117.5), centre_px=((SIZE_PX - 1) / 2, (SIZE_PX - 1) / 2))
LOOKS_DOWN = Pose(rpy_deg=(180.0, 0.0, -90.0))
LOOKS_UP = Pose(rpy_deg=(0.0, 0.0, 90.0))
STEP_NS = 66_000_000
PIXEL_RAD = 1.0 / LENS.focal_px


@functools.cache
def walls() -> np.ndarray:
    """(6, 512, 512) grey, smooth enough to be sampled by pixels of half a degree."""
    rng = np.random.default_rng(5)
    coarse = rng.integers(20, 235, (6, 40, 40)).astype(np.uint8)
    return np.stack([cv2.resize(c, (512, 512), interpolation=cv2.INTER_CUBIC) for c in coarse])


@functools.cache
def pixel_rays(size_px: int = SIZE_PX) -> np.ndarray:
    """Rays (n, 3) of a square image by rows; its lens is LENS enlarged."""
    column, row = np.meshgrid(np.arange(size_px, dtype=float), np.arange(size_px, dtype=float))
    return LENS.scaled(size_px / SIZE_PX).unproject(np.column_stack([column.ravel(), row.ravel()]))


def ranges(origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (n,) to the room's walls from inside, and which wall (n,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        away = (np.sign(direction) * HALF_M - origin) / direction
    away[~(away > 0)] = np.inf
    axis = away.argmin(axis=1)
    row = np.arange(len(direction))
    return away[row, axis], 2 * axis + (direction[row, axis] > 0)


def grey_image(R_world_camera: np.ndarray, p_world_m: np.ndarray, seed: int = 0, size_px: int = SIZE_PX) -> np.ndarray:
    """The image of the camera, with a little sensor noise."""
    rays = pixel_rays(size_px)
    inside = np.isfinite(rays[:, 0])
    direction = rays[inside] @ R_world_camera.T
    away, wall = ranges(p_world_m, direction)
    hit = p_world_m + away[:, None] * direction
    axis = wall // 2
    row = np.arange(len(hit))
    u = hit[row, (axis + 1) % 3] / HALF_M[(axis + 1) % 3]
    v = hit[row, (axis + 2) % 3] / HALF_M[(axis + 2) % 3]
    grey = np.zeros(len(rays))
    column, line = np.clip(255.0 * u + 255.5, 0, 510.999), np.clip(255.0 * v + 255.5, 0, 510.999)
    i, j = line.astype(int), column.astype(int)
    a, b, paint = line - i, column - j, walls().astype(float)
    shades = (1 - a) * ((1 - b) * paint[wall, i, j] + b * paint[wall, i, j + 1])
    shades += a * ((1 - b) * paint[wall, i + 1, j] + b * paint[wall, i + 1, j + 1])
    grey[inside] = shades + np.random.default_rng(seed).normal(0.0, 1.0, len(shades))
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8).reshape(size_px, size_px)


def image(
    stamp_ns: int, R_world_carrier: np.ndarray, p_world_m: np.ndarray, mount: Pose, name: str = "camera"
) -> Image:
    """The image of a camera mounted at its camera_mount's origin."""
    R = R_world_carrier @ mount.matrix()[:3, :3]
    return Image(stamp_ns=stamp_ns, frame_id=name, grey=grey_image(R, np.asarray(p_world_m, float), stamp_ns % 2**31))


def lidar_slice(
    stamp_ns: int, R_world_vehicle: np.ndarray, p_world_m: np.ndarray, seed: int, count: int = 400
) -> SweptPoints:
    """Returns from random directions above the horizon, 2 cm noise, in the vehicle frame."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction[:, 2] = np.abs(direction[:, 2])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    away, _ = ranges(np.asarray(p_world_m, float), direction @ R_world_vehicle.T)
    xyz = direction * (away + rng.normal(0.0, 0.02, count))[:, None]
    return SweptPoints(
        stamp_ns=stamp_ns,
        point_stamp_ns=np.full(count, stamp_ns, dtype=np.int64),
        xyz_vehicle_m=xyz.astype(np.float32),
        laser=np.zeros(count, np.uint8),
        reflectivity=np.zeros(count, np.uint8),
        turntable_rad=np.zeros(count, np.float32),
        pulses=count,
    )


def point_rays(
    count: int, turn_rad, move_m, noise_rad: float = 0.0, outliers: float = 0.0, seed: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rays earlier and later (n, 3), R_later_earlier and t_later [m]: p_later = R p_earlier + t, points all around."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points *= (rng.uniform(4.0, 30.0, count) / np.linalg.norm(points, axis=1))[:, None]
    R, t = exp_rotation(np.asarray(turn_rad, float)), np.asarray(move_m, float)
    moved = points @ R.T + t
    wrong = rng.random(count) < outliers
    moved[wrong] = rng.normal(size=(int(wrong.sum()), 3))
    return shaken(points, noise_rad, rng), shaken(moved, noise_rad, rng), R, t


def shaken(points: np.ndarray, noise_rad: float, rng: np.random.Generator) -> np.ndarray:
    """Unit rays of points (n, 3), each off by this noise on both axes."""
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    rays = rays + noise_rad * rng.normal(size=rays.shape)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def degrees_between(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two vectors [deg]."""
    return math.degrees(math.acos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1.0, 1.0)))


def pinhole(focal_px: float, centre_px: tuple[float, float], max_off_axis_deg: float) -> KannalaBrandt:
    """A pinhole as a Kannala-Brandt lens: tan(theta) by its series, fitted up to the edge."""
    theta = np.linspace(1e-3, math.radians(max_off_axis_deg), 400)
    powers = np.stack([theta**3, theta**5, theta**7, theta**9], axis=1)
    k1, k2, k3, k4 = np.linalg.lstsq(powers, np.tan(theta) - theta, rcond=None)[0]
    return KannalaBrandt(
        focal_px=(focal_px, focal_px), centre_px=centre_px, k=(k1, k2, k3, k4), max_off_axis_deg=max_off_axis_deg
    )


def of(messages, kind):
    """The one message of a type among the outputs, or None."""
    found = [m for m in messages if isinstance(m, kind)]
    assert len(found) < 2
    return found[0] if found else None
