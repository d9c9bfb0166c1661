"""The mount parameters that a calibration estimates, and their conversion from and to a rig's `LidarMount`.

    p_base = R_base_turntable Rz(angle) (R_turntable_lidar p_lidar + t_turntable_lidar)
    angle(t) = sign * (s - lag - zero) - sum_k (sin_k sin(k s) + cos_k cos(k s)),  s = encoder at t - time_offset

`base` is the frame of the rig's T_vehicle_turntable: it is at rest while the vehicle is. `lag` is the play of the
gear: the turntable lags by half of it, on the side it comes from.

Source: ours; the model of `stages/geometry/frames.py` (LidarMount) and `stages/sweep/turntable.py`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from stages.geometry.frames import Array64, Harmonic, LidarMount, Pose, quaternions_xyzw
from stages.kernels.geometry.so3 import exp_rotation

ORDERS = (1, 2)
"""Estimated orders of the encoder error: a magnet off centre gives order 1, a tilted one order 2."""
SMALLEST_DEG = 1e-6  # smaller harmonics are omitted


@dataclass(frozen=True)
class ServoMount:
    """Mount parameters; `sin_cos_rad[order]` are the sine and cosine terms of the encoder error."""

    R_turntable_lidar: Array64
    t_turntable_lidar_m: Array64
    sign: int
    zero_rad: float
    sin_cos_rad: dict[int, tuple[float, float]]
    play_rad: float
    time_offset_s: float

    def encoder_error_rad(self, servo_rad: Array64) -> Array64:
        """Encoder error (n,) to subtract from the angle."""
        error = np.zeros_like(servo_rad)
        for order, (sine, cosine) in self.sin_cos_rad.items():
            error += sine * np.sin(order * servo_rad) + cosine * np.cos(order * servo_rad)
        return error

    def moved(self, step: dict[str, float]) -> ServoMount:
        """The mount after a step in the parameters of `stages/calibration/parameters.py` (missing ones: 0).

        tilt_x, tilt_y [rad] rotate the LiDAR about the turntable's axes, axis_x, axis_y [m] shift it along them.
        """
        tilt = exp_rotation(np.array([step.get("tilt_x", 0.0), step.get("tilt_y", 0.0), 0.0]))
        shift = np.array([step.get("axis_x", 0.0), step.get("axis_y", 0.0), 0.0])
        terms = dict(self.sin_cos_rad)
        for order in ORDERS:
            sine, cosine = terms.get(order, (0.0, 0.0))
            terms[order] = sine + step.get(f"sin_{order}", 0.0), cosine + step.get(f"cos_{order}", 0.0)
        return replace(
            self,
            R_turntable_lidar=tilt @ self.R_turntable_lidar,
            t_turntable_lidar_m=self.t_turntable_lidar_m + shift,
            zero_rad=self.zero_rad + step.get("zero", 0.0),
            sin_cos_rad=terms,
            play_rad=self.play_rad + step.get("play", 0.0),
            time_offset_s=self.time_offset_s + step.get("time", 0.0),
        )


def servo_mount(mount: LidarMount) -> ServoMount:
    """The parameters of a rig's mount."""
    T_turntable_lidar = mount.T_turntable_lidar.matrix()
    terms: dict[int, tuple[float, float]] = {}
    for term in mount.servo_harmonics:  # a sin(k s + b) = a cos(b) sin(k s) + a sin(b) cos(k s)
        a, b = math.radians(term.amplitude_deg), math.radians(term.phase_deg)
        sine, cosine = terms.get(term.order, (0.0, 0.0))
        terms[term.order] = sine + a * math.cos(b), cosine + a * math.sin(b)
    return ServoMount(
        R_turntable_lidar=T_turntable_lidar[:3, :3],
        t_turntable_lidar_m=T_turntable_lidar[:3, 3],
        sign=mount.servo_sign,
        zero_rad=math.radians(mount.servo_zero_deg),
        sin_cos_rad=terms,
        play_rad=math.radians(mount.servo_play_deg),
        time_offset_s=mount.servo_time_offset_s,
    )


def lidar_mount(found: ServoMount, rig: LidarMount) -> LidarMount:
    """A rig's mount with the estimated parameters; T_vehicle_turntable stays the rig's."""
    x, y, z = found.t_turntable_lidar_m.tolist()
    qx, qy, qz, qw = quaternions_xyzw(found.R_turntable_lidar[None])[0].tolist()
    return LidarMount(
        T_vehicle_turntable=rig.T_vehicle_turntable,
        T_turntable_lidar=Pose(xyz_m=(x, y, z), quaternion_xyzw=(qx, qy, qz, qw)),
        turns=rig.turns,
        servo_sign=rig.servo_sign,
        servo_zero_deg=math.degrees(found.zero_rad),
        servo_time_offset_s=found.time_offset_s,
        servo_harmonics=harmonics(found.sin_cos_rad),
        servo_play_deg=math.degrees(max(found.play_rad, 0.0)),
    )


def harmonics(sin_cos_rad: dict[int, tuple[float, float]]) -> tuple[Harmonic, ...]:
    """Terms as a rig states them, amplitude * sin(order * angle + phase)."""
    found: list[Harmonic] = []
    for order, (sine, cosine) in sorted(sin_cos_rad.items()):
        amplitude_deg = math.degrees(math.hypot(sine, cosine))
        if amplitude_deg > SMALLEST_DEG:
            phase_deg = math.degrees(math.atan2(cosine, sine))
            found.append(Harmonic(order=order, amplitude_deg=amplitude_deg, phase_deg=phase_deg))
    return tuple(found)
