"""How the drone turned and moved between two moments, from whatever tells it, freed of the autopilot's jumps.

The autopilot's local frame has its own yaw, and an EKF may reset it in flight (compass, GPS). A turn that the rates
do not confirm, or a step that the velocity does not, is such a jump: it is taken out, so that frame `own` is the
local frame as it was first, continued smoothly. With no autopilot the odometry by pictures is chained instead; with
neither the drone is taken to keep its heading, not better than so many degrees a second.

Between two words it turned and flew evenly, unless they are so far apart that the middle would be invented: there it is
not known, and what it did over the whole gap is.

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

KEPT = 1024
AHEAD_NS = 250_000_000  # beyond its newest word a source is believed this long
BRIDGED_NS = 1_000_000_000  # a silence no longer than this is told through, linearly: radios pause as long
GAP_S = 0.5  # after a longer silence rates and velocity say nothing about a jump
JUMP_RAD = math.radians(3.0)
JUMP_M = 0.3
DRIFT_RAD2_PER_S = math.radians(0.3) ** 2  # of an attitude: walk
CLOCK_S = 0.02  # an attitude's stamp may be off by this: at 120 deg/s that is 2.4 deg
UNKNOWN_RAD_PER_S = math.radians(40.0)  # a heading nobody tells changes like this
ODOMETRY_NS = 1_000_000_000  # while it is heard, attitude and position of other messages are not needed


@dataclass(frozen=True)
class Turn:
    """How the drone turned from one moment to another."""

    R_from_to: Array64
    variance_rad2: float  # of its yaw
    sure: bool  # whether anybody told; else the drone is taken not to have turned


@dataclass(frozen=True)
class _Node:
    stamp_ns: int
    R_odom_drone: Array64
    rate_drone_radps: Array64


@dataclass(frozen=True)
class _Place:
    stamp_ns: int
    xyz_odom_m: Array64
    velocity_odom_mps: Array64
    stretch: int  # places of one stretch are told apart by displacement, those of two are not


_Told = TypeVar("_Told", _Node, _Place)


class AutopilotTrajectory:
    """The autopilot's attitude and position in frame own."""

    def __init__(self) -> None:
        self._nodes: deque[_Node] = deque(maxlen=KEPT)
        self._places: deque[_Place] = deque(maxlen=KEPT)
        self._R_odom_raw = np.eye(3)
        self._offset_m = np.zeros(3)  # xyz_own = R_odom_raw xyz_local + offset
        self._reset_counter: int | None = None
        self._odometry_ns: int | None = None
        self.jumps = 0  # taken out
        self.silences = 0  # after which a jump could not have been seen

    def hear(self, word: DroneAttitude | DroneLocalPosition | DroneOdometry) -> None:
        """A message of the autopilot's: its whole odometry rather than attitude and position by themselves.

        An estimate that calls itself failed is not used.
        """
        if isinstance(word, DroneOdometry):
            if word.quality_percent == 0:
                return
            self._odometry_ns = word.stamp_ns
            self.reset(word.reset_counter)
            self.add_attitude(word.stamp_ns, word.R_odom_drone, word.angular_velocity_drone_radps)
            self.add_position(word.stamp_ns, word.xyz_odom_m, word.R_odom_drone @ word.velocity_drone_mps)
        elif self._odometry_ns is not None and word.stamp_ns - self._odometry_ns < ODOMETRY_NS:
            return
        elif isinstance(word, DroneAttitude):
            self.add_attitude(word.stamp_ns, word.R_odom_drone, word.angular_velocity_drone_radps)
        else:
            self.add_position(word.stamp_ns, word.xyz_odom_m, word.velocity_odom_mps)

    def add_attitude(self, stamp_ns: int, R_raw_drone: Array64, rate_drone_radps: Array64) -> None:
        """One more attitude; one that is not newer than the last is ignored."""
        R_odom_drone = self._R_odom_raw @ R_raw_drone
        if self._nodes:
            last = self._nodes[-1]
            dt = (stamp_ns - last.stamp_ns) * 1e-9
            if dt <= 0:
                return
            turn = 0.5 * dt * (last.rate_drone_radps + rate_drone_radps)
            expected = last.R_odom_drone @ exp_rotation(turn)
            off = float(np.linalg.norm(log_rotation(expected.T @ R_odom_drone)))
            if dt > GAP_S:
                self.silences += 1
            elif off > JUMP_RAD + 0.3 * float(np.linalg.norm(turn)):
                self.jumps += 1
                self._R_odom_raw = expected @ R_raw_drone.T
                self._break_places()
                R_odom_drone = expected
        self._nodes.append(_Node(stamp_ns, R_odom_drone, rate_drone_radps))

    def add_position(self, stamp_ns: int, xyz_raw_m: Array64, velocity_raw_mps: Array64) -> None:
        """One more position with its velocity, of the same estimate as the attitude."""
        xyz = self._R_odom_raw @ xyz_raw_m + self._offset_m
        velocity = self._R_odom_raw @ velocity_raw_mps
        stretch = 0
        if self._places:
            last = self._places[-1]
            dt = (stamp_ns - last.stamp_ns) * 1e-9
            if dt <= 0:
                return
            stretch = last.stretch
            expected = last.xyz_odom_m + 0.5 * dt * (last.velocity_odom_mps + velocity)
            if dt > GAP_S:
                stretch += 1
            elif float(np.linalg.norm(xyz - expected)) > JUMP_M + 0.3 * dt * float(np.linalg.norm(velocity)):
                self.jumps += 1
                self._offset_m = self._offset_m + expected - xyz
                xyz = expected
        self._places.append(_Place(stamp_ns, xyz, velocity, stretch))

    def reset(self, counter: int) -> None:
        """What the autopilot counts its own jumps with: a change ends a stretch of positions."""
        if self._reset_counter is not None and counter != self._reset_counter:
            self._break_places()
        self._reset_counter = counter

    def _break_places(self) -> None:
        if self._places:
            last = self._places[-1]
            self._places[-1] = _Place(last.stamp_ns, last.xyz_odom_m, last.velocity_odom_mps, last.stretch + 1)

    def rate_radps(self, stamp_ns: int) -> float:
        """How fast the drone turns [rad/s]; 0 where nobody says."""
        node = self._before(stamp_ns)
        return 0.0 if node is None else float(np.linalg.norm(node.rate_drone_radps))

    def R_odom_drone(self, stamp_ns: int) -> Array64 | None:
        """Attitude at a time, a little beyond the newest with its rate; None: not known."""
        around = _around(self._nodes, stamp_ns)
        if around is None:
            return None
        before, after = around
        since_s = (stamp_ns - before.stamp_ns) * 1e-9
        if after is None:
            return before.R_odom_drone @ exp_rotation(since_s * before.rate_drone_radps)
        share = since_s / ((after.stamp_ns - before.stamp_ns) * 1e-9)
        return before.R_odom_drone @ exp_rotation(share * log_rotation(before.R_odom_drone.T @ after.R_odom_drone))

    def position(self, stamp_ns: int) -> tuple[Array64, int] | None:
        """Position (3,) [m] in frame own and its stretch; None: not known."""
        around = _around(self._places, stamp_ns)
        if around is None:
            return None
        before, after = around
        since_s = (stamp_ns - before.stamp_ns) * 1e-9
        if after is None:
            return before.xyz_odom_m + since_s * before.velocity_odom_mps, before.stretch
        if after.stretch != before.stretch:
            return None
        share = since_s / ((after.stamp_ns - before.stamp_ns) * 1e-9)
        return before.xyz_odom_m + share * (after.xyz_odom_m - before.xyz_odom_m), before.stretch

    def velocity_odom_mps(self, stamp_ns: int) -> Array64 | None:
        """Velocity (3,) in frame own, as said last before a time; None: not known."""
        around = _around(self._places, stamp_ns)
        return None if around is None else around[0].velocity_odom_mps

    @property
    def attitude_ns(self) -> int | None:
        """Time of the newest attitude."""
        return self._nodes[-1].stamp_ns if self._nodes else None

    @property
    def position_ns(self) -> int | None:
        """Time of the newest position."""
        return self._places[-1].stamp_ns if self._places else None

    def _before(self, stamp_ns: int) -> _Node | None:
        at = bisect_right(self._nodes, stamp_ns, key=lambda node: node.stamp_ns)
        return self._nodes[at - 1] if at else None


def _around(told: deque[_Told], stamp_ns: int) -> tuple[_Told, _Told | None] | None:
    """The words before and after a time; beyond the newest and into a gap, for AHEAD_NS, the one before and None.

    None: not known.
    """
    at = bisect_right(told, stamp_ns, key=lambda word: word.stamp_ns)
    if at == 0:
        return None
    before, after = told[at - 1], told[at] if at < len(told) else None
    if after is not None and after.stamp_ns - before.stamp_ns <= BRIDGED_NS:
        return before, after
    return (before, None) if stamp_ns - before.stamp_ns <= AHEAD_NS else None


class VisualTrajectory:
    """The drone's odometry by pictures, one step after the other as long as they join."""

    def __init__(self) -> None:
        self._nodes: deque[tuple[int, Array64, float, int]] = deque(maxlen=KEPT)  # stamp, R, variance so far, chain

    def add(self, motion: VisualMotion) -> None:
        """One more step; one that does not begin where a known one ended begins a new chain."""
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
        """Time of the newest picture."""
        return self._nodes[-1][0] if self._nodes else None

    def at(self, stamp_ns: int) -> tuple[Array64, float, int] | None:
        """R_chain_drone, the variance so far [rad^2] and the chain; None: not known."""
        nodes = self._nodes
        if not nodes or not nodes[0][0] <= stamp_ns <= nodes[-1][0] + AHEAD_NS:
            return None
        at = bisect_right(nodes, stamp_ns, key=lambda node: node[0])
        chain = nodes[at - 1][3]
        if at == len(nodes) and stamp_ns > nodes[-1][0]:
            at -= 1  # the last step goes on
        if at == len(nodes) or at == 0:
            return (*nodes[at - 1][1:3], chain) if at else None
        (t0, R0, v0, chain0), (t1, R1, v1, chain1) = nodes[at - 1], nodes[at]
        if chain0 != chain1 or (t0 < stamp_ns < t1 and t1 - t0 > GAP_S * 1e9):
            return None
        share = (stamp_ns - t0) / (t1 - t0)
        variance = v0 + share * (v1 - v0) if share <= 1 else v1 + ((stamp_ns - t1) * 1e-9 * UNKNOWN_RAD_PER_S) ** 2
        return R0 @ exp_rotation(share * log_rotation(R0.T @ R1)), variance, chain0


def rotation_between(autopilot: AutopilotTrajectory, pictures: VisualTrajectory, from_ns: int, to_ns: int) -> Turn:
    """The drone's turn between two moments, from the best source that covers both."""
    dt = abs(to_ns - from_ns) * 1e-9
    R0, R1 = autopilot.R_odom_drone(from_ns), autopilot.R_odom_drone(to_ns)
    if R0 is not None and R1 is not None:
        late = CLOCK_S * (autopilot.rate_radps(to_ns) - autopilot.rate_radps(from_ns))
        return Turn(R0.T @ R1, DRIFT_RAD2_PER_S * dt + late**2, True)
    a, b = pictures.at(from_ns), pictures.at(to_ns)
    if a is not None and b is not None and a[2] == b[2]:
        return Turn(a[0].T @ b[0], abs(b[1] - a[1]), True)
    return Turn(np.eye(3), (UNKNOWN_RAD_PER_S * dt) ** 2, False)
