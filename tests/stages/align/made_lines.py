"""Lines of a street as two fisheyes see them, made without images: outputs of `vp` with errors of known size."""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import rotation_from_rpy_deg, rotation_z
from stages.messages import CameraMount, VanishingDirections

MANHATTAN = (0.0, 90.0)
ATLANTA = (0.0, 90.0, 34.0, 124.0)
CAMPUS = (0.0, 90.0, 61.0)
MS = 1_000_000


def turned(roll_deg: float, pitch_deg: float, yaw_deg: float):
    """R_world_carrier."""
    return rotation_from_rpy_deg((roll_deg, pitch_deg, yaw_deg))


def seen(
    camera_mount: CameraMount,
    R_world_carrier,
    azimuths_deg=MANHATTAN,
    *,
    stamp_ns: int = 0,
    per_direction: int | tuple[int, ...] = 20,
    verticals: int = 15,
    random_lines: int = 0,
    sigma_rad: float = 0.006,
    direction_error_rad: float = 0.0,
    up_error_rad: float = 0.0,
    up_sigma_rad: float = 0.004,
    seed: int = 0,
) -> VanishingDirections:
    """Lines of an image: some per street direction, some upright, some of no direction; the camera points up or down.

    `direction_error_rad` is common to all lines of a direction, `up_error_rad` to the vertical.
    """
    rng = np.random.default_rng([seed, 1 if camera_mount is CameraMount.DRONE else 0, stamp_ns % 2**31])
    up_or_down = 1.0 if camera_mount is CameraMount.VEHICLE else -1.0
    counts = per_direction if isinstance(per_direction, tuple) else (per_direction,) * len(azimuths_deg)
    roll, pitch = np.degrees(rng.normal(0, up_error_rad, 2)).tolist()
    up = rotation_from_rpy_deg((roll, pitch, 0.0))[:, 2]
    directions, normals, ends, owner = [up], [], [], []
    for azimuth, count in zip(azimuths_deg, counts, strict=True):
        h = rotation_z(math.radians(azimuth) + rng.normal(0, direction_error_rad))[:, 0]
        for _ in range(count):
            normals.append(line(h, up_or_down, rng))
            owner.append(len(directions))
        directions.append(h)
    for _ in range(verticals):
        normals.append(line(up, up_or_down, rng))
        owner.append(0)
    for _ in range(random_lines):
        normals.append(line(rotation_z(rng.uniform(0, math.pi))[:, 0], up_or_down, rng))
        owner.append(1)
    for i, (normal, middle) in enumerate(normals):
        along = np.cross(normal, middle)
        half = rng.uniform(0.05, 0.3)
        wrong = rng.normal(0, sigma_rad)
        normals[i] = math.cos(wrong) * normal + math.sin(wrong) * along
        ends.append(
            [math.cos(half) * middle - math.sin(half) * along, math.cos(half) * middle + math.sin(half) * along]
        )
    n = len(directions)
    return VanishingDirections(
        stamp_ns=stamp_ns,
        camera_mount=camera_mount,
        direction=np.array(directions) @ R_world_carrier,
        sigma_rad=np.array([up_sigma_rad, *[0.003] * (n - 1)]),
        is_vertical=np.arange(n) == 0,
        frame=np.array([-1, *(k // 2 for k in range(n - 1))], dtype=np.int64),
        line_normal=np.array(normals).reshape(-1, 3) @ R_world_carrier,
        line_end=np.array(ends).reshape(-1, 2, 3) @ R_world_carrier,
        line_sigma_rad=np.full(len(normals), sigma_rad),
        line_direction=np.array(owner, dtype=np.int64),
        reason="",
    )


def line(direction, up_or_down: float, rng):
    """Normal and middle of a line along `direction`, somewhere above (up_or_down 1) or below the horizon."""
    while True:
        middle = rng.normal(size=3)
        middle /= np.linalg.norm(middle)
        normal = np.cross(direction, middle)
        if up_or_down * middle[2] > -0.3 and np.linalg.norm(normal) > 0.2:
            return normal / np.linalg.norm(normal), middle


def nothing(camera_mount: CameraMount, stamp_ns: int = 0, reason: str = "too few lines") -> VanishingDirections:
    """An image without structure."""
    return VanishingDirections(
        stamp_ns=stamp_ns,
        camera_mount=camera_mount,
        direction=np.zeros((0, 3)),
        sigma_rad=np.zeros(0),
        is_vertical=np.zeros(0, dtype=bool),
        frame=np.zeros(0, dtype=np.int64),
        line_normal=np.zeros((0, 3)),
        line_end=np.zeros((0, 2, 3)),
        line_sigma_rad=np.zeros(0),
        line_direction=np.zeros(0, dtype=np.int64),
        reason=reason,
    )
