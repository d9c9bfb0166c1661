"""GUIDED flight on the autopilot's own estimate: the plan gives a target, a cascade gives the wanted acceleration.

    v_target = v_plan + sqrt-limited Kp (p_target - p)       |v| <= 5 m/s
    a = Kv (v_target - v) + Ki integral + a_plan + g

All in the frame of the estimate. When the estimate jumps, the target jumps with it, as AC_PosControl does.

Source: ArduPilot AC_PosControl (PSC_POSXY_P 1, PSC_VELXY_P 2, PSC_VELXY_I 1, PSC_POSZ_P 1, PSC_VELZ_P 5,
init_ekf_xy_reset), ModeGuided; the plan and its speed profile are ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from links.simulated.autopilot.flight_stack.quadrotor import TICK_S
from links.simulated.autopilot.flight_stack.settings import Follow, FollowPath, GoTo, PlanStep, Square
from links.simulated.kernels.motion import GRAVITY_MPS2
from links.simulated.world.path import Path
from stages.geometry.frames import Array64

POSITION_P, VELOCITY_P, VELOCITY_I = 1.0, 2.0, 1.0
CLIMB_P, CLIMB_VELOCITY_P, CLIMB_I = 1.0, 5.0, 1.0
MAX_SPEED_MPS, MAX_CLIMB_MPS = 5.0, 2.5
MAX_INTEGRAL_MPS2 = 4.0
ACCELERATION_MPS2 = 1.0  # of the speed profile along a leg
LAND_MPS, LAND_FAST_MPS, LAND_FAST_ABOVE_M = 0.5, 1.5, 10.0  # LAND_SPEED, WPNAV_SPEED_DN, LAND_ALT_LOW
SQUARE, CORNER_STOP_S = ((0, 0), (1, 0), (1, 1), (0, 1)), 1.0


@dataclass(frozen=True, slots=True)
class SurveyFrame:
    """Where the sources in use put the world frame."""

    yaw_rad: float  # of the world's x axis
    xyz_m: Array64  # of the world's origin

    def position(self, world_m: Array64) -> Array64:
        """A position in the world frame, in the frame of the estimate."""
        return rotate(world_m, self.yaw_rad) + self.xyz_m


@dataclass(slots=True)
class FlightTarget:
    """What is to be flown now, in the frame of the estimate."""

    xyz_m: Array64
    velocity_mps: Array64 = field(default_factory=lambda: np.zeros(3))
    yaw_rad: float = 0.0
    yaw_rate_radps: float = 0.0


class Guidance:
    """The plan, step by step, as targets."""

    def __init__(self, path: Path, vehicle: Path, target: FlightTarget, drift_m: Callable[[float], Array64]) -> None:
        """`drift_m`: error of the position of the vehicle that it follows, at a time (3,)."""
        self.target = target
        self._path, self._vehicle, self._drift_m = path, vehicle, drift_m
        self._step: PlanStep | None = None
        self._begin_s = 0.0
        self._from = target.xyz_m.copy()
        self._table = np.empty((0, 3)), np.empty((0, 3)), np.empty(0)  # position, velocity, yaw of the path, per tick

    def begin(self, step: PlanStep, time_s: float) -> None:
        """Start a step of the plan from the present target."""
        self._step, self._begin_s = step, time_s
        if isinstance(step, FollowPath):
            position, velocity, _, yaw = self._path.at(np.arange(0.0, step.for_s + 2 * TICK_S, TICK_S))
            self._table = position, velocity, yaw
        self._from = self.target.xyz_m.copy()
        self.target.velocity_mps, self.target.yaw_rate_radps = np.zeros(3), 0.0

    def shift(self, jump_m: Array64, yaw_rad: float) -> None:
        """The estimate has jumped: the target jumps with it."""
        self.target.xyz_m = self.target.xyz_m + jump_m
        self._from = self._from + jump_m
        self.target.yaw_rad += yaw_rad

    def update(self, time_s: float, frame: SurveyFrame) -> FlightTarget:
        """The target at a time. `frame` maps surveyed positions to the sources in use."""
        step, since_s = self._step, time_s - self._begin_s
        if isinstance(step, FollowPath):
            self._follow_path(since_s, frame)
        elif isinstance(step, GoTo):
            self._leg(self._from, frame.position(np.array(step.xyz_m)), step.speed_mps, since_s)
            if step.yaw_deg is not None:
                self.target.yaw_rad = math.radians(step.yaw_deg) + frame.yaw_rad
        elif isinstance(step, Square):
            self._square(step, since_s, frame)
        elif isinstance(step, Follow):
            self._follow(time_s, frame)
        return self.target

    def _follow_path(self, since_s: float, frame: SurveyFrame) -> None:
        position, velocity, yaw = self._table
        row = min(round(since_s / TICK_S), len(yaw) - 2)
        self.target.xyz_m = frame.position(position[row])
        self.target.velocity_mps = rotate(velocity[row], frame.yaw_rad)
        self.target.yaw_rad = float(yaw[row]) + frame.yaw_rad
        self.target.yaw_rate_radps = float(yaw[row + 1] - yaw[row]) / TICK_S

    def _leg(self, begin: Array64, end: Array64, speed_mps: float, since_s: float) -> float:
        """Move the target along a line with a trapezoidal speed; returns the duration of the leg."""
        away = end - begin
        length = float(np.linalg.norm(away))
        done, speed, duration_s = trapezoid(length, speed_mps, since_s)
        share = done / length if length > 1e-9 else 1.0
        self.target.xyz_m = begin + share * away
        self.target.velocity_mps = speed * away / length if length > 1e-9 else np.zeros(3)
        return duration_s

    def _square(self, step: Square, since_s: float, frame: SurveyFrame) -> None:
        corners = [rotate(step.side_m * np.array([x, y, 0.0]), frame.yaw_rad) for x, y in SQUARE]
        leg_s = trapezoid(step.side_m, step.speed_mps, 0.0)[2] + CORNER_STOP_S
        leg = int(since_s // leg_s)
        self._leg(self._from + corners[leg % 4], self._from + corners[(leg + 1) % 4], step.speed_mps, since_s % leg_s)

    def _follow(self, time_s: float, frame: SurveyFrame) -> None:
        """The target moves with the vehicle, tick by tick: the axes of the estimate may turn."""
        before_s = max(self._begin_s, time_s - TICK_S)
        position, velocity, _, _ = self._vehicle.at(np.array([before_s, time_s]))
        drifted = self._drift_m(time_s) - self._drift_m(before_s)
        self.target.xyz_m = self.target.xyz_m + rotate(position[1] - position[0] + drifted, frame.yaw_rad)
        self.target.velocity_mps = rotate(velocity[1] + drifted / TICK_S, frame.yaw_rad)


class PositionController:
    """From target and estimate to the wanted acceleration + g."""

    def __init__(self) -> None:
        self._integral = np.zeros(3)

    def reset(self) -> None:
        """Forget the integrals."""
        self._integral[:] = 0.0

    def command(self, target: FlightTarget, p: Array64, v: Array64) -> Array64:
        """(6,) for `fly_steps`: acceleration + g, yaw, yaw rate, motors run."""
        error = target.xyz_m - p
        horizontal = float(np.hypot(error[0], error[1]))
        wanted = np.empty(3)
        speed = root_limited(horizontal, POSITION_P, 2.5)
        factor = speed / horizontal if horizontal > 1e-9 else 0.0
        wanted[:2] = target.velocity_mps[:2] + factor * error[:2]
        size = float(np.hypot(wanted[0], wanted[1]))
        limit = MAX_SPEED_MPS + float(np.hypot(*target.velocity_mps[:2]))
        if size > limit:
            wanted[:2] *= limit / size
        wanted[2] = target.velocity_mps[2] + min(max(CLIMB_P * error[2], -MAX_CLIMB_MPS), MAX_CLIMB_MPS)
        return self._acceleration(wanted - v, target.yaw_rad, target.yaw_rate_radps)

    def land(self, climb_mps: float, v: Array64, yaw_rad: float, position_known: bool) -> Array64:
        """The same for a descent; without a position it stays level and drifts with the wind."""
        error = np.array([0.0, 0.0, climb_mps - v[2]])
        if position_known:
            error[:2] = -v[:2]
        else:
            self._integral[:2] = 0.0
        return self._acceleration(error, yaw_rad, 0.0)

    def _acceleration(self, error: Array64, yaw_rad: float, yaw_rate: float) -> Array64:
        gains = np.array([VELOCITY_P, VELOCITY_P, CLIMB_VELOCITY_P])
        self._integral += TICK_S * np.array([VELOCITY_I, VELOCITY_I, CLIMB_I]) * error
        np.clip(self._integral, -MAX_INTEGRAL_MPS2, MAX_INTEGRAL_MPS2, out=self._integral)
        wanted = gains * error + self._integral
        wanted[2] = max(wanted[2] + GRAVITY_MPS2, 0.3 * GRAVITY_MPS2)
        return np.array([*wanted, yaw_rad, yaw_rate, 1.0])


def trapezoid(length_m: float, speed_mps: float, since_s: float) -> tuple[float, float, float]:
    """(distance, speed, duration) after a time on a line that starts and ends at rest."""
    a = ACCELERATION_MPS2
    top = min(speed_mps, math.sqrt(a * length_m))
    ramp_s = top / a
    cruise_s = (length_m - top * ramp_s) / top if top > 0 else 0.0
    duration_s = 2 * ramp_s + cruise_s
    t = min(max(since_s, 0.0), duration_s)
    if t < ramp_s:
        return 0.5 * a * t * t, a * t, duration_s
    if t < ramp_s + cruise_s:
        return 0.5 * top * ramp_s + top * (t - ramp_s), top, duration_s
    rest = duration_s - t
    return length_m - 0.5 * a * rest * rest, a * rest, duration_s


def root_limited(error: float, p: float, acceleration: float) -> float:
    """sqrt_controller: p e near the target, sqrt(2 a (e - a / (2 p^2))) far from it."""
    linear = acceleration / (p * p)
    return p * error if error <= linear else math.sqrt(2 * acceleration * (error - 0.5 * linear))


def rotate(vector: Array64, yaw_rad: float) -> Array64:
    """Rz(yaw) v."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]])
