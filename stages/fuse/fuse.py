"""Fuse: one pose of the drone, 50 times a second, from all measurements.

    fixes, rotations, odometries, each at its own time (estimator.py)
      -> a chain of poses (smoother.py)  -> predicted to now -> RelativePose

Now is the newest stamp received on any port, on a grid of 20 ms; it never decreases. Every port but `fix` may be
unwired, stop and resume. Without `motion` the vehicle frame serves as the map frame. The drone's odometry over ground
is then used only with the setting `parked`, which states that the vehicle is stationary.

A rotation comes from a RESOLVED RelativeRotation, or from the drone's motion by LiDAR and autopilot (motion_yaw.py):
then FULL needs no images. A contradiction of the two (fused_heading.py) ends FULL at once. States: status.py.

Source: ours; DESIGN, Fusion and The graph: fuse.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from flow.counters import Counters
from flow.message import Message
from flow.stage import Settings, Stage
from stages.fuse.chain import yaw_sigma_rad
from stages.fuse.estimator import Estimator
from stages.fuse.intake import Intake
from stages.fuse.pose_message import MapEstimate, Status, lost, pose
from stages.fuse.settings import FuseErrors, FuseLimits
from stages.fuse.smoother import BackEnd, Smoother
from stages.fuse.status import Jumps, state_of, unconfirmed_reason
from stages.fuse.track_continuity import TrackContinuity
from stages.geometry.se3 import position_covariance
from stages.messages import (
    BranchState,
    DroneAttitude,
    DroneFix,
    DroneLocalPosition,
    DroneOdometry,
    HeadingPrior,
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
AMBIGUOUS_NS = 1_000_000_000  # an ambiguous rotation is reported for this long
Poses = Iterator[RelativePose]


class FuseSettings(Settings):
    """Settings of `Fuse`."""

    parked: bool = False  # the vehicle is stationary, even without VehicleMotion
    track_id: int | None = Field(None, ge=1)  # follow this drone; None: the lowest number that is TRACKING
    lag_s: float = Field(3.0, ge=0.5, le=20)
    errors: FuseErrors = FuseErrors()
    limits: FuseLimits = FuseLimits()


class Fuse(Stage[FuseSettings]):
    """Pose of the drone by a fixed-lag smoother, with its state."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset(
        {"rotation", "motion", "position", "odometry", "attitude", "visual_motion", "prior", "track", "servo", "tick"}
    )

    def __init__(self, settings: FuseSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._published_ns: int = 0
        self._waiting: list[DroneFix | RelativeRotation] = []
        self._ambiguous_ns: int | None = None
        self._rotation_reason: str = "no rotation received"
        settings = self.settings
        self._estimator = Estimator(self._back_end(), settings.errors, settings.limits, settings.parked)
        self._track_continuity = TrackContinuity(settings.track_id)
        self._intake, self._jumps = Intake(round(settings.lag_s * 1e9)), Jumps(settings.limits)

    def _back_end(self) -> BackEnd:
        return Smoother(self.settings.lag_s)

    @property
    def rejected(self) -> Counter[str]:
        """Invalid messages, by reason."""
        return self._intake.rejected

    @property
    def counters(self) -> Counters:
        """Invalid messages by reason, and resets of the back end."""
        return Counters({"back end reset": self.recoveries} if self.recoveries else {}, self.rejected)

    @property
    def recoveries(self) -> int:
        """How often the back end had to be reset after an error of its library."""
        return self._estimator.chain.back.recoveries

    def on_motion(self, motion: VehicleMotion) -> Poses:
        """Pose of the vehicle in `map`."""
        if self._intake.is_valid(motion, "vehicle motion", motion.xyz_map_m, motion.R_map_vehicle):
            self._estimator.add_vehicle_motion(motion)
        yield from self._publish(motion)

    def on_odometry(self, odometry: DroneOdometry) -> Poses:
        """Pose and velocity by the autopilot."""
        numbers = (odometry.xyz_odom_m, odometry.R_odom_drone, odometry.velocity_drone_mps)
        if self._intake.is_valid(odometry, "odometry", *numbers, odometry.angular_velocity_drone_radps):
            self._estimator.add_autopilot(odometry)
        yield from self._publish(odometry)

    def on_attitude(self, attitude: DroneAttitude) -> Poses:
        """Attitude by the autopilot, used without its odometry."""
        if self._intake.is_valid(attitude, "attitude", attitude.R_odom_drone, attitude.angular_velocity_drone_radps):
            self._estimator.add_autopilot(attitude)
        yield from self._publish(attitude)

    def on_position(self, position: DroneLocalPosition) -> Poses:
        """Position by the autopilot, in frame odom."""
        if self._intake.is_valid(position, "position", position.xyz_odom_m, position.velocity_odom_mps):
            self._estimator.add_autopilot(position)
        yield from self._publish(position)

    def on_prior(self, prior: HeadingPrior) -> Poses:
        """Yaw of frame odom that an earlier run of grd knew."""
        numbers = np.array([prior.yaw_map_odom_rad, prior.sigma_rad, prior.position_sigma_m])
        if self._intake.is_valid(prior, "heading prior", prior.xyz_map_m, numbers):
            self._estimator.add_prior(prior)
        yield from self._publish(prior)

    def on_visual_motion(self, motion: VisualMotion) -> Poses:
        """Visual odometry of the drone: turns, and directions without scale."""
        if self._intake.is_valid_visual_motion(motion):
            self._estimator.add_visual_motion(motion)
        yield from self._publish(motion)

    def on_track(self, state: TrackState) -> Poses:
        """State of a track."""
        self._track_continuity.add(state)
        yield from self._publish(state)

    def on_fix(self, fix: DroneFix) -> Poses:
        """LiDAR position."""
        if self._intake.is_valid_fix(fix):
            self._waiting.append(fix)
        yield from self._publish(fix)

    def on_rotation(self, rotation: RelativeRotation) -> Poses:
        """Rotation by both cameras; only a RESOLVED one corrects the pose."""
        self._rotation_reason = rotation.reason
        if rotation.R_vehicle_drone is None or rotation.covariance_rad2 is None:
            pass
        elif rotation.state is not BranchState.RESOLVED:
            self._ambiguous_ns = rotation.stamp_ns
            self._estimator.unresolved()
        elif self._intake.is_valid_rotation(rotation):
            self._waiting.append(rotation)
        yield from self._publish(rotation)

    def on_servo(self, servo: ServoState) -> Poses:
        """Clock of a replay without other messages."""
        yield from self._publish(servo)

    def on_tick(self, tick: Tick) -> Poses:
        """The host's clock."""
        yield from self._publish(tick)

    # output

    def _publish(self, message: Message) -> Poses:
        """Advance to the stamp of a message; yield a pose when that passes a point of the grid."""
        now_ns = self._intake.pass_time(message.stamp_ns)
        if now_ns is None:
            return
        self._use_waiting(now_ns)
        self._estimator.advance(now_ns)
        at_ns = now_ns // GRID_NS * GRID_NS
        if at_ns > self._published_ns:
            self._published_ns = at_ns
            yield self._pose(at_ns)

    def _use_waiting(self, now_ns: int) -> None:
        """Use fixes and rotations up to the newest odometry of the drone, in time order."""
        if not self._waiting:
            return
        later: list[DroneFix | RelativeRotation] = []
        for message in sorted(self._waiting, key=lambda m: m.stamp_ns):
            if self._estimator.motions.must_wait(message.stamp_ns, now_ns):
                later.append(message)
            elif isinstance(message, DroneFix):
                if self._track_continuity.accepts(message.track_id, message.stamp_ns):
                    self._estimator.follow(message)
                    self._estimator.add_fix(message)
            elif message.R_vehicle_drone is not None and message.covariance_rad2 is not None:
                self._estimator.add_rotation(
                    message.stamp_ns, message.R_vehicle_drone, message.covariance_rad2, message.switches
                )
        self._waiting = later

    def _pose(self, now_ns: int) -> RelativePose:
        e = self._estimator
        known = self._known(now_ns) if e.positions.known else None
        state, reason = state_of(
            known, e, self.settings.limits, now_ns, self._track_continuity.reason, self._ambiguity(now_ns)
        )
        if state is PoseState.LOST or known is None:
            if known is not None:
                e.lose()
            self._jumps.lost()
            return lost(now_ns, self._status(PoseState.LOST, reason))
        self._jumps.see(known, e.resets)
        return pose(known, self._status(state, reason), e.motions)

    def _ambiguity(self, now_ns: int) -> str:
        """Why a received rotation is not used; empty: none was received."""
        unconfirmed_ns = self._estimator.unconfirmed_ns
        if unconfirmed_ns is not None and now_ns - unconfirmed_ns < AMBIGUOUS_NS:
            return unconfirmed_reason(self._estimator, unconfirmed_ns)
        if self._ambiguous_ns is None or now_ns - self._ambiguous_ns >= AMBIGUOUS_NS:
            return ""
        return f"rotation known up to a multiple of 90 deg: {self._rotation_reason}"

    def _status(self, state: PoseState, reason: str) -> Status:
        e = self._estimator
        resets = e.resets + self._jumps.number
        return Status(state, reason, e.newest_fix_ns, e.track_id, resets, e.positions.nis, e.vp_rotation_ns, e.raw_yaw)

    def _known(self, now_ns: int) -> MapEstimate:
        """The estimate propagated to now, with the bias covariances added."""
        e = self._estimator
        R, xyz_m, covariance = e.at(now_ns)
        bias_covariance_m2 = e.positions.bias_covariance_m2
        yaw_uncertain = R is not None and yaw_sigma_rad(R, covariance) > math.radians(
            self.settings.limits.yaw_sigma_deg
        )
        whole = covariance.copy()
        if R is None or yaw_uncertain:
            whole[3:, 3:] = bias_covariance_m2 + (
                covariance[3:, 3:] if R is None else position_covariance(covariance, R)
            )
        else:
            whole[:3, :3] += self.settings.errors.rotation_bias_share * e.chain.rotation_covariance_rad2
            whole[3:, 3:] += R.T @ bias_covariance_m2 @ R
        R_known = None if yaw_uncertain else R
        yaw_sigma = 0.0 if R_known is None else yaw_sigma_rad(R_known, whole)
        return MapEstimate(now_ns, R_known, xyz_m, whole, *e.positions.velocity(now_ns, R_known, yaw_sigma))
