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

from links.simulated.world.mesh import Array64
from links.simulated.world.path import DRAG_PER_S, GRAVITY_MPS2, Path
from links.simulated.world.series import between_steps, gauss_markov
from stages.compiled import compiled
from stages.geometry import quaternions_xyzw, rotations_from_xyzw

STEP_S = 1 / 400
BEYOND_S = 1.0  # the flight goes on this long after the scenario: sensors look a little ahead
SETTLED_S = 60.0  # after so long a flight that goes round flies each round like the one before
KP_PER_S2, KD_PER_S, KI_PER_S3 = 4.0, 3.0, 0.8
VERTICAL_STIFFER = 2.0
MAX_INTEGRAL_MPS2 = 3.0
YAW_GAIN_PER_S = 3.0


class FlightSettings(BaseModel):
    """How the drone follows its path."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    attitude_gain_per_s: float = Field(default=8.0, gt=0, le=30)  # turn rate per attitude error
    rate_limit_degps: float = Field(default=220.0, gt=0, le=2000)  # roll and pitch
    yaw_rate_limit_degps: float = Field(default=90.0, gt=0, le=1000)
    rate_lag_s: float = Field(default=0.05, gt=STEP_S, le=1)
    thrust_lag_s: float = Field(default=0.04, gt=STEP_S, le=1)
    lean_limit_deg: float = Field(default=40.0, gt=0, le=80)
    wind_world_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gust_mps: float = Field(default=0.5, ge=0, le=20)  # one sigma, each horizontal axis; half of it vertically
    gust_time_s: float = Field(default=1.5, gt=0.05, le=60)


class Flight:
    """A flown path. Times outside the flight take its first or last state; one that goes round has no outside.

    It goes round in the same gusts, so that one round's pictures are the next one's.
    """

    def __init__(self, path: Path, settings: FlightSettings, duration_s: float, seed: int) -> None:
        self.path = path
        if path.round_s is None:
            steps = int(np.ceil((duration_s + BEYOND_S) / STEP_S)) + 1
            round_steps = steps
        else:
            round_steps = round(path.round_s / STEP_S)
            steps = (int(np.ceil(SETTLED_S / path.round_s)) + 1) * round_steps + 1
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
                np.tan(np.radians(settings.lean_limit_deg)),
            ]
        )
        state = fly(position, velocity, acceleration, headings, wind, mean_wind, start, limits)
        if path.round_s is not None:
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

    def felt(self, time_s: Array64) -> tuple[Array64, Array64]:
        """What the drone's own IMU feels, drone axes: turn rate (n, 3) [rad/s] and specific force (n, 3) [m/s^2]."""
        return self._mix(self._w, time_s), self._mix(self._f, time_s)

    def _mix(self, rows: Array64, time_s: Array64) -> Array64:
        in_round_s = time_s if self.path.round_s is None else np.mod(time_s, self.path.round_s)
        return between_steps(rows, STEP_S, in_round_s)  # 2.5 ms bend less than 0.1 mm and 0.01 deg


def _gusts(settings: FlightSettings, steps: int, round_steps: int, rng: np.random.Generator) -> Array64:
    """(steps, 3) [m/s], world; what drives them comes again after `round_steps`."""
    sigma = settings.gust_mps * np.array([1.0, 1.0, 0.5])
    white = np.resize(rng.standard_normal((round_steps, 3)), (steps, 3))
    return gauss_markov(white, sigma, settings.gust_time_s, STEP_S)


@compiled
def fly(
    position: Array64,
    velocity: Array64,
    acceleration: Array64,
    headings: Array64,
    wind: Array64,
    mean_wind: Array64,
    start: Array64,
    limits: Array64,
) -> Array64:
    """States (n, 16), one a step: p, v (world), q (x, y, z, w), turn rate and specific force (drone axes).

    The path is position, velocity, acceleration (n, 3), heading and its rate (n, 2); wind (n, 3) blows about a mean
    that the drone has learned. It starts on the path, leaning as in still air (quaternion `start`).
    """
    gain, max_rate, max_yaw_rate, rate_lag, thrust_lag, max_slope = limits
    states = np.empty((position.shape[0], 16))
    p, v, q = position[0].copy(), velocity[0].copy(), start.copy()
    rate, integral = np.zeros(3), -DRAG_PER_S * mean_wind
    asked, felt, R = np.empty(3), np.empty(3), np.empty((3, 3))
    thrust = np.sqrt(np.sum((acceleration[0] + DRAG_PER_S * v + np.array([0.0, 0.0, GRAVITY_MPS2])) ** 2))
    for k in range(position.shape[0]):
        x, y, z, w = q
        R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        drag = -DRAG_PER_S * (v - wind[k])
        for i in range(3):
            felt[i] = R[0, i] * drag[0] + R[1, i] * drag[1] + R[2, i] * drag[2]
        felt[2] += thrust
        states[k, 0:3], states[k, 3:6], states[k, 6:10], states[k, 10:13], states[k, 13:16] = p, v, q, rate, felt

        for i in range(3):
            stiff = VERTICAL_STIFFER if i == 2 else 1.0
            off = position[k, i] - p[i]
            integral[i] = min(max(integral[i] + KI_PER_S3 * off * STEP_S, -MAX_INTEGRAL_MPS2), MAX_INTEGRAL_MPS2)
            back = stiff * (KP_PER_S2 * off + KD_PER_S * (velocity[k, i] - v[i])) + integral[i]
            asked[i] = acceleration[k, i] + DRAG_PER_S * velocity[k, i] + back
        asked[2] = max(asked[2] + GRAVITY_MPS2, 0.3 * GRAVITY_MPS2)
        slope = np.sqrt(asked[0] ** 2 + asked[1] ** 2) / asked[2]
        if slope > max_slope:
            asked[0] *= max_slope / slope
            asked[1] *= max_slope / slope
        size = np.sqrt(asked[0] ** 2 + asked[1] ** 2 + asked[2] ** 2)
        along = asked[0] * R[0, 2] + asked[1] * R[1, 2] + asked[2] * R[2, 2]
        thrust += (max(along, 0.1 * GRAVITY_MPS2) - thrust) * STEP_S / thrust_lag

        # the turn about the body's axes that takes its z to the asked direction is z x asked = (-body_y, body_x, 0)
        body_x = (R[0, 0] * asked[0] + R[1, 0] * asked[1] + R[2, 0] * asked[2]) / size
        body_y = (R[0, 1] * asked[0] + R[1, 1] * asked[1] + R[2, 1] * asked[2]) / size
        turn = headings[k, 0] - np.arctan2(R[1, 0], R[0, 0])
        turn = np.arctan2(np.sin(turn), np.cos(turn))
        wanted = (-gain * body_y, gain * body_x, headings[k, 1] + YAW_GAIN_PER_S * turn)
        for i in range(3):
            limit = max_yaw_rate if i == 2 else max_rate
            rate[i] += (min(max(wanted[i], -limit), limit) - rate[i]) * STEP_S / rate_lag

        for i in range(3):
            pull = R[i, 2] * thrust + drag[i] - (GRAVITY_MPS2 if i == 2 else 0.0)
            p[i] += STEP_S * (v[i] + 0.5 * STEP_S * pull)
            v[i] += STEP_S * pull
        a, b, c = 0.5 * STEP_S * rate[0], 0.5 * STEP_S * rate[1], 0.5 * STEP_S * rate[2]
        q[0], q[1], q[2], q[3] = (
            x + a * w + c * y - b * z,
            y + b * w + a * z - c * x,
            z + c * w + b * x - a * y,
            w - a * x - b * y - c * z,
        )
        q /= np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    return states
