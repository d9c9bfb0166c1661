"""Images of synthetic streets through any lens: walls with windows, a kerb, sky. Four rays per pixel."""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import rotation_from_rpy_deg
from stages.geometry.lens import Equidistant
from stages.kernels.geometry.so3 import exp_rotation

SKY, WALL, WINDOW, ROAD, STRIPE = 180.0, 120.0, 50.0, 70.0, 150.0
LOOKS_UP = rotation_from_rpy_deg((0.0, 0.0, 90.0))  # R_vehicle_camera: image top forward, right is left
LOOKS_DOWN = rotation_from_rpy_deg((180.0, 0.0, -90.0))


def fisheye(size_px: int = 480) -> Equidistant:
    middle = (size_px - 1) / 2
    return Equidistant(focal_px=(size_px / 2 - 2) / np.radians(117.5), centre_px=(middle, middle))


def street(R_world_camera, lens, size_px=480, wall_turns_deg=(0.0, 0.0), noise=1.0, up_m=2.0, seed=0, row_turn=None):
    """Grey image of a street along x; its left and right walls are rotated, each by its own angle.

    The camera is `up_m` over the road; the walls stand 7 m away and are 10 m high. `row_turn` (3,) [rad]: how the
    camera turns from row to row, its own axes; R_world_camera is its rotation at the middle row.
    """
    middle = 0.5 * (size_px - 1)
    turns = [np.eye(3) if row_turn is None else exp_rotation((k - middle) * row_turn) for k in range(size_px)]
    column, row = np.meshgrid(np.arange(size_px), np.arange(size_px))
    total = np.zeros((size_px, size_px))
    for dx, dy in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        pixels = np.column_stack([column.ravel() + dx, row.ravel() + dy]).astype(np.float64)
        rays = lens.unproject(pixels).reshape(size_px, size_px, 3) @ np.swapaxes(turns, 1, 2)
        total += _grey(rays.reshape(-1, 3) @ R_world_camera.T, wall_turns_deg, up_m).reshape(total.shape) / 4
    total += np.random.default_rng(seed).normal(0.0, noise, total.shape)
    return np.clip(np.round(total), 0, 255).astype(np.uint8)


def _grey(rays, wall_turns_deg, up_m):
    out = np.where(np.isnan(rays[:, 0]), 0.0, SKY)
    nearest = np.full(len(rays), 1e9)
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = -up_m / rays[:, 2]
        hit = (ground > 0) & (ground < 60)
        y = ground * rays[:, 1]
        out = np.where(hit, np.where(np.abs(np.abs(y) - 3.0) < 0.15, STRIPE, ROAD), out)
        nearest = np.where(hit, ground, nearest)
        for side, turn_deg in zip((1.0, -1.0), wall_turns_deg, strict=True):
            turn = np.radians(turn_deg)
            across = side * np.array([-np.sin(turn), np.cos(turn), 0.0])
            along = np.array([np.cos(turn), np.sin(turn), 0.0])
            away = 7.0 / (rays @ across)
            x, z = away * (rays @ along), away * rays[:, 2] + up_m
            hit = (away > 0) & (away < nearest) & (z > 0) & (z < 10.0) & (np.abs(x) < 40)
            window = (np.mod(x, 4.0) < 1.6) & (np.mod(z - 1.0, 3.0) < 1.7) & (z > 1.0)
            out = np.where(hit, np.where(window, WINDOW, WALL + 20 * side), out)
            nearest = np.where(hit, away, nearest)
    return out


def foliage(size_px=480, seed=0):
    """Blobs of all sizes and no straight line."""
    rng = np.random.default_rng(seed)
    spectrum = np.fft.fft2(rng.normal(size=(size_px, size_px)))
    frequency = np.hypot(np.fft.fftfreq(size_px)[:, None], np.fft.fftfreq(size_px)[None])
    field = np.real(np.fft.ifft2(spectrum * np.exp(-((frequency / 0.06) ** 2))))
    field = field / field.std()
    return np.clip(128 + 90 * np.tanh(2 * field) + rng.normal(0, 1, field.shape), 0, 255).astype(np.uint8)
