"""Fisheye images rendered from real 360 x 180 panoramas: any rotation, exposure, blur, noise, JPEG, a board, people.

The rotation between two renders of a panorama is exact. The directions of its buildings are labelled: each is a fit to
the lines of undisturbed cube faces (1000 px) within 1 deg of it; fits of one frame are square within 0.35 deg and scatter
by 0.2 deg a line.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from stages.geometry.frames import Pose, quaternions_xyzw, rotation_from_rpy_deg, rotation_z
from stages.geometry.lens import Equidistant, KannalaBrandt
from stages.messages import CameraMount, DroneTilt, Image, VanishingDirections
from stages.vp import GreatCircleVp

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "data" / "panoramas"
# up (3,) in the panorama's axes (x at its middle column, y left, z up), azimuths [deg] of its horizontal frames
LABELS = {
    "112351": ((-0.0164, 0.0067, 0.9998), (66.2,)),
    "112355": ((-0.0031, 0.0260, 0.9997), (23.13,)),
    "112362": ((0.0020, 0.0018, 1.0000), (79.74, 34.3)),
    "112379": ((0.0062, 0.0070, 1.0000), (24.99, 47.06)),
}
KEPT_BACK = "112379"  # no threshold of the detector was chosen with it
R_MOUNT_CAMERA = {
    CameraMount.VEHICLE: rotation_from_rpy_deg((0.0, 0.0, 90.0)),
    CameraMount.DRONE: rotation_from_rpy_deg((180.0, 0.0, -90.0)),
}
TILT_DEG = {CameraMount.VEHICLE: 1.5, CameraMount.DRONE: 8.0}  # of a render against the vertical, one sigma, each axis
NADIR_DEG = 25.0  # the panoramas have no image below the tripod


def fisheye(size_px: int = 720, fov_deg: float = 235.0) -> Equidistant:
    """An equidistant fisheye."""
    middle, edge_rad = (size_px - 1) / 2, math.radians(fov_deg / 2)
    return Equidistant(focal_px=(size_px / 2 - 2) / edge_rad, centre_px=(middle, middle), max_off_axis_deg=fov_deg / 2)


def equisolid(size_px: int, fov_deg: float) -> KannalaBrandt:
    """An equisolid fisheye, r = 2 f sin(theta / 2), by its series to theta^9."""
    middle, edge_rad = (size_px - 1) / 2, math.radians(fov_deg / 2)
    focal_px = (size_px / 2 - 2) / (2.0 * math.sin(edge_rad / 2))
    return KannalaBrandt(
        focal_px=(focal_px, focal_px),
        centre_px=(middle, middle),
        k=(-1 / 24, 1 / 1920, -1 / 322560, 1 / 92897280),
        max_off_axis_deg=fov_deg / 2,
    )


@dataclass(frozen=True)
class Conditions:
    """Lens and disturbances of renders."""

    lens: Equidistant | KannalaBrandt = fisheye()  # noqa: RUF009, it is immutable
    sensor: Callable[[np.ndarray, np.random.Generator], np.ndarray] | None = None  # None: exposure etc. at random
    people: int | None = None  # None: up to three
    boards: int | None = None  # None: one in half of the renders


@dataclass(frozen=True)
class Render:
    """One image, and R_world_mount: world is z up, x along the first frame of the panorama."""

    grey: np.ndarray
    R_world_mount: np.ndarray


def true_directions(name: str) -> np.ndarray:
    """(n, 3) the vertical, then two directions of each frame; world axes."""
    azimuths = LABELS[name][1]
    yaws = [math.radians(a - azimuths[0] + b) for a in azimuths for b in (0.0, 90.0)]
    return np.array([[0.0, 0.0, 1.0], *([math.cos(yaw), math.sin(yaw), 0.0] for yaw in yaws)])


@functools.cache
def _panorama(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Grey image, and R_panorama_world. The hole under the tripod is filled with the grey of its rim."""
    grey = cv2.imread(str(FOLDER / f"chester_{name}.jpg"), cv2.IMREAD_GRAYSCALE)
    height = len(grey)
    hole = round(height * (1.0 - NADIR_DEG / 180.0))
    rim = cv2.GaussianBlur(grey[hole - 8 : hole].astype(np.float32), (0, 0), 120.0)[4]
    grey[hole:] = rim.astype(np.uint8)
    z = np.array(LABELS[name][0])
    z /= np.linalg.norm(z)
    azimuth = math.radians(LABELS[name][1][0])
    x = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    x -= (x @ z) * z
    x /= np.linalg.norm(x)
    return grey, np.column_stack([x, np.cross(z, x), z])


@functools.cache
def _rays(lens: Equidistant | KannalaBrandt) -> np.ndarray:
    """(2 size_px, 2 size_px, 3) float32: two rays per pixel along each axis; NaN outside the lens."""
    size_px = round(2 * lens.centre_px[0]) + 1
    axis = (np.arange(2 * size_px) + 0.5) / 2 - 0.5
    column, row = np.meshgrid(axis, axis)
    rays = lens.unproject(np.column_stack([column.ravel(), row.ravel()]))
    return rays.reshape(2 * size_px, 2 * size_px, 3).astype(np.float32)


def random_rotation(rng: np.random.Generator, camera_mount: CameraMount) -> np.ndarray:
    """R_world_mount: any yaw, tilted as a vehicle or a drone is."""
    tilt = rng.normal(0.0, TILT_DEG[camera_mount], 2)
    return rotation_z(rng.uniform(0.0, 2 * math.pi)) @ rotation_from_rpy_deg((tilt[0], tilt[1], 0.0))


def render(
    name: str,
    camera_mount: CameraMount,
    R_world_mount: np.ndarray,
    rng: np.random.Generator | None = None,
    conditions: Conditions | None = None,
) -> Render:
    """The image of a camera; disturbed if `rng` is given."""
    given = conditions or Conditions()
    grey, R_panorama_world = _panorama(name)
    R_world_camera = R_world_mount @ R_MOUNT_CAMERA[camera_mount]
    eye = _rays(given.lens)
    size_px = len(eye) // 2
    world = eye @ R_world_camera.T.astype(np.float32)
    rays = world @ R_panorama_world.T.astype(np.float32)
    inside = np.isfinite(rays[..., 2])
    rays = np.nan_to_num(rays, nan=0.5)
    height, width = grey.shape
    u = (0.5 - np.arctan2(rays[..., 1], rays[..., 0]) / (2 * math.pi)) * width - 0.5
    v = (0.5 - np.arcsin(np.clip(rays[..., 2], -1.0, 1.0)) / math.pi) * height - 0.5
    image = cv2.remap(grey, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).astype(np.float32)
    if rng is not None:
        for _ in range(rng.integers(0, 4) if given.people is None else given.people):
            _person(image, world, rng)
        for _ in range(int(rng.random() < 0.5) if given.boards is None else given.boards):
            _board(image, np.nan_to_num(eye), rng)
    image[~inside] = 0.0
    image = cv2.resize(image, (size_px, size_px), interpolation=cv2.INTER_AREA)
    if rng is not None:
        image = (given.sensor or _sensor)(image, rng)
    return Render(np.clip(np.round(image), 0, 255).astype(np.uint8), R_world_mount)


def _person(image: np.ndarray, world: np.ndarray, rng: np.random.Generator) -> None:
    """A textured ellipse, 6 to 14 deg wide and three times as high, about the horizon."""
    azimuth, half_rad = rng.uniform(0, 2 * math.pi), math.radians(rng.uniform(3, 7))
    along = np.array([math.cos(azimuth), math.sin(azimuth), rng.uniform(-0.4, 0.1)], dtype=np.float32)
    ahead = world @ along
    across = world @ np.array([-math.sin(azimuth), math.cos(azimuth), 0.0], dtype=np.float32)
    up = world[..., 2] - along[2]
    with np.errstate(invalid="ignore"):
        covered = (ahead > 0) & ((across / half_rad) ** 2 + (up / (3 * half_rad)) ** 2 < 1)
    shade = rng.uniform(20, 220) + 25 * np.sin(40 * up + rng.uniform(0, 6)) * np.sin(31 * across + rng.uniform(0, 6))
    image[covered] = shade[covered]


def _board(image: np.ndarray, rays: np.ndarray, rng: np.random.Generator) -> None:
    """A rectangular board with printed lines, at any angle, 30 to 75 deg off the axis, 25 to 60 deg wide."""
    azimuth, off = rng.uniform(0, 2 * math.pi), math.radians(rng.uniform(30, 75))
    at = np.array([math.cos(azimuth) * math.sin(off), math.sin(azimuth) * math.sin(off), math.cos(off)])
    normal = at + rng.normal(0, 0.4, 3)
    normal /= np.linalg.norm(normal)
    x = np.cross(normal, rng.normal(0, 1, 3))
    x /= np.linalg.norm(x)
    y = np.cross(normal, x)
    half = np.tan(np.radians(rng.uniform(12, 30, 2)))
    with np.errstate(divide="ignore", invalid="ignore"):
        away = (at @ normal) / (rays @ normal.astype(np.float32))
        a = (away * (rays @ x.astype(np.float32)) - at @ x) / half[0]
        b = (away * (rays @ y.astype(np.float32)) - at @ y) / half[1]
        covered = (away > 0) & (np.abs(a) < 1) & (np.abs(b) < 1)
        printed = (np.mod(b * rng.uniform(2, 6), 1.0) < 0.12) | (np.abs(a) > 0.93)
    ground, ink = rng.uniform(120, 240), rng.uniform(10, 90)
    image[covered] = np.where(printed, ink, ground)[covered]


def _sensor(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Exposure, motion blur, defocus, noise and JPEG."""
    image = 255.0 * np.clip(image / 255.0 * rng.uniform(0.5, 1.5), 0.0, 1.0) ** rng.uniform(0.7, 1.4)
    length = int(rng.integers(1, 6))
    if length > 1:
        angle = rng.uniform(0, math.pi)
        kernel = np.zeros((7, 7), dtype=np.float32)
        for step in np.linspace(-0.5, 0.5, 4 * length) * (length - 1):
            kernel[round(3 + step * math.sin(angle)), round(3 + step * math.cos(angle))] += 1
        image = cv2.filter2D(image, -1, kernel / kernel.sum())
    image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.3, 1.2))
    image = image + rng.normal(0, rng.uniform(1, 5), image.shape)
    return jpeg(image, int(rng.integers(50, 96))).astype(np.float32)


def jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    """The image after JPEG compression."""
    grey = np.clip(np.round(image), 0, 255).astype(np.uint8)
    _, packed = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE)


@dataclass(frozen=True)
class DirectionErrors:
    """Directions of one image: error of each to the nearest true one, and its stated sigma."""

    error_deg: np.ndarray
    sigma_deg: np.ndarray
    has_frame: bool  # it has a horizontal pair
    reason: str

    @property
    def within(self) -> bool:
        """Whether every direction is within 3 sigmas."""
        return bool((self.error_deg < 3.0 * self.sigma_deg).all())

    @property
    def wrong(self) -> bool:
        """Whether a direction is more than 2 deg off at a stated sigma below 0.5 deg."""
        return bool(((self.error_deg > 2.0) & (self.sigma_deg < 0.5)).any())


def tilt_at(R_world_drone: np.ndarray, rng: np.random.Generator, stamp_ns: int) -> DroneTilt:
    """The autopilot's tilt with an error of 0.7 deg per axis, stated as 1 deg."""
    up = R_world_drone[2]
    up = up + np.cross(rng.normal(0.0, math.radians(0.7), 3), up)
    return DroneTilt(
        stamp_ns=stamp_ns,
        up_drone=up / np.linalg.norm(up),
        sigma_rad=math.radians(1.0),
        angular_velocity_drone_radps=np.zeros(3),
    )


def direction_errors(found: VanishingDirections, R_world_mount: np.ndarray, truth: np.ndarray) -> DirectionErrors:
    """Errors of the found directions to the nearest true one; truth (n, 3) has the vertical first, world axes."""
    cosine = np.abs(found.direction @ R_world_mount.T @ truth.T)
    cosine = np.where(found.is_vertical[:, None] == (np.arange(len(truth)) == 0), cosine, 0.0)
    error = np.degrees(np.arccos(np.clip(cosine.max(axis=1, initial=0.0), 0.0, 1.0)))
    return DirectionErrors(error, np.degrees(found.sigma_rad), bool((found.frame >= 0).any()), found.reason)


def sensor(gain: float = 1.0, blur_px: float = 0.0, noise: float = 2.0, quality: int = 85):
    """A camera with these properties: exposure, defocus [px, one sigma], noise [grey levels, one sigma], JPEG."""

    def image_of(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        image = 255.0 * np.clip(image / 255.0 * gain, 0.0, 1.0)
        if blur_px:
            image = cv2.GaussianBlur(image, (0, 0), blur_px)
        return jpeg(image + rng.normal(0.0, noise, image.shape), quality).astype(np.float32)

    return image_of


def grd_stage(camera_mount: CameraMount, lens: Equidistant | KannalaBrandt, **settings) -> GreatCircleVp:
    """grd's stage for a camera of the renders."""
    quaternion = quaternions_xyzw(R_MOUNT_CAMERA[camera_mount][None])[0]
    mount = Pose(quaternion_xyzw=tuple(quaternion))
    return GreatCircleVp(camera_mount=camera_mount, T_mount_camera=mount, lens=lens, **settings)


def errors_of_renders(
    name: str,
    camera_mount: CameraMount,
    count: int,
    seed: int,
    tilt: bool = True,
    conditions: Conditions | None = None,
    **settings,
) -> list[DirectionErrors]:
    """Errors of grd on `count` disturbed renders; `tilt`: the drone has the autopilot's tilt."""
    given = conditions or Conditions()
    rng = np.random.default_rng([int(name), camera_mount is CameraMount.DRONE, seed])
    tilts = np.random.default_rng([seed, 1])
    vp, truth, out = grd_stage(camera_mount, given.lens, **settings), true_directions(name), []
    for k in range(count):
        stamp_ns = (k + 1) * 1_000_000_000
        image = render(name, camera_mount, random_rotation(rng, camera_mount), rng, given)
        if tilt and camera_mount is CameraMount.DRONE:
            vp.on_tilt(tilt_at(image.R_world_mount, tilts, stamp_ns))
        found = vp.on_image(Image(stamp_ns=stamp_ns, frame_id=f"camera_{camera_mount.value}", grey=image.grey))
        out.append(direction_errors(found, image.R_world_mount, truth))
    return out
