"""The drone as a mesh with open arms: a body, four arms, motors, spinning blades and legs; air in between.

Source: ours, after the proportions of a 0.5 m class quadrotor. Frame: drone (x forward, y left, z up).
"""

from __future__ import annotations

import numpy as np

from links.simulated.mesh import Mesh, box, merge, quads, rod

ARM_ANGLES_RAD = np.radians([45.0, 135.0, 225.0, 315.0])
BLADES = 2  # per rotor


def drone_mesh(span_m: float, rotor_rad: float = 0.0, surface: str = "carbon") -> Mesh:
    """The drone, `span_m` from blade tip to blade tip across; its blades stand at `rotor_rad`."""
    size = span_m / 0.5
    blade, arm = 0.09 * size, 0.16 * size
    parts = [
        box(np.multiply(size, (-0.085, -0.055, -0.03)), np.multiply(size, (0.085, 0.055, 0.025)), surface),
        box(np.multiply(size, (-0.06, -0.03, 0.025)), np.multiply(size, (0.06, 0.03, 0.055)), surface),  # battery
        box(np.multiply(size, (0.03, -0.025, -0.08)), np.multiply(size, (0.08, 0.025, -0.03)), surface),  # camera
    ]
    up = np.array([0.0, 0.0, size])
    for index, angle in enumerate(ARM_ANGLES_RAD):
        outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
        motor = arm * outwards
        parts.append(rod(0.05 * size * outwards, motor, 0.010 * size, surface, sides=4))
        parts.append(rod(motor - 0.012 * up, motor + 0.025 * up, 0.014 * size, surface))
        parts.append(_blades(motor + 0.03 * up, blade, (1 if index % 2 else -1) * rotor_rad + 0.7 * index))
        knee = 0.07 * size * outwards - 0.03 * up
        parts.append(rod(knee, knee + 0.025 * size * outwards - 0.11 * up, 0.006 * size, surface, sides=4))
    return merge(parts)


def _blades(hub_m: np.ndarray, length_m: float, angle_rad: float) -> Mesh:
    """Two blades, pitched 12 deg and a fifth as wide as long: a rotor is mostly air."""
    along = np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0]) * length_m
    across = np.array([-np.sin(angle_rad), np.cos(angle_rad), 0.0]) * 0.1 * length_m
    across[2] = 0.1 * length_m * np.tan(np.radians(12.0))
    twisted = across * [1, 1, -1]
    one = [hub_m - across, hub_m + across, hub_m + along + 0.6 * across, hub_m + along - 0.6 * across]
    other = [hub_m - twisted, hub_m + twisted, hub_m - along + 0.6 * twisted, hub_m - along - 0.6 * twisted]
    return quads([one, other], "carbon")
