"""Recent positions and velocities by the drone's autopilot, in frame odom (level, any yaw, drifting).

Source: ours; DESIGN, The graph: `odometry` ("autopilot odometry when present").
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque

from stages.geometry.frames import Array64
from stages.messages import DroneLocalPosition, DroneOdometry

KEPT_NS = 20_000_000_000
AHEAD_NS = 500_000_000  # longest extrapolation beyond a sample
JUMP_M = 1.0  # a step that the velocity does not explain: the autopilot's estimate was reset
JUMP_MPS, JUMP_MPS2 = 1.5, 30.0  # a change of velocity that no drone performs: the frame was rotated


class DroneTelemetry:
    """Buffer of the last 20 s of the autopilot's position and velocity."""

    def __init__(self) -> None:
        self._ns: deque[int] = deque()
        self._xyz_m: deque[Array64] = deque()
        self._v_mps: deque[Array64] = deque()
        self._reset_counter: int | None = None
        self.resets = 0
        """Number of jumps of the estimate: positions before and after are unrelated."""

    def add(self, stamp_ns: int, xyz_m: Array64, v_mps: Array64, reset_counter: int | None = None) -> None:
        """Add a sample in frame odom; one that is not newer than the last is ignored.

        `reset_counter`: the autopilot's reset counter, if it has one; each change is a jump.
        """
        if self._ns:
            dt = (stamp_ns - self._ns[-1]) * 1e-9
            if dt <= 0:
                return
            before_mps = self._v_mps[-1]
            expected_m = self._xyz_m[-1] + 0.5 * dt * (v_mps + before_mps)
            turned = math.dist(v_mps, before_mps) > JUMP_MPS + JUMP_MPS2 * dt
            if turned or reset_counter != self._reset_counter or math.dist(xyz_m, expected_m) > JUMP_M + dt:
                self.resets += 1
                for kept in (self._ns, self._xyz_m, self._v_mps):
                    kept.clear()
        self._reset_counter = reset_counter
        self._ns.append(stamp_ns)
        self._xyz_m.append(xyz_m)
        self._v_mps.append(v_mps)
        while stamp_ns - self._ns[0] > KEPT_NS:
            for kept in (self._ns, self._xyz_m, self._v_mps):
                kept.popleft()

    def add_position(self, position: DroneLocalPosition) -> None:
        """Add a LOCAL_POSITION_NED or equivalent."""
        self.add(position.stamp_ns, position.xyz_odom_m, position.velocity_odom_mps)

    def add_odometry(self, odometry: DroneOdometry) -> None:
        """Add an ODOMETRY, with velocity in drone axes and a reset counter; a failed estimate is ignored."""
        if odometry.quality_percent == 0:
            return
        velocity_mps = odometry.R_odom_drone @ odometry.velocity_drone_mps
        self.add(odometry.stamp_ns, odometry.xyz_odom_m, velocity_mps, odometry.reset_counter)

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Stamps of the oldest and the newest sample; None before the first."""
        return (self._ns[0], self._ns[-1]) if self._ns else None

    def speed_mps(self, stamp_ns: int) -> tuple[float, float] | None:
        """(horizontal, upward) speed at a time; None without a recent sample."""
        if not self._ns or abs(stamp_ns - self._ns[-1]) > AHEAD_NS:
            return None
        x, y, z = self._v_mps[-1]
        return math.hypot(x, y), float(z)

    def state(self, stamp_ns: int) -> tuple[Array64, Array64] | None:
        """Position (3,) [m] and velocity (3,) [m/s] in frame odom; None without a sample near that time."""
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
