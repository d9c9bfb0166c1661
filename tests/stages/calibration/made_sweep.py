"""A yard of flat walls, swept by a LiDAR with an exactly known mount: ground truth of a calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.calibration.columns import about_z
from stages.calibration.scan_passes import Returns, ServoTrace
from stages.calibration.servo_mount import ServoMount, servo_mount
from stages.geometry.frames import LidarMount, Pose
from tests.stages.made import ELEVATION_RAD, START_NS

STEP_RAD = 2 * np.pi / 4096
RIG = LidarMount(
    T_vehicle_turntable=Pose(xyz_m=(0.0, 0.0, 0.25)),
    T_turntable_lidar=Pose(xyz_m=(0.0, 0.0, 0.10), rpy_deg=(90.0, 0.0, 0.0)),
)
GROUND = ((0.0, 0.0, -1.0, 2.0),)  # normal and distance of a plane
YARD = (
    *GROUND,
    *((np.cos(a), np.sin(a), 0.02, d) for a, d in ((0.1, 9.3), (1.5, 7.4), (2.9, 12.3), (4.0, 8.7), (5.2, 10.6))),
)
SLOW, FAST = 68.0, 250.0  # deg/s
THERE_AND_BACK_TWICE = ((0.0, 180.0, SLOW), (180.0, 0.0, SLOW), (0.0, 180.0, FAST), (180.0, 0.0, FAST))


def wrong_mount(seed: int = 0) -> ServoMount:
    """The rig with realistic errors."""
    rng = np.random.default_rng([seed, 1])
    return servo_mount(RIG).moved(
        {
            "tilt_x": float(np.radians(rng.normal(0, 0.3))),
            "tilt_y": float(np.radians(rng.normal(0, 0.3))),
            "axis_x": float(rng.normal(0, 0.006)),
            "axis_y": float(rng.normal(0, 0.006)),
            **{name: float(np.radians(rng.normal(0, 0.15))) for name in ("sin_1", "cos_1", "sin_2", "cos_2")},
            "play": float(np.radians(0.33)),
            "time": float(rng.uniform(-4e-3, 4e-3)),
        }
    )


@dataclass(frozen=True)
class Sweep:
    returns: Returns
    trace: ServoTrace


def turned(true: ServoMount, legs, t_s):
    """(encoder's true position, turntable's angle) at times, of a servo that follows legs (from, to, deg/s)."""
    knots, places = [0.0], [legs[0][0]]
    for _, to, speed in legs:
        knots.append(knots[-1] + abs(to - places[-1]) / speed)
        places.append(to)
    fine_s = np.arange(-0.1, knots[-1] + 0.1, 1e-3)
    fine = np.radians(np.interp(fine_s, knots, places))
    lag, half = np.zeros(len(fine)), true.play_rad / 2
    for k in range(1, len(fine)):
        lag[k] = np.clip(lag[k - 1] + fine[k] - fine[k - 1], -half, half)
    position = np.interp(t_s, fine_s, fine)
    lag = np.interp(t_s, fine_s, lag)
    return position, true.sign * (position - lag - true.zero_rad) - true.encoder_error_rad(position), knots[-1]


def sweep(
    true: ServoMount,
    legs=THERE_AND_BACK_TWICE,
    planes=YARD,
    seed: int = 0,
    velocity_mps=(0.0, 0.0, 0.0),
    count: int = 60_000,
    noise_m: float = 0.008,
) -> Sweep:
    """Returns of beams on planes (nx, ny, nz, distance), and the servo as it answers at 200 Hz in whole steps."""
    rng = np.random.default_rng(seed)
    end_s = turned(true, legs, np.zeros(1))[2]
    firing_s = np.sort(rng.uniform(0, end_s, count // 16))
    t_s = (firing_s[:, None] + 2.304e-6 * np.arange(16)).ravel()
    laser = np.tile(np.arange(16), len(firing_s)).astype(np.uint8)
    azimuth, elevation = 2 * np.pi * 10 * t_s, ELEVATION_RAD[laser]
    along = np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)], axis=1
    )
    _, angle, _ = turned(true, legs, t_s)
    cs = np.column_stack([np.cos(angle), np.sin(angle)])
    beam = about_z(along @ true.R_turntable_lidar.T, cs)
    origin = about_z(np.broadcast_to(true.t_turntable_lidar_m, beam.shape), cs) + np.outer(t_s, velocity_mps)
    nearest = np.full(len(t_s), np.inf)
    for *normal, distance in planes:
        towards = beam @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            r = (distance - origin @ normal) / towards
        nearest = np.where((towards > 0) & (r > 0) & (r < nearest), r, nearest)
    seen = (nearest > 1.0) & (nearest < 60.0)
    bias = rng.normal(0, 0.01, 16)
    measured = nearest + rng.normal(0, noise_m, len(t_s)) + (bias - bias.mean())[laser]
    stamp_ns = START_NS + np.round(t_s * 1e9).astype(np.int64)
    state_s = np.arange(-0.02, end_s + 0.03, 0.005)
    position = np.round(turned(true, legs, state_s)[0] / STEP_RAD) * STEP_RAD
    state_ns = START_NS + np.round((state_s - true.time_offset_s) * 1e9).astype(np.int64)
    return Sweep(
        Returns(stamp_ns[seen], laser[seen], along[seen] * measured[seen, None]),
        ServoTrace.of(state_ns, position, STEP_RAD),
    )
