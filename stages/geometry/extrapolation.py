"""Extrapolation of the vehicle's pose beyond its newest measurement, and detection of jumps in a pose source.

Within t seconds after the newest pose an unobserved maneuver moves the vehicle away from its extrapolated pose by

    a t^2 / 2   in position [m],        alpha t^2 / 2   in rotation [rad]

Speeds are averaged over at least 0.1 s: poses that arrive together would otherwise give a parked vehicle a speed.

| user                  | model and horizon                      | bound                                       |
| --------------------- | -------------------------------------- | ------------------------------------------- |
| VehicleTrajectory     | constant velocity, EXTRAPOLATION_S     | USUAL_MANEUVER: the next pose ends the error |
| VehicleMotionSelector | constant turn rate, SOURCE_CHANGE_S    | GAP_MANEUVER: the error stays                |
| VisualLidarOdometry   | constant velocity, to the next image   | GAP_MANEUVER, and any usual turn rate        |

A pose further from the extrapolation than HARDEST_MANEUVER allows is an outlier, or the source's start frame has jumped
(an odometry that restarts). The pose is rejected. When AGREE rejected poses in a row lie on one smooth path, they are
accepted as poses in a new start frame. After a gap of seconds HARDEST_MANEUVER allows nearly any pose, so a small
jump during a gap is not detected. For the same reason one plausible pose does not end a series of AGREE outliers:
a continuing series of invalid poses would contain a plausible one sooner or later.

Source: ours.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.kernels.geometry.trajectory import apart
from stages.messages import VehicleMotion

EXTRAPOLATION_S = 0.3
SOURCE_CHANGE_S = 1.0
LEAST_SPAN_NS = 100_000_000  # shortest interval over which a speed is averaged
MOST_SPAN_NS = 1_000_000_000  # longest interval over which a speed is averaged
OFF_M, OFF_RAD = 0.25, 0.1  # jump gate without any maneuver
LATE_S = 0.03  # timestamp error of a busy host; multiplied by the speed it is a position error
FASTEST_MPS, FASTEST_RADPS = 60.0, 2.0  # bounds while no speed is known
AGREE = 3  # consistent poses that establish a new start frame
Pose3 = tuple[Array64, Array64]  # R (3, 3) and xyz (3,) [m] in one frame


@dataclass(frozen=True)
class ManeuverBound:
    """Acceleration and angular acceleration that a vehicle may have without a measurement of them."""

    acceleration_mps2: float
    turn_radps2: float

    def displacement_m(self, seconds: float) -> float:
        """Deviation [m] from the extrapolated position after a time."""
        return 0.5 * self.acceleration_mps2 * seconds**2

    def turn_rad(self, seconds: float) -> float:
        """Deviation [rad] from the extrapolated rotation after a time."""
        return 0.5 * self.turn_radps2 * seconds**2


USUAL_MANEUVER = ManeuverBound(2.0, 0.2)  # one sigma in traffic, between two poses
GAP_MANEUVER = ManeuverBound(3.0, 0.5)  # one sigma over a gap in the measurements
HARDEST_MANEUVER = ManeuverBound(6.0, 1.5)  # limit of a road vehicle: full braking, evasive steering


class JumpGate:
    """Accepts or rejects the poses of one source, by whether each is reachable from the poses before it."""

    def __init__(self) -> None:
        self._rejected: deque[VehicleMotion] = deque(maxlen=AGREE)  # since the newest accepted pose

    def add(self, motion: VehicleMotion, reachable: bool) -> tuple[VehicleMotion, ...]:
        """The poses accepted now: this one, none, or the last AGREE together, which may have a new start frame."""
        if not reachable or len(self._rejected) == AGREE:
            self._rejected.append(motion)
            if not _is_smooth(tuple(self._rejected)):
                return ()
        accepted = (motion,) if reachable else tuple(self._rejected)
        self._rejected.clear()
        return accepted


class AcceptedPoses:
    """The accepted poses of one source, in that source's start frame."""

    def __init__(self) -> None:
        self._gate = JumpGate()
        self._poses: deque[VehicleMotion] = deque(maxlen=64)  # of one start frame
        self.speed_mps: float | None = None  # newest known speed; None: never known

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest accepted pose; None before the first."""
        return self._poses[-1].stamp_ns if self._poses else None

    def add(self, motion: VehicleMotion) -> tuple[VehicleMotion, ...]:
        """The poses accepted now, as in `JumpGate.add`. The caller drops a pose that is not newer than the last."""
        accepted = (motion,) if not self._poses else self._gate.add(motion, self._is_reachable(motion))
        if len(accepted) > 1:
            self._poses.clear()  # of another start frame
        self._poses.extend(accepted)
        if accepted:
            newest_mps = speed_mps(list(self._poses))
            self.speed_mps = self.speed_mps if newest_mps is None else newest_mps
        return accepted

    def _is_reachable(self, motion: VehicleMotion) -> bool:
        poses, last_ns = list(self._poses), self._poses[-1].stamp_ns
        predicted = constant_turn_rate(poses, motion.stamp_ns, until_s=math.inf)
        expected, measured = ((m.R_map_vehicle, m.xyz_map_m) for m in (predicted, motion))
        return is_reachable(expected, measured, (motion.stamp_ns - last_ns) * 1e-9, speed_mps(poses))


def is_reachable(expected: Pose3, measured: Pose3, seconds: float, speed_mps: float | None) -> bool:
    """Whether a measured pose lies within HARDEST_MANEUVER of the extrapolated one.

    `seconds`: since the newest accepted pose. `speed_mps`: the speed of the extrapolation; None: not known.
    """
    limit_m, limit_rad = OFF_M + HARDEST_MANEUVER.displacement_m(seconds), OFF_RAD + HARDEST_MANEUVER.turn_rad(seconds)
    if speed_mps is None:
        limit_m, limit_rad = limit_m + FASTEST_MPS * seconds, limit_rad + FASTEST_RADPS * seconds
    else:
        limit_m += LATE_S * speed_mps
    distance_m, angle_rad = apart(*expected, *measured)
    return distance_m <= limit_m and angle_rad <= limit_rad


def _is_smooth(poses: tuple[VehicleMotion, ...]) -> bool:
    """Whether AGREE poses lie on one smooth path: the second step continues the first."""
    if len(poses) < AGREE:
        return False
    a, b, c = poses
    first_s, second_s = (b.stamp_ns - a.stamp_ns) * 1e-9, (c.stamp_ns - b.stamp_ns) * 1e-9
    if min(first_s, second_s) <= 0.0:
        return False
    share, longer_s = second_s / first_s, max(first_s, second_s)
    off_m = c.xyz_map_m - b.xyz_map_m - share * (b.xyz_map_m - a.xyz_map_m)
    turns = log_rotation(a.R_map_vehicle.T @ b.R_map_vehicle), log_rotation(b.R_map_vehicle.T @ c.R_map_vehicle)
    near = float(np.linalg.norm(off_m)) <= OFF_M + 2.0 * HARDEST_MANEUVER.displacement_m(longer_s)
    return near and float(np.linalg.norm(turns[1] - share * turns[0])) <= OFF_RAD + 2.0 * HARDEST_MANEUVER.turn_rad(
        longer_s
    )


def constant_turn_rate(poses: list[VehicleMotion], stamp_ns: int, until_s: float = SOURCE_CHANGE_S) -> VehicleMotion:
    """The vehicle's pose at a time after the newest of `poses` (oldest first), with constant body rates.

    Velocity and turn rate, in vehicle axes, are averaged over the last LEAST_SPAN_NS or more. After `until_s` the pose
    stays constant. The covariance grows by GAP_MANEUVER all the time; it is None where the newest pose has none.
    """
    last = poses[-1]
    gap_s = (stamp_ns - last.stamp_ns) * 1e-9
    span_ns, before = _speed_span(poses)
    share = min(gap_s, until_s) / (span_ns * 1e-9) if span_ns else 0.0
    R = last.R_map_vehicle
    turn = log_rotation(np.ascontiguousarray(before.R_map_vehicle.T @ R))
    displacement_m = exp_rotation(-0.5 * turn) @ before.R_map_vehicle.T @ (last.xyz_map_m - before.xyz_map_m)  # vehicle
    growth = np.diag([GAP_MANEUVER.turn_rad(gap_s) ** 2] * 3 + [GAP_MANEUVER.displacement_m(gap_s) ** 2] * 3)
    return VehicleMotion(
        stamp_ns=stamp_ns,
        xyz_map_m=last.xyz_map_m + R @ exp_rotation(0.5 * share * turn) @ (share * displacement_m),
        R_map_vehicle=R @ exp_rotation(share * turn),
        covariance=None if last.covariance is None else last.covariance + growth,
    )


def speed_mps(poses: list[VehicleMotion]) -> float | None:
    """Mean speed over the last LEAST_SPAN_NS or more; None where the poses do not determine one."""
    span_ns, before = _speed_span(poses)
    return math.dist(poses[-1].xyz_map_m, before.xyz_map_m) / (span_ns * 1e-9) if span_ns else None


def _speed_span(poses: list[VehicleMotion]) -> tuple[int, VehicleMotion]:
    """The interval [ns] over which the speed is averaged and the pose at its start; 0: no speed is known."""
    last = poses[-1]
    spans_ns = ((last.stamp_ns - m.stamp_ns, m) for m in reversed(poses))
    span_ns, before = next(((span, m) for span, m in spans_ns if span >= LEAST_SPAN_NS), (0, last))
    return (span_ns, before) if span_ns <= MOST_SPAN_NS else (0, last)
