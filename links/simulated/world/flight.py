"""Flight dynamics of a multirotor: it tilts to accelerate, with limited rates and lag, and the wind pushes it.

The path is the reference. The flown motion follows from the dynamics, at 400 Hz:

    acceleration = R_world_drone [0, 0, thrust] - DRAG (v - wind) - g
    desired        path acceleration + Kp (p_path - p) + Kd (v_path - v) + Ki integral + DRAG v_path + g
    attitude       rotates body z towards the desired direction: turn rates proportional to the error, limited, lagged

Position, velocity, attitude, turn rate and specific force are therefore consistent. The wind is a mean plus a
first-order Gauss-Markov gust per axis.

Source: ours. The cascade is that of the position and attitude controllers of ArduPilot and PX4, with gains for a
0.5 m drone.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from flow.stage import StrictModel
from links.simulated.kernels.motion import GRAVITY_MPS2, STEP_S, fly
from links.simulated.world.motion import gauss_markov, interpolate
from links.simulated.world.path import Path
from stages.geometry.frames import Array64, quaternions_xyzw, rotations_from_xyzw

BEYOND_S = 1.0  # the flight continues this long after the scenario: sensors sample ahead of it
SETTLED_S = 60.0  # after this long, all laps of a closed path are flown alike


class FlightSettings(StrictModel):
    """How the drone follows its path."""

    attitude_gain_per_s: float = Field(default=8.0, gt=0, le=30)  # turn rate per attitude error
    rate_limit_degps: float = Field(default=220.0, gt=0, le=2000)  # roll and pitch
    yaw_rate_limit_degps: float = Field(default=90.0, gt=0, le=1000)
    rate_lag_s: float = Field(default=0.05, gt=STEP_S, le=1)
    thrust_lag_s: float = Field(default=0.04, gt=STEP_S, le=1)
    tilt_limit_deg: float = Field(default=40.0, gt=0, le=80)
    wind_world_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gust_mps: float = Field(default=0.5, ge=0, le=20)  # one sigma per horizontal axis, half of it vertically
    gust_time_s: float = Field(default=1.5, gt=0.05, le=60)


class Flight:
    """A flown path. Times outside the flight take its first or last state; a closed path repeats for ever.

    On a closed path the gusts repeat too, so that all laps have the same images.
    """

    def __init__(self, path: Path, settings: FlightSettings, duration_s: float, seed: int) -> None:
        self.path = path
        if path.period_s is None:
            steps = int(np.ceil((duration_s + BEYOND_S) / STEP_S)) + 1
            lap_steps = steps
        else:
            lap_steps = round(path.period_s / STEP_S)
            steps = (int(np.ceil(SETTLED_S / path.period_s)) + 1) * lap_steps + 1
        time_s: Array64 = np.arange(steps, dtype=np.float64) * STEP_S
        position, velocity, acceleration, yaw = (np.ascontiguousarray(part) for part in path.at(time_s))
        mean_wind = np.array(settings.wind_world_mps)
        wind = mean_wind + _gusts(settings, steps, lap_steps, np.random.default_rng([seed, 30]))
        yaw_and_rate = np.column_stack([yaw, np.gradient(yaw, STEP_S)])
        start = quaternions_xyzw(path.flying_poses(np.zeros(1))[0])[0]
        limits = np.array(
            [
                settings.attitude_gain_per_s,
                np.radians(settings.rate_limit_degps),
                np.radians(settings.yaw_rate_limit_degps),
                settings.rate_lag_s,
                settings.thrust_lag_s,
                np.tan(np.radians(settings.tilt_limit_deg)),
            ]
        )
        state = fly(position, velocity, acceleration, yaw_and_rate, wind, mean_wind, start, limits)
        if path.period_s is not None:
            state = state[-lap_steps - 1 :]
        self._p, self._v, self._q, self._w, self._f = np.split(state, [3, 6, 10, 13], axis=1)

    def at(self, time_s: Array64) -> tuple[Array64, Array64, Array64, Array64]:
        """Position, velocity, acceleration (n, 3), world, and yaw (n,) [rad] in [-pi, pi], as `Path.at` returns."""
        rotations, position = self.flying_poses(time_s)
        force = self._interpolate(self._f, time_s)
        acceleration = np.einsum("nij,nj->ni", rotations, force) - [0.0, 0.0, GRAVITY_MPS2]
        yaw = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
        return position, self._interpolate(self._v, time_s), acceleration, yaw

    def flying_poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        """T_world_drone: rotations (n, 3, 3) and positions (n, 3) [m]."""
        q = self._interpolate(self._q, time_s)
        return rotations_from_xyzw(q), self._interpolate(self._p, time_s)

    def imu(self, time_s: Array64) -> tuple[Array64, Array64]:
        """Ideal IMU of the drone, drone axes: turn rate (n, 3) [rad/s] and specific force (n, 3) [m/s^2]."""
        return self._interpolate(self._w, time_s), self._interpolate(self._f, time_s)

    def _interpolate(self, rows: Array64, time_s: Array64) -> Array64:
        in_lap_s = time_s if self.path.period_s is None else np.mod(time_s, self.path.period_s)
        return interpolate(rows, STEP_S, in_lap_s)  # within 2.5 ms the error is below 0.1 mm and 0.01 deg


def _gusts(settings: FlightSettings, steps: int, lap_steps: int, rng: np.random.Generator) -> Array64:
    """Gusts (steps, 3) [m/s], world frame; their white noise repeats after `lap_steps`."""
    sigma = settings.gust_mps * np.array([1.0, 1.0, 0.5])
    white = np.resize(rng.standard_normal((lap_steps, 3)), (steps, 3))
    return gauss_markov(white, sigma, settings.gust_time_s, STEP_S)
