"""The autopilot's own estimate at a time, and the resets of its estimator.

A reset is a change of `reset_counter`, a position that its own velocity does not explain, a velocity that the
accelerometer does not explain, or an attitude that its own rates do not explain. Each begins a new segment, and so does
a gap after which none of this can be tested. Samples are propagated with the IMU to the requested time.

Source: ours. ArduPilot resets position and velocity when GPS or an external pose was rejected for some seconds, and
yaw when the compass is found wrong: https://ardupilot.org/copter/docs/common-ek3-sources.html, NavEKF3 resetPosition.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import AutopilotMotion, DroneAttitude, DroneLocalPosition, DroneOdometry, DroneTilt

GRAVITY_MPS2 = 9.80665
GAP_S = 0.5  # after a longer one a reset cannot be detected
JUMP_M, JUMP_PER_M = 0.3, 0.3  # position: and per metre travelled between the samples
JUMP_MPS, JUMP_MPS2 = 0.5, 5.0  # velocity against the accelerometer: and per second between the samples
JUMP_RAD, JUMP_PER_RAD = math.radians(3.0), 0.3
ODOMETRY_NS = 1_000_000_000  # ODOMETRY this recent replaces ATTITUDE and LOCAL_POSITION_NED


@dataclass(frozen=True, slots=True)
class _Attitude:
    stamp_ns: int
    R_odom_drone: Array64
    rate_drone_radps: Array64
    independent: bool


@dataclass(frozen=True, slots=True)
class _Position:
    stamp_ns: int
    xyz_odom_m: Array64
    velocity_odom_mps: Array64
    independent: bool


class AutopilotEstimate:
    """The newest attitude and position of the autopilot, in segments without a reset."""

    def __init__(self, age_s: float) -> None:
        self._age_ns = round(1e9 * age_s)  # longest propagation of a sample
        self._tilt: DroneTilt | None = None
        self._attitude: _Attitude | None = None
        self._position: _Position | None = None
        self._odometry_ns: int | None = None
        self._reset_counter: int | None = None
        self._specific_force_mps2 = np.array([0.0, 0.0, GRAVITY_MPS2])
        self._rate_radps = np.zeros(3)
        self.segment = 0
        """Number of resets and gaps so far."""

    def on_imu(self, specific_force_mps2: Array64, rate_radps: Array64) -> None:
        """The newest mean specific force and rate, for propagation."""
        self._specific_force_mps2, self._rate_radps = specific_force_mps2, rate_radps

    def on_attitude(self, message: DroneAttitude) -> None:
        """Add an ATTITUDE; while ODOMETRY arrives it is not used."""
        if not self._replaced(message.stamp_ns):
            R, rate = message.R_odom_drone, message.angular_velocity_drone_radps
            self._add_attitude(_Attitude(message.stamp_ns, R, rate, message.independent))

    def on_position(self, message: DroneLocalPosition) -> None:
        """Add a LOCAL_POSITION_NED; while ODOMETRY arrives it is not used."""
        if not self._replaced(message.stamp_ns):
            xyz, velocity = message.xyz_odom_m, message.velocity_odom_mps
            self._add_position(_Position(message.stamp_ns, xyz, velocity, message.independent))

    def on_odometry(self, message: DroneOdometry) -> None:
        """Add an ODOMETRY; an estimate that the autopilot reports as failed is not used."""
        if message.quality_percent == 0:
            return
        self._odometry_ns = message.stamp_ns
        if self._reset_counter not in (None, message.reset_counter):
            self._new_segment()
        self._reset_counter = message.reset_counter
        R, rate = message.R_odom_drone, message.angular_velocity_drone_radps
        self._add_attitude(_Attitude(message.stamp_ns, R, rate, message.independent))
        xyz, velocity = message.xyz_odom_m, R @ message.velocity_drone_mps
        self._add_position(_Position(message.stamp_ns, xyz, velocity, message.independent))

    def on_tilt(self, message: DroneTilt) -> None:
        """Add the vertical by roll and pitch."""
        self._tilt = message

    def up_drone(self, stamp_ns: int) -> Array64 | None:
        """Unit vector up in drone axes, propagated by the IMU. None: no recent one."""
        tilt = self._tilt
        if tilt is None or abs(stamp_ns - tilt.stamp_ns) > self._age_ns:
            return None
        return tilt.up_drone @ exp_rotation((stamp_ns - tilt.stamp_ns) * 1e-9 * self._rate_radps)

    def at(self, stamp_ns: int) -> AutopilotMotion | None:
        """The estimate at a time; None: not at hand, or it may contain poses that grd sent."""
        attitude, position = self._attitude, self._position
        R = self._R_odom_drone(stamp_ns)
        if attitude is None or position is None or R is None:
            return None
        if not (attitude.independent and position.independent):
            return None
        since_ns = stamp_ns - position.stamp_ns
        if abs(since_ns) > self._age_ns:
            return None
        since_s = since_ns * 1e-9
        change_mps = since_s * self._acceleration_odom_mps2(R)
        return AutopilotMotion(
            xyz_odom_m=position.xyz_odom_m + since_s * (position.velocity_odom_mps + 0.5 * change_mps),
            R_odom_drone=R,
            velocity_odom_mps=position.velocity_odom_mps + change_mps,
            odom_segment=self.segment,
        )

    def _R_odom_drone(self, stamp_ns: int) -> Array64 | None:
        attitude = self._attitude
        if attitude is None or abs(stamp_ns - attitude.stamp_ns) > self._age_ns:
            return None
        return attitude.R_odom_drone @ exp_rotation((stamp_ns - attitude.stamp_ns) * 1e-9 * self._rate_radps)

    def _acceleration_odom_mps2(self, R_odom_drone: Array64) -> Array64:
        return R_odom_drone @ self._specific_force_mps2 - np.array([0.0, 0.0, GRAVITY_MPS2])

    def _replaced(self, stamp_ns: int) -> bool:
        return self._odometry_ns is not None and stamp_ns - self._odometry_ns < ODOMETRY_NS

    def _add_attitude(self, new: _Attitude) -> None:
        last = self._attitude
        if last is not None:
            dt = (new.stamp_ns - last.stamp_ns) * 1e-9
            if dt <= 0:
                return
            turn = 0.5 * dt * (last.rate_drone_radps + new.rate_drone_radps)
            off = log_rotation((last.R_odom_drone @ exp_rotation(turn)).T @ new.R_odom_drone)
            if dt > GAP_S or np.linalg.norm(off) > JUMP_RAD + JUMP_PER_RAD * np.linalg.norm(turn):
                self._new_segment()
        self._attitude = new

    def _add_position(self, new: _Position) -> None:
        last = self._position
        if last is not None:
            dt = (new.stamp_ns - last.stamp_ns) * 1e-9
            if dt <= 0:
                return
            path = 0.5 * dt * (last.velocity_odom_mps + new.velocity_odom_mps)
            off_m = np.linalg.norm(new.xyz_odom_m - last.xyz_odom_m - path)
            change_mps = new.velocity_odom_mps - last.velocity_odom_mps
            if self._attitude is not None:
                change_mps = change_mps - dt * self._acceleration_odom_mps2(self._attitude.R_odom_drone)
            jumped = off_m > JUMP_M + JUMP_PER_M * np.linalg.norm(path)
            turned = np.linalg.norm(change_mps) > JUMP_MPS + JUMP_MPS2 * dt
            if dt > GAP_S or jumped or turned:
                self._new_segment()
        self._position = new

    def _new_segment(self) -> None:
        self.segment += 1
