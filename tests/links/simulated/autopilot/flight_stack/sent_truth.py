"""Flies a flight stack on its true pose, sent as ODOMETRY with noise and delay: what a perfect host would do."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from links.mavlink.ned_frd import flip_yz, upper_from_pose_covariance, wxyz_from_R_odom_drone
from links.mavlink.transport.framing import dialect, packed, parse_frame
from links.simulated.autopilot.autopilot import AutopilotSettings
from links.simulated.autopilot.flight_stack.stack import FlightStack
from links.simulated.world.path import Path, Waypoint

START_NS = 1_000_000_000_000_000_000
NS = 1_000_000_000
GROUND_M = -1.8
PARKED = Path(waypoints=(Waypoint(t_s=0, xyz_m=(0.0, 0.0, 0.0)),))
HOVER = Path(waypoints=(Waypoint(t_s=0, xyz_m=(7.0, 0.0, 10.0), yaw_deg=20),))
TO_EXTERNAL = [{"do": "path", "for_s": 4}, {"do": "use_sources", "set": 2}, {"do": "hold", "for_s": 60}]


class Host:
    """Sends the true pose at 33 Hz, 30 ms old, with 0.05 m of noise, from 1 s on; `sends` and `edit` change that."""

    def __init__(
        self,
        duration_s: float,
        path: Path = HOVER,
        seed: int = 1,
        autopilot: dict[str, Any] | None = None,
        **stack: Any,
    ) -> None:
        stack.setdefault("plan", TO_EXTERNAL)
        settings = AutopilotSettings.model_validate({"flight_stack": stack, **(autopilot or {})})
        self.stack = FlightStack(settings, path, PARKED, GROUND_M, START_NS, duration_s, seed)
        self.frames: list[tuple[int, Any]] = []  # received: arrival, message
        self.sends: Callable[[float], bool] = lambda time_s: time_s > 1.0
        self.edit: Callable[[Any, float], None] = lambda message, time_s: None
        self._mav = dialect().MAVLink(None, srcSystem=1, srcComponent=197)
        self._rng = np.random.default_rng(seed)
        self.ticks = 0

    @property
    def time_s(self) -> float:
        return self.ticks * 0.01

    def run(self, until_s: float) -> None:
        """Fly until a time."""
        while self.time_s < until_s - 1e-9:
            self.ticks += 1
            now_ns = START_NS + self.ticks * 10_000_000
            for record in self.stack.records(now_ns):
                self.frames.append((record.arrival_ns, parse_frame(record.data)))
            if self.ticks % 3 == 0 and self.sends(self.time_s):
                self.send(self.pose(now_ns), now_ns)

    def send(self, message: Any, now_ns: int | None = None) -> None:
        """Send one message now."""
        self.stack.receive(packed(message, self._mav), now_ns or START_NS + self.ticks * 10_000_000)

    def pose(self, now_ns: int) -> Any:
        """ODOMETRY of the true pose."""
        rotations, positions = self.stack.motion.flying_poses(np.array([self.time_s - 0.03]))
        R, velocity = rotations[0], self.stack.quadrotor.state[3:6] + self._rng.normal(0, 0.1, 3)
        covariance = np.diag([0.02**2] * 3 + [0.1**2] * 3)
        message = dialect().MAVLink_odometry_message(
            (now_ns - 30_000_000) // 1000,
            20,
            12,
            *flip_yz(positions[0] + self._rng.normal(0, 0.05, 3)),
            wxyz_from_R_odom_drone(R),
            *flip_yz(R.T @ velocity),
            *[math.nan] * 3,
            upper_from_pose_covariance(covariance, R),
            [math.nan] * 21,
            1,
            3,
            80,
        )
        self.edit(message, self.time_s)
        return message

    def received(self, kind: str) -> list[Any]:
        """Messages of one type."""
        return [message for _, message in self.frames if message.get_type() == kind]

    def texts(self) -> list[str]:
        """STATUSTEXTs."""
        return [message.text for message in self.received("STATUSTEXT")]

    def events(self) -> list[str]:
        """What happened."""
        return [str(event) for event in self.stack.events]

    def scatter_m(self, from_s: float) -> float:
        """3D RMS of the position about its mean since a time."""
        held = self.stack.motion.states[round(from_s * 400) :, 0:3]
        return float(np.sqrt(((held - held.mean(axis=0)) ** 2).sum(axis=1).mean()))
