"""One pose of the drone, fifty times a second, from everything that tells of it.

    fixes, rotations, odometries, each at its own time (estimator.py)
      -> a chain of poses (smoother.py)  -> predicted to now -> RelativePose

Now is the newest stamp heard on any port, on a grid of 20 ms; it never goes back. Every port but `fix` may be unwired,
fall silent and return. Without `motion` the vehicle's frame at each moment is taken for the start frame, as if it were
parked; only with `parked` is it believed to stand, so that the drone's own odometry is used.

A rotation comes from RelativeRotation when RESOLVED, or from the drone's motion as the LiDAR and its autopilot tell it
(motion_yaw.py): then FULL needs no pictures. Doubt about it (heading.py) ends FULL at once. What may be
said of a pose: verdict.py.

Source: ours; DESIGN, Fusion and The graph: fuse.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from flow.message import Message
from flow.stage import Settings, Stage
from stages.fuse.back_end import BackEnd
from stages.fuse.chain import yaw_sigma_rad
from stages.fuse.estimator import Estimator
from stages.fuse.intake import Intake
from stages.fuse.measurement_covariance import MapEstimate, Status, lost, pose
from stages.fuse.settings import FuseErrors, FuseLimits
from stages.fuse.smoother import Smoother
from stages.fuse.status import Jumps, state_of, why_unbacked
from stages.fuse.track_continuity import Following
from stages.geometry.se3 import position_covariance
from stages.messages import (
    BranchState,
    DroneAttitude,
    DroneFix,
    DroneLocalPosition,
    DroneOdometry,
    PoseState,
    RelativePose,
    RelativeRotation,
    ServoState,
    Tick,
    TrackState,
    VehicleMotion,
    VisualMotion,
)

GRID_NS = 20_000_000
AMBIGUOUS_NS = 1_000_000_000  # a rotation up to quarter turns counts for so long
Told = Iterator[RelativePose]


class FuseSettings(Settings):
    """Settings of `Fuse`."""

    parked: bool = False  # the vehicle stands, whether it says so or not
    track_id: int | None = Field(None, ge=1)  # follow this drone; None: the lowest number that is TRACKING
    lag_s: float = Field(3.0, ge=0.5, le=20)
    errors: FuseErrors = FuseErrors()
    limits: FuseLimits = FuseLimits()


class Fuse(Stage[FuseSettings]):
    """The smoother."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset(
        {"rotation", "motion", "position", "odometry", "attitude", "visual_motion", "track", "servo", "tick"}
    )

    def __init__(self, settings: FuseSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._told_ns: int = 0
        self._waiting: list[DroneFix | RelativeRotation] = []
        self._ambiguous_ns: int | None = None
        self._rotation_reason: str = "no rotation heard"
        settings = self.settings
        self._estimator = Estimator(self._back_end(), settings.errors, settings.limits, settings.parked)
        self._following = Following(settings.track_id)
        self._intake, self._jumps = Intake(round(settings.lag_s * 1e9)), Jumps(settings.limits)

    def _back_end(self) -> BackEnd:
        return Smoother(self.settings.lag_s)

    @property
    def refused(self) -> Counter[str]:
        """Messages left out because they make no sense, by reason."""
        return self._intake.refused

    @property
    def counters(self) -> dict[str, int]:
        """What is refused, and how often the back end began anew."""
        begun = {"back end begun anew": self.recoveries} if self.recoveries else {}
        return {f"refused: {why}": count for why, count in self.refused.items()} | begun

    @property
    def recoveries(self) -> int:
        """How often the back end had to be begun anew after an error of its library."""
        return self._estimator.chain.back.recoveries

    def on_motion(self, motion: VehicleMotion) -> Told:
        """Where the vehicle is in the start frame."""
        if self._intake.sound(motion, "vehicle motion", motion.xyz_map_m, motion.R_map_vehicle):
            self._estimator.hear_vehicle(motion)
        yield from self._tell(motion)

    def on_odometry(self, odometry: DroneOdometry) -> Told:
        """The autopilot's whole estimate."""
        numbers = (odometry.xyz_odom_m, odometry.R_odom_drone, odometry.velocity_drone_mps)
        if self._intake.sound(odometry, "odometry", *numbers, odometry.angular_velocity_drone_radps):
            self._estimator.hear_autopilot(odometry)
        yield from self._tell(odometry)

    def on_attitude(self, attitude: DroneAttitude) -> Told:
        """The autopilot's attitude, used while its odometry is not heard."""
        if self._intake.sound(attitude, "attitude", attitude.R_odom_drone, attitude.angular_velocity_drone_radps):
            self._estimator.hear_autopilot(attitude)
        yield from self._tell(attitude)

    def on_position(self, position: DroneLocalPosition) -> Told:
        """The autopilot's position, in the same frame."""
        if self._intake.sound(position, "position", position.xyz_odom_m, position.velocity_odom_mps):
            self._estimator.hear_autopilot(position)
        yield from self._tell(position)

    def on_visual_motion(self, motion: VisualMotion) -> Told:
        """The drone's odometry by its camera: turns, and directions without a scale."""
        direction, sigma_rad = motion.direction_from, np.array(motion.direction_sigma_rad or 0.0)
        numbers = (motion.R_from_to, motion.covariance_rad2, sigma_rad, *(() if direction is None else (direction,)))
        if self._intake.sound(motion, "drone motion", *numbers):
            self._estimator.hear_pictures(motion)
        yield from self._tell(motion)

    def on_track(self, state: TrackState) -> Told:
        """Whether the tracker still holds the drone."""
        self._following.hear(state)
        yield from self._tell(state)

    def on_fix(self, fix: DroneFix) -> Told:
        """A LiDAR position."""
        velocity = () if fix.velocity_vehicle_mps is None else (fix.velocity_vehicle_mps,)
        bias_covariance_m2 = np.zeros((3, 3)) if fix.bias_covariance_m2 is None else fix.bias_covariance_m2
        numbers = (fix.xyz_vehicle_m, fix.covariance_m2, bias_covariance_m2, *velocity)
        if self._intake.sound(fix, "fix", *numbers) and self._intake.covariant(
            fix.covariance_m2 - bias_covariance_m2, "fix"
        ):
            self._waiting.append(fix)
        yield from self._tell(fix)

    def on_rotation(self, rotation: RelativeRotation) -> Told:
        """A rotation by both cameras; only a RESOLVED one moves the pose."""
        R, covariance = rotation.R_vehicle_drone, rotation.covariance_rad2
        self._rotation_reason = rotation.reason
        if R is None or covariance is None:
            pass
        elif rotation.state is not BranchState.RESOLVED:
            self._ambiguous_ns = rotation.stamp_ns
            self._estimator.unresolved()
        elif self._intake.sound(rotation, "rotation", R, covariance) and self._intake.covariant(covariance, "rotation"):
            self._waiting.append(rotation)
        yield from self._tell(rotation)

    def on_servo(self, servo: ServoState) -> Told:
        """A clock, while a recording is replayed and nothing else is heard."""
        yield from self._tell(servo)

    def on_tick(self, tick: Tick) -> Told:
        """The host's clock."""
        yield from self._tell(tick)

    # output

    def _tell(self, message: Message) -> Told:
        """Let time go on to a message's stamp; a pose when that passes a point of the grid."""
        now_ns = self._intake.pass_time(message.stamp_ns)
        if now_ns is None:
            return
        self._use_waiting(now_ns)
        self._estimator.advance(now_ns)
        at_ns = now_ns // GRID_NS * GRID_NS
        if at_ns > self._told_ns:
            self._told_ns = at_ns
            yield self._pose(at_ns)

    def _use_waiting(self, now_ns: int) -> None:
        """Fixes and rotations whose moment the drone's odometry has reached, in the order of their time."""
        if not self._waiting:
            return
        later: list[DroneFix | RelativeRotation] = []
        for message in sorted(self._waiting, key=lambda m: m.stamp_ns):
            if self._estimator.motions.must_wait(message.stamp_ns, now_ns):
                later.append(message)
            elif isinstance(message, DroneFix):
                if self._following.takes(message.track_id, message.stamp_ns):
                    self._estimator.follow(message)
                    self._estimator.see_fix(message)
            elif message.R_vehicle_drone is not None and message.covariance_rad2 is not None:
                self._estimator.see_rotation(
                    message.stamp_ns, message.R_vehicle_drone, message.covariance_rad2, message.switches
                )
        self._waiting = later

    def _pose(self, now_ns: int) -> RelativePose:
        e = self._estimator
        known = self._known(now_ns) if e.positions.known else None
        state, reason = state_of(known, e, self.settings.limits, now_ns, self._following.reason, self._doubt(now_ns))
        if state is PoseState.LOST or known is None:
            if known is not None:
                e.lose()
            self._jumps.lost()
            return lost(now_ns, self._status(PoseState.LOST, reason))
        self._jumps.see(known, e.resets)
        return pose(known, self._status(state, reason), e.motions)

    def _doubt(self, now_ns: int) -> str:
        """Why a rotation that is told is not believed; empty: none is told."""
        unbacked_ns = self._estimator.unbacked_ns
        if unbacked_ns is not None and now_ns - unbacked_ns < AMBIGUOUS_NS:
            return why_unbacked(self._estimator, unbacked_ns)
        if self._ambiguous_ns is None or now_ns - self._ambiguous_ns >= AMBIGUOUS_NS:
            return ""
        return f"rotation known up to quarter turns: {self._rotation_reason}"

    def _status(self, state: PoseState, reason: str) -> Status:
        e = self._estimator
        return Status(state, reason, e.newest_fix_ns, e.track_id, e.resets + self._jumps.number, e.positions.nis)

    def _known(self, now_ns: int) -> MapEstimate:
        """The estimate carried to now, with what never averages out added."""
        e = self._estimator
        R, xyz_m, covariance = e.at(now_ns)
        lasting = e.positions.bias_covariance_m2
        unsure = R is not None and yaw_sigma_rad(R, covariance) > math.radians(self.settings.limits.yaw_sigma_deg)
        whole = covariance.copy()
        if R is None or unsure:
            whole[3:, 3:] = lasting + (covariance[3:, 3:] if R is None else position_covariance(covariance, R))
        else:
            whole[:3, :3] += self.settings.errors.rotation_lasting * e.chain.rotation_covariance_rad2
            whole[3:, 3:] += R.T @ lasting @ R
        R_known = None if unsure else R
        yaw_sigma = 0.0 if R_known is None else yaw_sigma_rad(R_known, whole)
        return MapEstimate(now_ns, R_known, xyz_m, whole, *e.positions.velocity(now_ns, R_known, yaw_sigma))
