"""Aim: where the turntable goes next. Sweep the whole travel until the drone is tracked, then vibrate about it.

    SEARCHING or LOST:  0..180 deg and back at 11.4 rpm
    TRACKING:           theta +- 5 deg at 57.2 rpm, theta the servo angle that puts the scan plane on the drone

A new goal is given when the servo has reached the last one, and at once when search and tracking change over. The
drone's place is the newest fix; before the first fix of a track it is the best accepted detection (wire `detections`
for that, else the sweep goes on until there is a fix).

A scan plane has two sides, so theta is known modulo 180 deg for a LiDAR on its side. The side within the travel is
taken, the nearer one of two. A drone that crosses the end of the travel would send the servo to the other end and back;
while it is at most `end_slack_deg` beyond the end the servo stays, swinging within its travel: the fan of +-15 deg
still covers the drone there.

Source: P III.A (sweep), III.C (vibration, literally about the drone's azimuth). The ends and patience are ours.
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
class _Now:
    """What the aim remembers."""

    tracking: bool = False
    drone_vehicle_m: Array64 | None = None  # None: not known, sweep
    fixed: bool = False  # the place is a fix, not a detection
    centre_rad: float | None = None  # of the vibration; None while sweeping
    goal_rad: float | None = None  # None: decide anew with the next servo state
    nearest_rad: float = math.inf  # how near the servo has come to the goal
    nearer_ns: int = 0  # when it last came nearer


class SweepVibrateAimSettings(Settings):
    """Settings of `SweepVibrateAim`."""

    mount: LidarMount
    travel_deg: tuple[float, float] = (0.0, 180.0)  # servo positions between which to sweep and vibrate
    sweep_rpm: float = Field(11.4, gt=0)
    vibrate_rpm: float = Field(57.2, gt=0)  # more than an MX-28 does at 12 V (55 rpm); the servo keeps to what it can
    half_angle_deg: float = Field(5.0, gt=0, le=90)
    arrived_deg: float = Field(0.5, gt=0)  # this near the goal the servo turns round
    patience_s: float = Field(0.3, gt=0)  # so does one that has come no nearer for so long: a limit, a stall
    end_slack_deg: float = Field(5.0, ge=0, le=15)

    @model_validator(mode="after")
    def _settings_agree(self) -> SweepVibrateAimSettings:
        if self.travel_deg[1] - self.travel_deg[0] < 2 * self.half_angle_deg:
            raise ValueError("travel_deg must be two growing angles at least twice half_angle_deg apart")
        return self


class SweepVibrateAim(Stage[SweepVibrateAimSettings]):
    """P III.A and III.C: sweep until the track is TRACKING, vibrate about the drone while it is, sweep again."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"detections"})

    def __init__(self, settings: SweepVibrateAimSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._now = _Now()

    def on_detections(self, detections: Detections) -> None:
        """Before the first fix the drone is where the best accepted detection has it."""
        if detections.accepted.any() and not self._now.fixed:
            self._now.drone_vehicle_m = detections.xyz_vehicle_m[int(detections.accepted.argmax())]

    def on_fix(self, fix: DroneFix) -> None:
        """The drone is where it was seen last."""
        self._now.drone_vehicle_m, self._now.fixed = fix.xyz_vehicle_m, True

    def on_state(self, state: TrackState) -> None:
        """Only TRACKING has a drone to aim at."""
        self._now.tracking = state.state is TrackingState.TRACKING
        if not self._now.tracking:
            self._now.drone_vehicle_m, self._now.fixed = None, False

    def on_servo(self, servo: ServoState) -> ServoGoal | None:
        """A new goal when the last one is reached or out of date, else None. Never one for a LiDAR bolted down."""
        settings = self.settings
        now, position_rad = self._now, servo.position_rad
        if not settings.mount.turns:
            return None
        vibrate = now.tracking and now.drone_vehicle_m is not None
        started = now.goal_rad is None or vibrate != (now.centre_rad is not None)
        if not started and not self._reached(servo):
            return None
        low_rad, high_rad = self._ends_rad(position_rad) if vibrate else self._travel_rad
        if not vibrate:
            now.centre_rad = None
        near, far = sorted((low_rad, high_rad), key=lambda end: abs(end - position_rad))
        now.goal_rad = near if started and abs(near - position_rad) > math.radians(settings.arrived_deg) else far
        now.nearest_rad, now.nearer_ns = math.inf, servo.stamp_ns
        speed_rpm = settings.vibrate_rpm if vibrate else settings.sweep_rpm
        return ServoGoal(stamp_ns=servo.stamp_ns, position_rad=now.goal_rad, speed_radps=speed_rpm * RPM_RADPS)

    @property
    def _travel_rad(self) -> tuple[float, float]:
        return math.radians(self.settings.travel_deg[0]), math.radians(self.settings.travel_deg[1])

    def _reached(self, servo: ServoState) -> bool:
        """Whether the servo is at the goal, or has given up on it."""
        now = self._now
        assert now.goal_rad is not None
        left_rad = abs(now.goal_rad - servo.position_rad)
        if left_rad < now.nearest_rad:
            now.nearest_rad, now.nearer_ns = left_rad, servo.stamp_ns
        return (
            left_rad < math.radians(self.settings.arrived_deg)
            or servo.stamp_ns - now.nearer_ns > self.settings.patience_s * 1e9
        )

    def _ends_rad(self, position_rad: float) -> tuple[float, float]:
        """Between which servo positions to vibrate now."""
        settings = self.settings
        now = self._now
        assert now.drone_vehicle_m is not None
        slack_rad = 0.0 if now.centre_rad is None else math.radians(settings.end_slack_deg)
        near_rad = position_rad if now.centre_rad is None else now.centre_rad
        angles = servo_angles_rad(settings.mount, now.drone_vehicle_m)
        now.centre_rad = nearest_within(angles, near_rad, self._travel_rad, slack_rad)
        return swing_rad(now.centre_rad, math.radians(settings.half_angle_deg), self._travel_rad)


def plane_angles_rad(T_turntable_lidar: Array64, p_turntable_m: Array64) -> tuple[float, ...]:
    """Turntable angles theta in [0, 2 pi) at which the scan plane holds a point (3,); none when every angle does.

    The plane has the normal n = R_turntable_lidar e_z and holds the LiDAR's origin o, both turning with the table:
    n . (Rz(-theta) p - o) = 0. With p = (rho cos phi, rho sin phi, z) and n = (m cos psi, m sin psi, n_z):
    m rho cos(phi - psi - theta) = n . o - n_z z. Where no theta does it, the one that comes nearest.
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
    """Servo positions within a turn either way of zero that put the scan plane on a point (3,) of the vehicle frame."""
    T = mount.T_vehicle_turntable.matrix()
    found: list[float] = []
    for theta in plane_angles_rad(mount.T_turntable_lidar.matrix(), T[:3, :3].T @ (xyz_vehicle_m - T[:3, 3])):
        servo = mount.servo_rad(theta)
        found += [servo - math.tau, servo, servo + math.tau]
    return tuple(found)


def nearest_within(
    angles_rad: tuple[float, ...], near_rad: float, travel_rad: tuple[float, float], slack_rad: float
) -> float:
    """The angle least beyond the travel and its slack, of equals the nearest to near_rad; near_rad without angles."""

    def cost(angle: float) -> tuple[float, float]:
        beyond = max(travel_rad[0] - angle, angle - travel_rad[1])
        return max(beyond - slack_rad, 0.0), abs(angle - near_rad)

    return min(angles_rad, key=cost, default=near_rad)


def swing_rad(centre_rad: float, half_rad: float, travel_rad: tuple[float, float]) -> tuple[float, float]:
    """Ends of a swing about a centre, moved whole into the travel."""
    low = min(max(centre_rad - half_rad, travel_rad[0]), travel_rad[1] - 2 * half_rad)
    return low, low + 2 * half_rad
