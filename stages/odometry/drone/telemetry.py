"""What the drone's autopilot tells of its place, kept for a while, in its own level frame: north anywhere, drifting.

Source: ours; DESIGN, The graph: `odometry` ("autopilot odometry when present").
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque

import numpy as np

from stages.geometry.frames import Array64
from stages.messages import DroneLocalPosition, DroneOdometry

KEPT_NS = 20_000_000_000
AHEAD_NS = 500_000_000  # beyond the newest word it is not known any more
JUMP_M = 1.0  # a step that its velocity does not explain: the autopilot's estimate was reset
JUMP_MPS, JUMP_MPS2 = 1.5, 30.0  # nor does a drone change its velocity so: its frame was turned


class DroneTelemetry:
    """Where the drone says it has been, lately."""

    def __init__(self) -> None:
        self._ns: deque[int] = deque()
        self._xyz_m: deque[Array64] = deque()
        self._v_mps: deque[Array64] = deque()
        self._counted: int | None = None
        self.resets = 0
        """How often its estimate jumped: places before and after have nothing to do with each other."""

    def add(self, stamp_ns: int, xyz_m: Array64, v_mps: Array64, counted: int | None = None) -> None:
        """One word of it, in the autopilot's level frame; older than the newest is left out.

        `counted`: the autopilot's own count of its jumps, where it tells; each change is one.
        """
        if self._ns:
            dt = (stamp_ns - self._ns[-1]) * 1e-9
            if dt <= 0:
                return
            left = xyz_m - self._xyz_m[-1] - 0.5 * dt * (v_mps + self._v_mps[-1])
            turned = float(np.linalg.norm(v_mps - self._v_mps[-1])) > JUMP_MPS + JUMP_MPS2 * dt
            if turned or counted != self._counted or float(np.linalg.norm(left)) > JUMP_M + dt:
                self.resets += 1
                for kept in (self._ns, self._xyz_m, self._v_mps):
                    kept.clear()
        self._counted = counted
        self._ns.append(stamp_ns)
        self._xyz_m.append(xyz_m)
        self._v_mps.append(v_mps)
        while stamp_ns - self._ns[0] > KEPT_NS:
            for kept in (self._ns, self._xyz_m, self._v_mps):
                kept.popleft()

    def add_position(self, position: DroneLocalPosition) -> None:
        """LOCAL_POSITION_NED and its like."""
        self.add(position.stamp_ns, position.xyz_odom_m, position.velocity_odom_mps)

    def add_odometry(self, odometry: DroneOdometry) -> None:
        """ODOMETRY: its velocity is in the drone's axes, and it counts its own jumps; one called failed is not used."""
        if odometry.quality_percent == 0:
            return
        velocity_mps = odometry.R_odom_drone @ odometry.velocity_drone_mps
        self.add(odometry.stamp_ns, odometry.xyz_odom_m, velocity_mps, odometry.reset_counter)

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Times of the oldest word that is kept and of the newest; None before the first."""
        return (self._ns[0], self._ns[-1]) if self._ns else None

    def speed_mps(self, stamp_ns: int) -> tuple[float, float] | None:
        """(level, up) at a time; None when it is silent."""
        if not self._ns or abs(stamp_ns - self._ns[-1]) > AHEAD_NS:
            return None
        x, y, z = self._v_mps[-1]
        return math.hypot(x, y), float(z)

    def state(self, stamp_ns: int) -> tuple[Array64, Array64] | None:
        """Position (3,) [m] and velocity (3,) [m/s] in the autopilot's frame; None when it was silent then."""
        known = self._ns
        if len(known) < 2 or stamp_ns < known[0]:
            return None
        k = min(bisect_left(known, stamp_ns), len(known) - 1)
        near = k - 1 if k and abs(known[k - 1] - stamp_ns) < abs(known[k] - stamp_ns) else k
        since_ns = stamp_ns - known[near]
        if abs(since_ns) > AHEAD_NS:
            return None
        velocity = self._v_mps[near]
        return self._xyz_m[near] + since_ns * 1e-9 * velocity, velocity
