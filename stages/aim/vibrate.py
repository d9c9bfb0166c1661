"""Aiming of the paper: sweeps the whole travel until the drone is tracked, then vibrates about it.

    SEARCHING or LOST:  0..180 deg and back at 11.4 rpm
    TRACKING:           theta +- 5 deg at 57.2 rpm, theta the servo angle at which the scan plane contains the drone

A new goal is published when the servo has reached the last one, and at every change between sweep and vibration. The
drone's position is the newest fix. Before the first fix of a track it is the best accepted detection, if the optional
input `detections` is connected; without it the sweep continues until there is a fix.

For a LiDAR on its side theta is ambiguous modulo 180 deg. The solution within the travel is used, of two the nearer
one. A drone that crosses an end of the travel would send the servo to the other end and back. While the drone is at
most `end_slack_deg` beyond the end, the servo instead stays and vibrates within its travel: the fan of +-15 deg still
covers the drone there.

Source: P III.A (sweep), III.C (vibration, there about the drone's azimuth). The ends and the stall time are ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from pydantic import Field, model_validator

from flow.stage import Settings, Stage
from stages.geometry.frames import Array64, LidarMount
from stages.messages import Detections, DroneFix, ServoGoal, ServoState, TrackingState, TrackState

RPM_RADPS = math.tau / 60.0


@dataclass(slots=True)
class _State:
    """State of the stage."""

    tracking: bool = False
    drone_vehicle_m: Array64 | None = None  # (3,); None: unknown, sweep
    has_fix: bool = False  # the position is a fix, not a detection
    centre_rad: float | None = None  # of the vibration; None during a sweep
    goal_rad: float | None = None  # None: the next servo state gets a new goal
    min_distance_rad: float = math.inf  # between servo and goal, since the goal was set
    min_distance_ns: int = 0  # when that minimum last decreased


class SweepVibrateAimSettings(Settings):
    """Settings of `SweepVibrateAim`."""

    mount: LidarMount  # poses of turntable and LiDAR, and the servo's zero, sign and errors
    travel_deg: tuple[float, float] = (0.0, 180.0)  # servo positions between which to sweep and vibrate
    sweep_rpm: float = Field(11.4, gt=0)  # servo speed during the sweep
    vibrate_rpm: float = Field(57.2, gt=0)  # servo speed of the vibration; an MX-28 at 12 V is limited to 55 rpm
    half_angle_deg: float = Field(5.0, gt=0, le=90)  # amplitude of the vibration
    goal_tolerance_deg: float = Field(0.5, gt=0)  # distance from the goal at which the servo reverses
    stall_s: float = Field(0.3, gt=0)  # a servo that comes no nearer to its goal for this long reverses, too
    end_slack_deg: float = Field(5.0, ge=0, le=15)  # drone this far beyond an end of the travel: the servo stays there

    @model_validator(mode="after")
    def _settings_agree(self) -> SweepVibrateAimSettings:
        if self.travel_deg[1] - self.travel_deg[0] < 2 * self.half_angle_deg:
            raise ValueError("travel_deg must be two increasing angles at least twice half_angle_deg apart")
        return self


class SweepVibrateAim(Stage[SweepVibrateAimSettings]):
    """Sweeps until the track is TRACKING, then vibrates about the drone until it is lost (P III.A and III.C)."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"detections"})

    def __init__(self, settings: SweepVibrateAimSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._state = _State()

    def on_detections(self, detections: Detections) -> None:
        """Set the drone's position to the best accepted detection, before the first fix."""
        if detections.accepted.any() and not self._state.has_fix:
            self._state.drone_vehicle_m = detections.xyz_vehicle_m[int(detections.accepted.argmax())]

    def on_fix(self, fix: DroneFix) -> None:
        """Set the drone's position to the newest fix."""
        self._state.drone_vehicle_m, self._state.has_fix = fix.xyz_vehicle_m, True

    def on_state(self, state: TrackState) -> None:
        """Discard the drone's position unless the track is TRACKING."""
        self._state.tracking = state.state is TrackingState.TRACKING
        if not self._state.tracking:
            self._state.drone_vehicle_m, self._state.has_fix = None, False

    def on_servo(self, servo: ServoState) -> ServoGoal | None:
        """A new goal when the last one is reached or obsolete, else None. No goal for a LiDAR that does not turn."""
        settings = self.settings
        state, position_rad = self._state, servo.position_rad
        if not settings.mount.turns:
            return None
        vibrate = state.tracking and state.drone_vehicle_m is not None
        changed = state.goal_rad is None or vibrate != (state.centre_rad is not None)
        if not changed and not self._reached(servo):
            return None
        low_rad, high_rad = self._ends_rad(position_rad) if vibrate else self._travel_rad
        if not vibrate:
            state.centre_rad = None
        near, far = sorted((low_rad, high_rad), key=lambda end: abs(end - position_rad))
        tolerance_rad = math.radians(settings.goal_tolerance_deg)
        state.goal_rad = near if changed and abs(near - position_rad) > tolerance_rad else far
        state.min_distance_rad, state.min_distance_ns = math.inf, servo.stamp_ns
        speed_rpm = settings.vibrate_rpm if vibrate else settings.sweep_rpm
        return ServoGoal(stamp_ns=servo.stamp_ns, position_rad=state.goal_rad, speed_radps=speed_rpm * RPM_RADPS)

    @property
    def _travel_rad(self) -> tuple[float, float]:
        return math.radians(self.settings.travel_deg[0]), math.radians(self.settings.travel_deg[1])

    def _reached(self, servo: ServoState) -> bool:
        """Whether the servo is at the goal, or stalled before it."""
        state = self._state
        assert state.goal_rad is not None
        distance_rad = abs(state.goal_rad - servo.position_rad)
        if distance_rad < state.min_distance_rad:
            state.min_distance_rad, state.min_distance_ns = distance_rad, servo.stamp_ns
        return (
            distance_rad < math.radians(self.settings.goal_tolerance_deg)
            or servo.stamp_ns - state.min_distance_ns > self.settings.stall_s * 1e9
        )

    def _ends_rad(self, position_rad: float) -> tuple[float, float]:
        """Servo positions between which to vibrate, about the drone's newest position."""
        settings = self.settings
        state = self._state
        assert state.drone_vehicle_m is not None
        slack_rad = 0.0 if state.centre_rad is None else math.radians(settings.end_slack_deg)
        near_rad = position_rad if state.centre_rad is None else state.centre_rad
        angles = servo_angles_rad(settings.mount, state.drone_vehicle_m)
        state.centre_rad = nearest_within(angles, near_rad, self._travel_rad, slack_rad)
        return vibration_ends_rad(state.centre_rad, math.radians(settings.half_angle_deg), self._travel_rad)


def plane_angles_rad(T_turntable_lidar: Array64, p_turntable_m: Array64) -> tuple[float, ...]:
    """Turntable angles theta in [0, 2 pi) at which the scan plane contains a point (3,); empty when every angle does.

    The plane has the normal n = R_turntable_lidar e_z and contains the LiDAR's origin o; both turn with the table:
    n . (Rz(-theta) p - o) = 0. With p = (rho cos phi, rho sin phi, z) and n = (m cos psi, m sin psi, n_z):
    m rho cos(phi - psi - theta) = n . o - n_z z. Without a solution, the theta of least distance.
    """
    n, o = T_turntable_lidar[:3, 2], T_turntable_lidar[:3, 3]
    x, y, z = p_turntable_m
    reach = math.hypot(n[0], n[1]) * math.hypot(x, y)
    if reach < 1e-9:
        return ()
    turn = math.acos(min(max(float(n @ o - n[2] * z) / reach, -1.0), 1.0))
    middle = math.atan2(y, x) - math.atan2(n[1], n[0])
    return (middle - turn) % math.tau, (middle + turn) % math.tau


def servo_angles_rad(mount: LidarMount, xyz_vehicle_m: Array64) -> tuple[float, ...]:
    """Servo positions, up to a turn from zero, at which the scan plane contains a point (3,) of the vehicle frame."""
    T = mount.T_vehicle_turntable.matrix()
    found: list[float] = []
    for theta in plane_angles_rad(mount.T_turntable_lidar.matrix(), T[:3, :3].T @ (xyz_vehicle_m - T[:3, 3])):
        servo = mount.servo_rad(theta)
        found += [servo - math.tau, servo, servo + math.tau]
    return tuple(found)


def nearest_within(
    angles_rad: tuple[float, ...], near_rad: float, travel_rad: tuple[float, float], slack_rad: float
) -> float:
    """The angle least beyond travel and slack, of equal ones the nearest to near_rad; near_rad without angles."""

    def cost(angle: float) -> tuple[float, float]:
        beyond = max(travel_rad[0] - angle, angle - travel_rad[1])
        return max(beyond - slack_rad, 0.0), abs(angle - near_rad)

    return min(angles_rad, key=cost, default=near_rad)


def vibration_ends_rad(centre_rad: float, half_rad: float, travel_rad: tuple[float, float]) -> tuple[float, float]:
    """Ends of a vibration about a centre, shifted to lie within the travel."""
    low = min(max(centre_rad - half_rad, travel_rad[0]), travel_rad[1] - 2 * half_rad)
    return low, low + 2 * half_rad
