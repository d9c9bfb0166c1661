"""A vehicle on its suspension: it pitches when braking, rolls in turns and shakes on a rough road.

Pitch and roll are damped oscillators driven by the acceleration in vehicle axes,

    angle'' = w^2 (target - angle) - 2 d w angle',   w = 2 pi natural_hz
    target pitch = -k a_forward,   target roll = k a_left   (nose up when accelerating, outwards in a turn)

with k = tilt_deg_per_mps2. While the vehicle moves, road roughness is added to the target. The vehicle rotates about a
point `lever_m` below the camera.

Source: ours; k and frequency of a passenger car's body (about 3 to 6 deg per g, 1 to 1.5 Hz).
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from flow.stage import StrictModel
from links.simulated.kernels.motion import STEP_S, oscillate, rotations_z
from links.simulated.world.motion import gauss_markov, interpolate, rotations_from_vectors
from links.simulated.world.path import Path
from stages.geometry.frames import Array64

BEYOND_S = 1.0
ROUGHNESS_TIME_S = 0.1
ROLLING_MPS = 3.0  # from this speed on, the road roughness is at its full size


class SuspensionSettings(StrictModel):
    """Suspension of the vehicle and roughness of the road."""

    tilt_deg_per_mps2: float = Field(default=0.45, ge=0, le=5)
    natural_hz: float = Field(default=1.3, gt=0.1, le=10)
    damping: float = Field(default=0.35, gt=0.05, le=2)
    roughness_deg: float = Field(default=0.4, ge=0, le=5)  # one sigma of the target; the suspension passes about half
    lever_m: float = Field(default=1.3, ge=0, le=4)


class SuspendedPath:
    """A driven path with pitch and roll. Times outside it take its first or last state."""

    def __init__(self, path: Path, settings: SuspensionSettings, duration_s: float, seed: int) -> None:
        self.path = path
        self._lever_m = settings.lever_m
        time_s: Array64 = np.arange(round((duration_s + BEYOND_S) / STEP_S) + 1, dtype=np.float64) * STEP_S
        _, velocity, acceleration, yaw = path.at(time_s)
        own = np.einsum("nji,nj->ni", rotations_z(yaw), acceleration)
        white = np.random.default_rng([seed, 36]).standard_normal((len(time_s), 2))
        rolling = np.minimum(np.linalg.norm(velocity, axis=1) / ROLLING_MPS, 1.0)[:, None]
        sigma = np.full(2, np.radians(settings.roughness_deg))
        gain = np.radians(settings.tilt_deg_per_mps2)
        target = np.column_stack([gain * own[:, 1], -gain * own[:, 0]])  # about x, about y
        target += rolling * gauss_markov(white, sigma, ROUGHNESS_TIME_S, STEP_S)
        self._tilt = oscillate(target, 2 * np.pi * settings.natural_hz, settings.damping)

    def level_poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        """T_world_vehicle: rotations (n, 3, 3) and positions (n, 3) [m]; `Path.level_poses` with the tilt."""
        level, position = self.path.level_poses(time_s)
        tilt = interpolate(self._tilt, STEP_S, time_s)
        rotations = level @ rotations_from_vectors(np.pad(tilt, ((0, 0), (0, 1))))
        return rotations, position + self._lever_m * (rotations[:, :, 2] - [0.0, 0.0, 1.0])
