"""What became of a flight: crash, failsafe, errors of the sent poses, scatter of the hover. For statistics only.

A flight is lost when it crashes (ground or an obstacle), when the EKF failsafe lands it, or when it leaves its plan by
more than 20 m. Errors of a sent pose are those of ODOMETRY against T_map_vehicle T_vehicle_drone at its time: the first
by the vehicle's odometry, whose drift the autopilot's frame shares, the second true. Without odometry both are true.
A position that is sent without yaw is compared in axes that point to the true north.

Source: ours.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flow.link import Record
from links.mavlink.ned_frd import R_odom_drone_from_wxyz, flip_yz
from links.mavlink.transport.framing import parse_frame
from links.simulated.autopilot.flight_stack.stack import FlightStack
from links.simulated.kernels.motion import STEP_S
from links.simulated.world.mesh import RayScene
from links.simulated.world.scene import Truth
from stages.geometry.frames import Array64, rotation_z, rotations_from_xyzw

WRONG_M, WRONG_DEG = 1.0, 10.0  # a sent pose with a larger error is wrong
NO_YAW_RAD2 = 9.0  # a larger yaw variance: the message holds no yaw
SETTLE_S = 3.0  # of a hold, before its scatter counts
FLYAWAY_M = 20.0


@dataclass(frozen=True)
class Outcome:
    """The result of one flight. None: does not apply."""

    crashed: bool
    failsafe_s: float | None  # time of the first EKF failsafe
    lost_s: float | None  # time at which the flight was lost
    sent_poses: int
    wrong_poses: int  # sent with an error above 1 m or 10 deg
    sent_worst_m: float | None
    sent_95_m: float | None
    sent_yaw_worst_deg: float | None
    sent_yaw_rms_deg: float | None
    hover_scatter_m: float | None  # 3D RMS about the mean position, worst hold after the switch to external poses
    estimate_worst_m: float | None  # the furthest that the drone was from its target in the plan's frame
    events: list[tuple[float, str]] = field(default_factory=list[tuple[float, str]])

    def __str__(self) -> str:
        state = "crashed" if self.crashed else "lost" if self.lost_s is not None else "flown to the end"
        parts = [f"flight: {state}" + (f" at {self.lost_s:.1f} s" if self.lost_s is not None else "")]
        if self.failsafe_s is not None:
            parts.append(f"EKF failsafe at {self.failsafe_s:.1f} s")
        if self.sent_poses:
            parts.append(
                f"{self.sent_poses} poses sent, {self.wrong_poses} wrong, worst {self.sent_worst_m:.2f} m, "
                f"95 % {self.sent_95_m:.2f} m"
            )
            if self.sent_yaw_rms_deg is not None:
                parts.append(f"yaw worst {self.sent_yaw_worst_deg:.1f} deg, RMS {self.sent_yaw_rms_deg:.1f} deg")
        else:
            parts.append("no pose sent")
        if self.hover_scatter_m is not None:
            parts.append(f"hover scatter {self.hover_scatter_m:.2f} m")
        return "; ".join(parts)

    def as_json(self) -> bytes:
        """For the recording."""
        return json.dumps(self.__dict__).encode()


class FlightOutcome:
    """Watches a flight: call `update` as it is flown and `on_sent` for each frame to the autopilot."""

    def __init__(self, stack: FlightStack, world: RayScene, truth: Truth) -> None:
        self._stack, self._world, self._truth = stack, world, truth
        self._row = 0
        self._lost_s: float | None = None
        self._last: Array64 | None = None
        # stamp [ns], position [m], yaw in map [rad]; NaN: without yaw, and the position in north-aligned axes
        self._poses: list[tuple[int, Array64, float]] = []
        self._odometry: list[tuple[int, list[float], list[float]]] = []  # stamp [ns], position, quaternion xyzw

    def on_odometry(self, record: Record) -> None:
        """A pose by the vehicle's odometry."""
        pose = json.loads(record.data)
        self._odometry.append((record.stamp_ns, pose["xyz_m"], pose["quaternion_xyzw"]))

    def on_sent(self, record: Record) -> None:
        """A frame to the autopilot."""
        message: Any = parse_frame(record.data)
        if message.get_type() == "ODOMETRY":
            xyz = flip_yz(np.array([message.x, message.y, message.z]))
            has_yaw = all(map(math.isfinite, message.q)) and not message.pose_covariance[20] > NO_YAW_RAD2
            R = R_odom_drone_from_wxyz(message.q) if has_yaw else np.full((3, 3), np.nan)
            self._poses.append((int(message.time_usec) * 1000, xyz, math.atan2(R[1, 0], R[0, 0])))

    def is_over(self) -> bool:
        """Check the path since the last call for collisions and fly-aways; True: the flight was lost some time ago."""
        position = self._stack.quadrotor.state[0:3].copy()
        if self._last is not None:
            step = position - self._last
            length = float(np.linalg.norm(step))
            if length > 1e-6 and not self._stack.quadrotor.crashed:
                origin, direction = self._last[None].astype(np.float32), (step[None] / length).astype(np.float32)
                if self._world.cast(origin, direction, length)[0][0] < length:
                    self._stack.quadrotor.crash()
        self._last = position
        if self._lost_s is None and (self._stack.quadrotor.crashed or self._stack.target_error_m > FLYAWAY_M):
            self._lost_s = self._stack.motion.until_s
        wait_s = self._stack.settings.end_after_loss_s
        failed_s = next((t for t, what in self._stack.events if what == "EKF failsafe"), math.inf)
        first_s = min(failed_s, math.inf if self._lost_s is None else self._lost_s)
        return wait_s is not None and self._stack.motion.until_s > first_s + wait_s

    def result(self) -> Outcome:
        """The outcome so far."""
        events = self._stack.events
        failsafe = next((time_s for time_s, what in events if what == "EKF failsafe"), None)
        lost = [t for t in (self._lost_s, failsafe) if t is not None]
        position_m, yaw_deg = self._sent_errors()
        wrong = position_m > WRONG_M
        wrong[self._with_yaw()] |= yaw_deg > WRONG_DEG
        sent = len(position_m)
        return Outcome(
            crashed=self._stack.quadrotor.crashed,
            failsafe_s=failsafe,
            lost_s=min(lost) if lost else None,
            sent_poses=sent,
            wrong_poses=int(wrong.sum()),
            sent_worst_m=round(float(position_m.max()), 3) if sent else None,
            sent_95_m=round(float(np.percentile(position_m, 95)), 3) if sent else None,
            sent_yaw_worst_deg=round(float(yaw_deg.max()), 2) if len(yaw_deg) else None,
            sent_yaw_rms_deg=round(float(np.sqrt(np.mean(yaw_deg**2))), 2) if len(yaw_deg) else None,
            hover_scatter_m=self._hover_scatter(),
            estimate_worst_m=round(self._stack.worst_target_error_m, 2),
            events=list(events),
        )

    def _with_yaw(self) -> NDArray[np.bool_]:
        return np.array([not math.isnan(yaw) for _, _, yaw in self._poses], dtype=bool)

    def _sent_errors(self) -> tuple[Array64, Array64]:
        """Position errors [m] of all sent poses, in map, and yaw errors [deg] of those with yaw."""
        if not self._poses:
            return np.empty(0), np.empty(0)
        latest = self._truth.start_ns + round(self._stack.motion.until_s * 1e9)
        stamps = np.minimum(np.array([stamp for stamp, _, _ in self._poses], dtype=np.int64), latest)
        R_vehicle, t_vehicle = self._truth.T_world_vehicle(stamps)
        R_drone, t_drone = self._truth.T_world_drone(stamps)
        relative_m = np.einsum("nji,nj->ni", R_vehicle, t_drone - t_vehicle)
        R_relative = np.swapaxes(R_vehicle, 1, 2) @ R_drone
        R_map, t_map = self._map_vehicle(stamps)
        expected_m = t_map + np.einsum("nij,nj->ni", R_map, relative_m)
        R_expected = R_map @ R_relative
        yaw = np.arctan2(R_expected[:, 1, 0], R_expected[:, 0, 0])
        sent_m = np.array([xyz for _, xyz, _ in self._poses])
        sent_yaw = np.array([yaw for _, _, yaw in self._poses])
        without = np.isnan(sent_yaw)
        expected_m[without] = expected_m[without] @ rotation_z(self._stack.north_yaw_of_map).T
        error = np.degrees(sent_yaw[~without] - yaw[~without])
        return np.linalg.norm(sent_m - expected_m, axis=1), np.abs((error + 180) % 360 - 180)

    def _map_vehicle(self, stamps: NDArray[np.int64]) -> tuple[Array64, Array64]:
        """T_map_vehicle at times (n,) by the vehicle's odometry, interpolated; without it, the true one."""
        if len(self._odometry) < 2:
            R0, t0 = (part[0] for part in self._truth.T_world_vehicle(np.array([self._truth.start_ns])))
            R, t = self._truth.T_world_vehicle(stamps)
            return R0.T @ R, (t - t0) @ R0
        at_s = [(stamp - self._truth.start_ns) * 1e-9 for stamp, _, _ in self._odometry]
        rows = np.array([[*xyz, *quaternion] for _, xyz, quaternion in self._odometry])
        rows[:, 3:] *= np.sign(rows[:, 3:] @ rows[0, 3:])[:, None]
        now_s = (stamps - self._truth.start_ns) * 1e-9
        values = np.column_stack([np.interp(now_s, at_s, rows[:, i]) for i in range(7)])
        values[:, 3:] /= np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
        return rotations_from_xyzw(values[:, 3:]), values[:, :3]

    def _hover_scatter(self) -> float | None:
        """Worst 3D RMS of the position about its mean, over the holds after the switch."""
        states = self._stack.motion.states
        worst: float | None = None
        external = False
        events = [*self._stack.events, (self._stack.motion.until_s, "end")]
        for (begin_s, what), (end_s, _) in pairwise(events):
            external |= what.startswith("source set") and self._stack.external_sets[int(what.split()[-1]) - 1]
            if what != "plan: hold" or not external or end_s - begin_s < 2 * SETTLE_S:
                continue
            held = states[round((begin_s + SETTLE_S) / STEP_S) : round(end_s / STEP_S), 0:3]
            scatter = float(np.sqrt(((held - held.mean(axis=0)) ** 2).sum(axis=1).mean()))
            worst = scatter if worst is None else max(worst, scatter)
        return None if worst is None else round(worst, 3)
