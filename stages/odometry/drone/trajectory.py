"""Trajectory of the drone in frame odom, without the jumps of the autopilot's estimate, and rotations between times.

The autopilot's raw local frame has an arbitrary yaw, and its EKF may reset it in flight (compass, GPS). A change of
attitude that the rates do not confirm, or of position that the velocity does not confirm, is such a jump and is
removed: frame odom is the raw local frame at the start, continued smoothly. Without an autopilot, visual odometry is
chained instead. Without either, the drone is assumed to keep its yaw, with a large variance.

Attitude and position are interpolated between samples. Within a gap longer than BRIDGED_NS they are not known; the
displacement and rotation over the whole gap still are.

Source: ours; DESIGN: R_GD follows 120 deg/s.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import DroneAttitude, DroneLocalPosition, DroneOdometry, VisualMotion

KEPT = 1024  # samples
AHEAD_NS = 250_000_000  # extrapolation beyond the newest sample of a source
BRIDGED_NS = 1_000_000_000  # longest gap that is interpolated; radio links pause this long
GAP_S = 0.5  # after a longer gap rates and velocity cannot detect a jump
JUMP_RAD = math.radians(3.0)
JUMP_M = 0.3
DRIFT_RAD2_PER_S = math.radians(0.3) ** 2  # random walk of the autopilot's yaw
CLOCK_S = 0.02  # timestamp error of an attitude: 2.4 deg at 120 deg/s
UNKNOWN_RAD_PER_S = math.radians(40.0)  # yaw rate, one sigma, without any measurement
ODOMETRY_NS = 1_000_000_000  # DroneOdometry this recent replaces DroneAttitude and DroneLocalPosition


@dataclass(frozen=True)
class DroneRotation:
    """Rotation of the drone between two times."""

    R_from_to: Array64
    variance_rad2: float  # of the yaw
    measured: bool  # False: no source covers the interval, R_from_to is the identity


@dataclass(frozen=True)
class _Attitude:
    stamp_ns: int
    R_odom_drone: Array64
    rate_drone_radps: Array64


@dataclass(frozen=True)
class _Position:
    stamp_ns: int
    xyz_odom_m: Array64
    velocity_odom_mps: Array64
    segment: int  # displacements are known within a segment, not between segments


_Sample = TypeVar("_Sample", _Attitude, _Position)


class AutopilotTrajectory:
    """The autopilot's attitude and position in frame odom."""

    def __init__(self) -> None:
        self._attitudes: deque[_Attitude] = deque(maxlen=KEPT)
        self._positions: deque[_Position] = deque(maxlen=KEPT)
        self._R_odom_raw = np.eye(3)
        self._offset_m = np.zeros(3)  # xyz_odom = R_odom_raw xyz_raw + offset
        self._reset_counter: int | None = None
        self._odometry_ns: int | None = None
        self.jumps = 0  # jumps removed
        self.gaps = 0  # gaps across which a jump cannot be detected

    def add(self, message: DroneAttitude | DroneLocalPosition | DroneOdometry) -> None:
        """Add a message of the autopilot; DroneOdometry takes precedence over attitude and position messages.

        An estimate that the autopilot reports as failed is ignored.
        """
        if isinstance(message, DroneOdometry):
            if message.quality_percent == 0:
                return
            self._odometry_ns = message.stamp_ns
            self.reset(message.reset_counter)
            self.add_attitude(message.stamp_ns, message.R_odom_drone, message.angular_velocity_drone_radps)
            self.add_position(message.stamp_ns, message.xyz_odom_m, message.R_odom_drone @ message.velocity_drone_mps)
        elif self._odometry_ns is not None and message.stamp_ns - self._odometry_ns < ODOMETRY_NS:
            return
        elif isinstance(message, DroneAttitude):
            self.add_attitude(message.stamp_ns, message.R_odom_drone, message.angular_velocity_drone_radps)
        else:
            self.add_position(message.stamp_ns, message.xyz_odom_m, message.velocity_odom_mps)

    def add_attitude(self, stamp_ns: int, R_raw_drone: Array64, rate_drone_radps: Array64) -> None:
        """Add an attitude in the raw frame; one that is not newer than the last is ignored."""
        R_odom_drone = self._R_odom_raw @ R_raw_drone
        if self._attitudes:
            last = self._attitudes[-1]
            dt = (stamp_ns - last.stamp_ns) * 1e-9
            if dt <= 0:
                return
            turn = 0.5 * dt * (last.rate_drone_radps + rate_drone_radps)
            expected = last.R_odom_drone @ exp_rotation(turn)
            off = float(np.linalg.norm(log_rotation(expected.T @ R_odom_drone)))
            if dt > GAP_S:
                self.gaps += 1
            elif off > JUMP_RAD + 0.3 * float(np.linalg.norm(turn)):
                self.jumps += 1
                self._R_odom_raw = expected @ R_raw_drone.T
                self._end_segment()
                R_odom_drone = expected
        self._attitudes.append(_Attitude(stamp_ns, R_odom_drone, rate_drone_radps))

    def add_position(self, stamp_ns: int, xyz_raw_m: Array64, velocity_raw_mps: Array64) -> None:
        """Add a position and velocity in the raw frame, of the same estimate as the attitude."""
        xyz = self._R_odom_raw @ xyz_raw_m + self._offset_m
        velocity = self._R_odom_raw @ velocity_raw_mps
        segment = 0
        if self._positions:
            last = self._positions[-1]
            dt = (stamp_ns - last.stamp_ns) * 1e-9
            if dt <= 0:
                return
            segment = last.segment
            expected = last.xyz_odom_m + 0.5 * dt * (last.velocity_odom_mps + velocity)
            if dt > GAP_S:
                segment += 1
            elif float(np.linalg.norm(xyz - expected)) > JUMP_M + 0.3 * dt * float(np.linalg.norm(velocity)):
                self.jumps += 1
                self._offset_m = self._offset_m + expected - xyz
                xyz = expected
        self._positions.append(_Position(stamp_ns, xyz, velocity, segment))

    def reset(self, counter: int) -> None:
        """The autopilot's reset counter: a change begins a new segment."""
        if self._reset_counter is not None and counter != self._reset_counter:
            self._end_segment()
        self._reset_counter = counter

    def _end_segment(self) -> None:
        if self._positions:
            last = self._positions[-1]
            self._positions[-1] = _Position(last.stamp_ns, last.xyz_odom_m, last.velocity_odom_mps, last.segment + 1)

    @property
    def R_odom_raw(self) -> Array64:
        """Rotation (3, 3) of the autopilot's raw local frame, as it is now, in frame odom."""
        return self._R_odom_raw

    def rate_radps(self, stamp_ns: int) -> float:
        """Angular speed of the drone [rad/s]; 0 where not known."""
        node = self._before(stamp_ns)
        return 0.0 if node is None else float(np.linalg.norm(node.rate_drone_radps))

    def R_odom_drone(self, stamp_ns: int) -> Array64 | None:
        """Attitude (3, 3) at a time, extrapolated with its rate for AHEAD_NS; None: not known."""
        neighbours = _neighbours(self._attitudes, stamp_ns)
        if neighbours is None:
            return None
        before, after = neighbours
        since_s = (stamp_ns - before.stamp_ns) * 1e-9
        if after is None:
            return before.R_odom_drone @ exp_rotation(since_s * before.rate_drone_radps)
        share = since_s / ((after.stamp_ns - before.stamp_ns) * 1e-9)
        return before.R_odom_drone @ exp_rotation(share * log_rotation(before.R_odom_drone.T @ after.R_odom_drone))

    def position(self, stamp_ns: int) -> tuple[Array64, int] | None:
        """Position (3,) [m] in frame odom and its segment; None: not known."""
        neighbours = _neighbours(self._positions, stamp_ns)
        if neighbours is None:
            return None
        before, after = neighbours
        since_s = (stamp_ns - before.stamp_ns) * 1e-9
        if after is None:
            return before.xyz_odom_m + since_s * before.velocity_odom_mps, before.segment
        if after.segment != before.segment:
            return None
        share = since_s / ((after.stamp_ns - before.stamp_ns) * 1e-9)
        return before.xyz_odom_m + share * (after.xyz_odom_m - before.xyz_odom_m), before.segment

    def velocity_odom_mps(self, stamp_ns: int) -> Array64 | None:
        """Velocity (3,) in frame odom of the newest sample up to a time; None: not known."""
        neighbours = _neighbours(self._positions, stamp_ns)
        return None if neighbours is None else neighbours[0].velocity_odom_mps

    @property
    def attitude_ns(self) -> int | None:
        """Stamp of the newest attitude; None before the first."""
        return self._attitudes[-1].stamp_ns if self._attitudes else None

    @property
    def position_ns(self) -> int | None:
        """Stamp of the newest position; None before the first."""
        return self._positions[-1].stamp_ns if self._positions else None

    def _before(self, stamp_ns: int) -> _Attitude | None:
        at = bisect_right(self._attitudes, stamp_ns, key=lambda node: node.stamp_ns)
        return self._attitudes[at - 1] if at else None


def _neighbours(samples: deque[_Sample], stamp_ns: int) -> tuple[_Sample, _Sample | None] | None:
    """The samples before and after a time; for AHEAD_NS beyond the newest or into a gap: the one before, and None.

    None: not known.
    """
    at = bisect_right(samples, stamp_ns, key=lambda sample: sample.stamp_ns)
    if at == 0:
        return None
    before, after = samples[at - 1], samples[at] if at < len(samples) else None
    if after is not None and after.stamp_ns - before.stamp_ns <= BRIDGED_NS:
        return before, after
    return (before, None) if stamp_ns - before.stamp_ns <= AHEAD_NS else None


class VisualTrajectory:
    """The drone's rotation by visual odometry: motions chained as long as each begins where an earlier one ended."""

    def __init__(self) -> None:
        self._nodes: deque[tuple[int, Array64, float, int]] = deque(maxlen=KEPT)  # stamp, R, variance so far, chain

    def add(self, motion: VisualMotion) -> None:
        """Add a motion; one that does not begin at the end of a known one begins a new chain."""
        if self._nodes and motion.stamp_ns <= self._nodes[-1][0]:
            return
        start = next((node for node in reversed(self._nodes) if node[0] == motion.from_ns), None)
        if start is None:
            chain = self._nodes[-1][3] + 1 if self._nodes else 0
            start = (motion.from_ns, np.eye(3), 0.0, chain)
            if not self._nodes or motion.from_ns > self._nodes[-1][0]:
                self._nodes.append(start)
        variance = start[2] + float(np.trace(motion.covariance_rad2)) / 3
        self._nodes.append((motion.stamp_ns, start[1] @ motion.R_from_to, variance, start[3]))

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest image; None before the first."""
        return self._nodes[-1][0] if self._nodes else None

    def at(self, stamp_ns: int) -> tuple[Array64, float, int] | None:
        """R_chain_drone (3, 3), its accumulated variance [rad^2] and the chain's number; None: not known."""
        nodes = self._nodes
        if not nodes or not nodes[0][0] <= stamp_ns <= nodes[-1][0] + AHEAD_NS:
            return None
        at = bisect_right(nodes, stamp_ns, key=lambda node: node[0])
        chain = nodes[at - 1][3]
        if at == len(nodes) and stamp_ns > nodes[-1][0]:
            at -= 1  # extrapolate the last motion
        if at == len(nodes) or at == 0:
            return (*nodes[at - 1][1:3], chain) if at else None
        (t0, R0, v0, chain0), (t1, R1, v1, chain1) = nodes[at - 1], nodes[at]
        if chain0 != chain1 or (t0 < stamp_ns < t1 and t1 - t0 > GAP_S * 1e9):
            return None
        share = (stamp_ns - t0) / (t1 - t0)
        variance = v0 + share * (v1 - v0) if share <= 1 else v1 + ((stamp_ns - t1) * 1e-9 * UNKNOWN_RAD_PER_S) ** 2
        return R0 @ exp_rotation(share * log_rotation(R0.T @ R1)), variance, chain0


def rotation_between(
    autopilot: AutopilotTrajectory, visual: VisualTrajectory, from_ns: int, to_ns: int
) -> DroneRotation:
    """The drone's rotation between two times, from the best source that covers both."""
    dt = abs(to_ns - from_ns) * 1e-9
    R0, R1 = autopilot.R_odom_drone(from_ns), autopilot.R_odom_drone(to_ns)
    if R0 is not None and R1 is not None:
        late = CLOCK_S * (autopilot.rate_radps(to_ns) - autopilot.rate_radps(from_ns))
        return DroneRotation(R0.T @ R1, DRIFT_RAD2_PER_S * dt + late**2, True)
    a, b = visual.at(from_ns), visual.at(to_ns)
    if a is not None and b is not None and a[2] == b[2]:
        return DroneRotation(a[0].T @ b[0], abs(b[1] - a[1]), True)
    return DroneRotation(np.eye(3), (UNKNOWN_RAD_PER_S * dt) ** 2, False)
