"""What became of a flight: crash, failsafe, errors of the sent poses, scatter of the hover. For statistics only.

A flight is lost when it crashes (ground or an obstacle), when the EKF failsafe lands it, or when it leaves its plan by
more than 20 m.

Source: ours.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field

import numpy as np

from flow.link import Record
from links.mavlink.poses.sent_frame import SentFrame
from links.simulated.autopilot.flight_stack.outcomes.events import EventKind
from links.simulated.autopilot.flight_stack.outcomes.sent_poses import SentPoses
from links.simulated.autopilot.flight_stack.stack import FlightStack
from links.simulated.kernels.motion import STEP_S
from links.simulated.sensors.vehicle_odometry import VehicleOdometry
from links.simulated.world.mesh import RayScene
from links.simulated.world.scene import Truth
from stages.geometry.frames import Array64

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
    inside_share: float | None  # positions inside the 95 % ellipsoid of their message
    yaw_inside_share: float | None  # the same of yaws
    heading_s: float | None  # from the first position to the first pose with a rotation, since the last start of grd
    longest_gap_s: float | None  # without a sent pose, from the first one until the flight was lost
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
            parts.append(f"longest gap {self.longest_gap_s:.1f} s")
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

    def __init__(
        self, stack: FlightStack, world: RayScene, truth: Truth, odometry: VehicleOdometry | None = None
    ) -> None:
        self._stack, self._world, self._truth = stack, world, truth
        self._lost_s: float | None = None
        self._last: Array64 | None = None
        self._poses = SentPoses(truth, odometry)

    def on_sent(self, record: Record, frame: SentFrame | None) -> None:
        """A frame to the autopilot, in this frame if it is a pose.

        After a crash none counts: the simulated IMU does not feel the impact.
        """
        if not self._stack.quadrotor.crashed:
            self._poses.add(record, frame)

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
        failsafe_s = self._failsafe_s()
        failed_s = math.inf if failsafe_s is None else failsafe_s
        first_s = min(failed_s, math.inf if self._lost_s is None else self._lost_s)
        return wait_s is not None and self._stack.motion.until_s > first_s + wait_s

    def result(self, heading_s: float | None = None) -> Outcome:
        """The outcome so far; heading_s: see Outcome."""
        failsafe = self._failsafe_s()
        lost_s = min([t for t in (self._lost_s, failsafe) if t is not None], default=None)
        end_s = self._stack.motion.until_s if lost_s is None else lost_s
        until_ns = self._truth.start_ns + round(self._stack.motion.until_s * 1e9)
        errors = self._poses.errors(until_ns)
        position_m, yaw_deg = errors.position_m, errors.yaw_deg
        sent, with_yaw = len(position_m) > 0, len(yaw_deg) > 0
        return Outcome(
            crashed=self._stack.quadrotor.crashed,
            failsafe_s=failsafe,
            lost_s=lost_s,
            sent_poses=len(position_m),
            wrong_poses=int(errors.wrong.sum()),
            sent_worst_m=round(float(position_m.max()), 3) if sent else None,
            sent_95_m=round(float(np.percentile(position_m, 95)), 3) if sent else None,
            sent_yaw_worst_deg=round(float(yaw_deg.max()), 2) if with_yaw else None,
            sent_yaw_rms_deg=round(float(np.sqrt(np.mean(yaw_deg**2))), 2) if with_yaw else None,
            inside_share=round(float(errors.inside.mean()), 4) if sent else None,
            yaw_inside_share=round(float(errors.yaw_inside.mean()), 4) if with_yaw else None,
            heading_s=None if heading_s is None else round(heading_s, 2),
            longest_gap_s=self._poses.longest_gap_s(self._truth.start_ns + round(end_s * 1e9)),
            hover_scatter_m=self._hover_scatter(),
            estimate_worst_m=round(self._stack.worst_target_error_m, 2),
            events=[(event.time_s, str(event)) for event in self._stack.events],
        )

    def _failsafe_s(self) -> float | None:
        """Time of the first EKF failsafe."""
        return next((e.time_s for e in self._stack.events if e.kind is EventKind.EKF_FAILSAFE), None)

    def _hover_scatter(self) -> float | None:
        """Worst 3D RMS of the position about its mean, over the holds after the switch."""
        states = self._stack.motion.states
        worst: float | None = None
        external = False
        events = self._stack.events
        ends_s = [*(event.time_s for event in events[1:]), self._stack.motion.until_s][: len(events)]
        for event, end_s in zip(events, ends_s, strict=True):
            external |= event.kind is EventKind.SOURCE_SET and self._stack.external_sets[event.number - 1]
            if not event.holds or not external or end_s - event.time_s < 2 * SETTLE_S:
                continue
            held = states[round((event.time_s + SETTLE_S) / STEP_S) : round(end_s / STEP_S), 0:3]
            scatter = float(np.sqrt(((held - held.mean(axis=0)) ** 2).sum(axis=1).mean()))
            worst = scatter if worst is None else max(worst, scatter)
        return None if worst is None else round(worst, 3)
