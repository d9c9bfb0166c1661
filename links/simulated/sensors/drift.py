"""A drifting estimate of a motion: its errors are slow and smooth, without jumps.

A dead-reckoned position is the integral of an estimated velocity. Its error grows with time and with distance, as that
of an EKF or of wheel odometry:

    v_local = Rz(yaw of the local frame + yaw error) (1 + scale) v_world + velocity error       horizontal
    p_local = integral of v_local + random walk;   z_local = z - z_0 + height error

yaw error = rate * t + random walk. Velocity, height and tilt errors are first-order Gauss-Markov processes. Random
walks and height pass a 1 s low-pass, so that the position has a derivative; the velocity contains it.

Source: ours; orders of magnitude of consumer-grade EKFs with optical flow or wheel speed and without GPS.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from flow.stage import StrictModel
from links.simulated.kernels.motion import rotations_z
from links.simulated.world.motion import gauss_markov, interpolate, low_pass, random_walk, rotations_from_vectors
from stages.geometry.frames import Array64

STEP_S = 0.01
SMOOTH_S = 1.0  # time constant of the low-pass on the errors


class DriftSettings(StrictModel):
    """Sizes of the errors. Scale and yaw rate are values, the others one sigma; zero disables an error."""

    scale: float = Field(default=0.01, ge=-0.5, le=0.5)  # relative error of distances
    yaw_rate_deg_per_min: float = Field(default=1.0, ge=-600, le=600)
    yaw_random_walk_deg_per_sqrt_s: float = Field(default=0.05, ge=0, le=10)
    position_random_walk_m_per_sqrt_s: float = Field(default=0.02, ge=0, le=10)
    velocity_mps: float = Field(default=0.08, ge=0, le=10)
    velocity_time_s: float = Field(default=10.0, gt=0.05)
    height_m: float = Field(default=0.25, ge=0, le=20)
    height_time_s: float = Field(default=40.0, gt=0.05)
    tilt_deg: float = Field(default=0.4, ge=0, le=20)
    tilt_time_s: float = Field(default=20.0, gt=0.05)


class DriftingEstimate:
    """The estimate of a true motion. Times outside it take its first or last value.

    Frame local: z up, origin at the start of the motion; the world x axis has the yaw `yaw_local_rad` in it.
    """

    def __init__(
        self, position_m: Array64, yaw_local_rad: float, settings: DriftSettings, rng: np.random.Generator
    ) -> None:
        """position_m (n, 3): the true path, world frame, one row per STEP_S."""
        s, steps = settings, len(position_m)
        self._settings = settings
        self._travelled_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(position_m, axis=0), axis=1))])
        white = rng.standard_normal((steps, 8))
        self._yaw = yaw_local_rad + np.radians(s.yaw_rate_deg_per_min) / 60 * STEP_S * np.arange(steps)
        self._yaw += _random_walk(white[:, :1], float(np.radians(s.yaw_random_walk_deg_per_sqrt_s)))[:, 0]
        self._lean = low_pass(_errors(white[:, 1:3], float(np.radians(s.tilt_deg)), s.tilt_time_s), SMOOTH_S, STEP_S)
        velocity_error = _errors(white[:, 3:5], s.velocity_mps, s.velocity_time_s)
        walk = _random_walk(white[:, 6:8], s.position_random_walk_m_per_sqrt_s)
        height_error = low_pass(_errors(white[:, 5:6], s.height_m, s.height_time_s), SMOOTH_S, STEP_S)

        step_local = np.einsum("nij,nj->ni", rotations_z(self._yaw[:-1]), np.diff(position_m, axis=0))
        moved = (1 + s.scale) * step_local[:, :2] + STEP_S * velocity_error[:-1]
        self._position = np.zeros((steps, 3))
        self._position[1:, :2] = np.cumsum(moved, axis=0)
        self._position[:, :2] += walk
        self._position[:, 2:] = position_m[:, 2:] - position_m[0, 2] + height_error - height_error[0]
        self._velocity_error = np.gradient(np.hstack([walk, height_error]), STEP_S, axis=0)
        self._velocity_error[:, :2] += velocity_error

    def position_m(self, time_s: Array64) -> Array64:
        """Estimated position (n, 3) [m], local frame."""
        return interpolate(self._position, STEP_S, time_s)

    def velocity_mps(self, time_s: Array64, velocity_world_mps: Array64) -> Array64:
        """Estimate (n, 3), local frame, of a true velocity (n, 3), world frame."""
        turned = np.einsum("nij,nj->ni", self._turn(time_s), velocity_world_mps)
        scale = 1 + self._settings.scale
        return turned * [scale, scale, 1.0] + interpolate(self._velocity_error, STEP_S, time_s)

    def rotations(self, time_s: Array64, R_world_body: Array64) -> Array64:
        """Estimate R_local_body (n, 3, 3) of a true R_world_body (n, 3, 3)."""
        lean = interpolate(self._lean, STEP_S, time_s)
        return rotations_from_vectors(np.pad(lean, ((0, 0), (0, 1)))) @ self._turn(time_s) @ R_world_body

    def covariances(self, time_s: Array64, R_local_body: Array64) -> Array64:
        """Consistent pose covariances (n, 6, 6): rotation [rad], then translation [m], tangent at the body.

        The integral of a Gauss-Markov velocity error has the variance 2 s^2 T (t - T (1 - exp(-t / T))).
        """
        s, t, T = self._settings, np.maximum(time_s, 0.0), self._settings.velocity_time_s
        lean = np.full(len(t), np.radians(s.tilt_deg) ** 2)
        yaw = np.radians(s.yaw_rate_deg_per_min / 60 * t) ** 2 + np.radians(s.yaw_random_walk_deg_per_sqrt_s) ** 2 * t
        integrated = 2 * s.velocity_mps**2 * T * (t - T * (1 - np.exp(-t / T)))
        along = (s.scale**2 + yaw / 3) * interpolate(self._travelled_m, STEP_S, t) ** 2
        horizontal = s.position_random_walk_m_per_sqrt_s**2 * t + integrated + along
        height = 2 * s.height_m**2 * (1 - np.exp(-t / s.height_time_s))
        covariances = np.zeros((len(t), 6, 6))
        for at, variances in ((0, (lean, lean, yaw)), (3, (horizontal, horizontal, height))):
            scaled = R_local_body * np.column_stack(variances)[:, :, None]  # diag(variances) R
            covariances[:, at : at + 3, at : at + 3] = np.swapaxes(R_local_body, 1, 2) @ scaled
        return covariances

    def _turn(self, time_s: Array64) -> Array64:
        return rotations_z(interpolate(self._yaw, STEP_S, time_s))


def _random_walk(white: Array64, sigma_per_sqrt_s: float) -> Array64:
    return low_pass(random_walk(white, sigma_per_sqrt_s, STEP_S), SMOOTH_S, STEP_S)


def _errors(white: Array64, sigma: float, time_s: float) -> Array64:
    return gauss_markov(white, np.full(white.shape[1], sigma), time_s, STEP_S)
