"""A multirotor that flies a path by leaning: its attitude follows late, with limited rates, and the wind pushes it.

The path is what the autopilot is asked to fly. What it does fly comes out of the dynamics, 400 steps a second:

    acceleration = R_world_drone [0, 0, thrust] - DRAG (v - wind) - g
    asked for:     path acceleration + Kp (p_path - p) + Kd (v_path - v) + Ki integral + DRAG v_path + g
    attitude       turns the body's z towards it: turn rates proportional to the error, limited, and followed late

so position, velocity, attitude, turn rate and what an accelerometer feels belong together. The wind is a mean and a
first-order Gauss-Markov gust per axis.

Source: ours; the cascade is that of ArduPilot's and PX4's position and attitude controllers, gains for a 0.5 m drone.
"""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from links.simulated.kernels.motion import GRAVITY_MPS2, STEP_S, fly
from links.simulated.world.motion import gauss_markov, interpolate
from links.simulated.world.path import Path
from stages.geometry import Array64, quaternions_xyzw, rotations_from_xyzw

BEYOND_S = 1.0  # the flight goes on this long after the scenario: sensors look a little ahead
SETTLED_S = 60.0  # after so long a flight that goes round flies each round like the one before


class FlightSettings(BaseModel):
    """How the drone follows its path."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    attitude_gain_per_s: float = Field(default=8.0, gt=0, le=30)  # turn rate per attitude error
    rate_limit_degps: float = Field(default=220.0, gt=0, le=2000)  # roll and pitch
    yaw_rate_limit_degps: float = Field(default=90.0, gt=0, le=1000)
    rate_lag_s: float = Field(default=0.05, gt=STEP_S, le=1)
    thrust_lag_s: float = Field(default=0.04, gt=STEP_S, le=1)
    tilt_limit_deg: float = Field(default=40.0, gt=0, le=80)
    wind_world_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gust_mps: float = Field(default=0.5, ge=0, le=20)  # one sigma, each horizontal axis; half of it vertically
    gust_time_s: float = Field(default=1.5, gt=0.05, le=60)


class Flight:
    """A flown path. Times outside the flight take its first or last state; one that goes round has no outside.

    It goes round in the same gusts, so that one round's images are the next one's.
    """

    def __init__(self, path: Path, settings: FlightSettings, duration_s: float, seed: int) -> None:
        self.path = path
        if path.period_s is None:
            steps = int(np.ceil((duration_s + BEYOND_S) / STEP_S)) + 1
            round_steps = steps
        else:
            round_steps = round(path.period_s / STEP_S)
            steps = (int(np.ceil(SETTLED_S / path.period_s)) + 1) * round_steps + 1
        time_s: Array64 = np.arange(steps, dtype=np.float64) * STEP_S
        position, velocity, acceleration, yaw = (np.ascontiguousarray(part) for part in path.at(time_s))
        mean_wind = np.array(settings.wind_world_mps)
        wind = mean_wind + _gusts(settings, steps, round_steps, np.random.default_rng([seed, 30]))
        headings = np.column_stack([yaw, np.gradient(yaw, STEP_S)])
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
        state = fly(position, velocity, acceleration, headings, wind, mean_wind, start, limits)
        if path.period_s is not None:
            state = state[-round_steps - 1 :]
        self._p, self._v, self._q, self._w, self._f = np.split(state, [3, 6, 10, 13], axis=1)

    def at(self, time_s: Array64) -> tuple[Array64, Array64, Array64, Array64]:
        """Position, velocity, acceleration (n, 3), world, and yaw (n,) [rad] in [-pi, pi], as `Path.at` gives them."""
        rotations, position = self.flying_poses(time_s)
        felt = self._mix(self._f, time_s)
        acceleration = np.einsum("nij,nj->ni", rotations, felt) - [0.0, 0.0, GRAVITY_MPS2]
        yaw = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
        return position, self._mix(self._v, time_s), acceleration, yaw

    def flying_poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        """T_world_drone: rotations (n, 3, 3) and positions (n, 3) [m]."""
        q = self._mix(self._q, time_s)
        return rotations_from_xyzw(q), self._mix(self._p, time_s)

    def imu(self, time_s: Array64) -> tuple[Array64, Array64]:
        """What the drone's own IMU feels, drone axes: turn rate (n, 3) [rad/s] and specific force (n, 3) [m/s^2]."""
        return self._mix(self._w, time_s), self._mix(self._f, time_s)

    def _mix(self, rows: Array64, time_s: Array64) -> Array64:
        in_round_s = time_s if self.path.period_s is None else np.mod(time_s, self.path.period_s)
        return interpolate(rows, STEP_S, in_round_s)  # 2.5 ms bend less than 0.1 mm and 0.01 deg


def _gusts(settings: FlightSettings, steps: int, round_steps: int, rng: np.random.Generator) -> Array64:
    """(steps, 3) [m/s], world; what drives them comes again after `round_steps`."""
    sigma = settings.gust_mps * np.array([1.0, 1.0, 0.5])
    white = np.resize(rng.standard_normal((round_steps, 3)), (steps, 3))
    return gauss_markov(white, sigma, settings.gust_time_s, STEP_S)
