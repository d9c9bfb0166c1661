"""Meshes of drones: body, arms, motors, rotor blades and legs, with gaps that a beam passes through.

Source: ours. `x4` has the proportions of a 0.5 m class quadrotor; `folding` those of a 0.35 m class camera drone with a
long, closed body; `hexa` those of a 0.8 m class hexarotor with tall legs and a payload. Any shape may have any span.
Frame: drone (x forward, y left, z up).
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from flow.stage import StrictModel
from links.simulated.world.mesh import Mesh, box, merge, quads, rod

BLADES = 2  # per rotor
Shape = Literal["x4", "folding", "hexa"]
Surface = Literal["carbon", "dark_shell", "grey_shell", "light_shell"]
SPAN_M: dict[Shape, float] = {"x4": 0.5, "folding": 0.35, "hexa": 0.8}  # nominal span of each shape


class DroneModel(StrictModel):
    """Shape and surface of the drone. Its span is a separate setting, `drone.span_m`."""

    shape: Shape = "x4"
    # reflectivity at 903 nm: 0.12, 0.06, 0.20, 0.60; the LiDAR loses half of the hits near 40, 30, 45, 80 m
    surface: Surface = "carbon"


def drone_mesh(span_m: float, rotor_rad: float = 0.0, model: DroneModel | None = None) -> Mesh:
    """The drone, `span_m` across from blade tip to blade tip, with its blades at `rotor_rad`."""
    model = model or DroneModel()
    return {"x4": _x4, "folding": _folding, "hexa": _hexa}[model.shape](span_m, rotor_rad, model.surface)


def _x4(span_m: float, rotor_rad: float, surface: str) -> Mesh:
    size = span_m / 0.5
    blade, arm = 0.09 * size, 0.16 * size
    parts = [
        _box(size, (-0.085, -0.055, -0.03), (0.085, 0.055, 0.025), surface),
        _box(size, (-0.06, -0.03, 0.025), (0.06, 0.03, 0.055), surface),  # battery
        _box(size, (0.03, -0.025, -0.08), (0.08, 0.025, -0.03), surface),  # camera
    ]
    up = np.array([0.0, 0.0, size])
    for index, angle in enumerate(np.radians([45.0, 135.0, 225.0, 315.0])):
        outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
        motor = arm * outwards
        parts.append(rod(0.05 * size * outwards, motor, 0.010 * size, surface, sides=4))
        parts.append(rod(motor - 0.012 * up, motor + 0.025 * up, 0.014 * size, surface))
        parts.append(_blades(motor + 0.03 * up, blade, (1 if index % 2 else -1) * rotor_rad + 0.7 * index))
        knee = 0.07 * size * outwards - 0.03 * up
        parts.append(rod(knee, knee + 0.025 * size * outwards - 0.11 * up, 0.006 * size, surface, sides=4))
    return merge(parts)


def _folding(span_m: float, rotor_rad: float, surface: str) -> Mesh:
    size = span_m / 0.35
    blade, reach = 0.065 * size, 0.11 * size  # motors at (+-reach cos, +-reach sin)
    parts = [
        _box(size, (-0.095, -0.042, -0.03), (0.09, 0.042, 0.03), surface),
        _box(size, (0.09, -0.022, -0.028), (0.125, 0.022, 0.012), surface),  # gimbal and camera
        _box(size, (-0.08, -0.03, 0.03), (0.02, 0.03, 0.042), surface),  # top of the battery
    ]
    up = np.array([0.0, 0.0, size])
    for index, angle in enumerate(np.radians([48.0, 132.0, 228.0, 312.0])):
        motor = reach * np.array([np.cos(angle), np.sin(angle), 0.0])
        shoulder = size * np.array([0.07 * np.sign(motor[0]), 0.04 * np.sign(motor[1]), 0.0])
        parts.append(rod(shoulder, motor, 0.009 * size, surface, sides=5))
        parts.append(rod(motor - 0.03 * up, motor + 0.018 * up, 0.011 * size, surface))
        parts.append(_blades(motor + 0.02 * up, blade, (1 if index % 2 else -1) * rotor_rad + 0.7 * index))
    return merge(parts)


def _hexa(span_m: float, rotor_rad: float, surface: str) -> Mesh:
    size = span_m / 0.8
    blade, arm = 0.13 * size, 0.27 * size
    parts = [
        rod((0, 0, -0.04 * size), (0, 0, 0.03 * size), 0.11 * size, surface, sides=8),
        _plate(0.11 * size, 0.03 * size, surface),
        _plate(0.11 * size, -0.04 * size, surface),
        _box(size, (-0.08, -0.05, 0.03), (0.08, 0.05, 0.09), surface),  # batteries
        _box(size, (-0.06, -0.06, -0.16), (0.06, 0.06, -0.06), surface),  # load
    ]
    up = np.array([0.0, 0.0, size])
    for index, angle in enumerate(np.radians([30.0, 90.0, 150.0, 210.0, 270.0, 330.0])):
        outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
        motor = arm * outwards
        parts.append(rod(0.09 * size * outwards, motor, 0.0125 * size, surface, sides=5))
        parts.append(rod(motor - 0.02 * up, motor + 0.03 * up, 0.02 * size, surface))
        parts.append(_blades(motor + 0.035 * up, blade, (1 if index % 2 else -1) * rotor_rad + 0.7 * index))
    for side in (-1.0, 1.0):
        foot = np.array([0.0, side * 0.17, -0.28]) * size
        along = np.array([0.15, 0.0, 0.0]) * size
        parts.append(rod(np.array([0.0, side * 0.08, -0.03]) * size, foot, 0.01 * size, surface, sides=4))
        parts.append(rod(foot - along, foot + along, 0.01 * size, surface, sides=4))
    return merge(parts)


def _box(size: float, low_m: tuple[float, float, float], high_m: tuple[float, float, float], surface: str) -> Mesh:
    return box(np.multiply(size, low_m), np.multiply(size, high_m), surface)


def _plate(radius_m: float, z_m: float, surface: str) -> Mesh:
    """An octagon as four quads around its centre."""
    turn = 2 * np.pi * np.arange(9) / 8
    rim = np.column_stack([radius_m * np.cos(turn), radius_m * np.sin(turn), np.full(9, z_m)])
    middle = np.array([0.0, 0.0, z_m])
    return quads([[middle, rim[2 * i], rim[2 * i + 1], rim[2 * i + 2]] for i in range(4)], surface)


def _blades(hub_m: np.ndarray, length_m: float, angle_rad: float) -> Mesh:
    """Two blades, pitched 12 deg, a fifth as wide as long: a beam passes through most of a rotor."""
    along = np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0]) * length_m
    across = np.array([-np.sin(angle_rad), np.cos(angle_rad), 0.0]) * 0.1 * length_m
    across[2] = 0.1 * length_m * np.tan(np.radians(12.0))
    twisted = across * [1, 1, -1]
    one = [hub_m - across, hub_m + across, hub_m + along + 0.6 * across, hub_m + along - 0.6 * across]
    other = [hub_m - twisted, hub_m + twisted, hub_m - along + 0.6 * twisted, hub_m - along - 0.6 * twisted]
    return quads([one, other], "carbon")
