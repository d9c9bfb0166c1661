"""Fuse: one pose of the drone, 50 times a second, from LiDAR positions, IMU and rotations by cameras.

    fixes, rotations, IMU intervals, each at its own time (estimator.py)
      -> bank of headings, then a graph of poses  -> propagated to now -> RelativePose, HeadingEstimate

Now is the newest stamp received on any port, on a grid of 20 ms; it never decreases. Every port but `fix` may be
unwired, stop and resume. Without `motion` the vehicle frame serves as the map frame; the IMU is then used only with the
setting `parked`, which states that the vehicle is stationary. Without an IMU there are positions, and a rotation only
while cameras give one whose branch is decided.

The autopilot's own position and attitude are evidence for the heading only while they are independent of our pose
(DroneMotion.autopilot); its yaw may be wrong by any angle.

Source: ours; DESIGN, Fusion and The graph: fuse.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from flow.counters import Counters
from flow.message import Message
from flow.stage import Settings, Stage
from stages.fuse.estimator import Estimator
from stages.fuse.intake import Intake
from stages.fuse.jumps import Jumps
from stages.fuse.map_frame import MapChange, MapFrame
from stages.fuse.pose_message import MapEstimate, Status, lost, pose
from stages.fuse.settings import FuseErrors, FuseLimits
from stages.fuse.status import state_of, undecided_reason
from stages.fuse.track_continuity import TrackContinuity
from stages.geometry.frames import Array64, heading_rad
from stages.heading.inertial_state import POSITION, VELOCITY, InertialState, yaw_sigma_rad
from stages.messages import (
    CueFactor,
    DroneCue,
    DroneFix,
    DroneMotion,
    HeadingEstimate,
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
HEADING_NS = 200_000_000  # between two HeadingEstimates
LEAST_PUBLISHED = 1e-4  # probability of a hypothesis
Poses = Iterator[RelativePose | HeadingEstimate | CueFactor]


class FuseSettings(Settings):
    """Settings of `Fuse`."""

    parked: bool = False  # the vehicle is stationary, even without VehicleMotion
    track_id: int | None = Field(None, ge=1)  # follow this drone; None: the lowest number that is TRACKING
    lag_s: float = Field(2.0, ge=0.5, le=10)
    # cues that enter the graph: those that are certainly of the drone whose IMU is used, as its autopilot's are
    cue_sources: frozenset[Literal["gnss", "uwb", "altitude"]] = frozenset({"gnss", "altitude"})
    errors: FuseErrors = FuseErrors()
    limits: FuseLimits = FuseLimits()


class Fuse(Stage[FuseSettings]):
    """Pose of the drone by IMU and LiDAR, with its state."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset(
        {"rotation", "motion", "drone_motion", "visual_motion", "prior", "track", "cue", "servo", "tick"}
    )

    def __init__(self, settings: FuseSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        settings = self.settings
        self._published_ns: int = 0
        self._map_frame = MapFrame(settings.parked)
        self._estimator = Estimator(settings.errors, self._map_frame.vehicle, settings.lag_s)
        self._track_continuity = TrackContinuity(settings.track_id)
        self._intake, self._jumps = Intake(round(settings.lag_s * 1e9)), Jumps(settings.limits)
        self._track_id = 0

    @property
    def counters(self) -> Counters:
        """Invalid messages by reason, and resets of the smoother."""
        late = {"too late": self._estimator.too_late} if self._estimator.too_late else {}
        recoveries = self._estimator.graph.recoveries
        wrong = {f"cue {source}: distrusted": n for source, n in self._estimator.cues.distrusted.items()}
        reset = {"back end reset": recoveries} if recoveries else {}
        return Counters(reset, {**self._intake.rejected, **late, **wrong})

    def on_motion(self, motion: VehicleMotion) -> Poses:
        """Pose of the vehicle in `map`."""
        if self._intake.is_valid(motion, "vehicle motion", motion.xyz_map_m, motion.R_map_vehicle):
            change = self._map_frame.add(motion)
            if change is MapChange.JUMP:
                self._estimator.earlier.forget()  # the frame that begins is another one
            elif change is MapChange.GAP:
                self._estimator.earlier.forget_earlier_run()
            if change is not None:
                self._estimator.start_map(self._map_frame.turn_rad)
        yield from self._publish(motion)

    def on_drone_motion(self, motion: DroneMotion) -> Poses:
        """Interval of the drone's IMU."""
        up = () if motion.up_drone is None else (motion.up_drone,)
        noise = motion.specific_force_noise, motion.angular_velocity_noise
        numbers = (motion.specific_force_drone_mps2, motion.angular_velocity_drone_radps, *noise, *up)
        own = motion.autopilot
        more = () if own is None else (own.xyz_odom_m, own.R_odom_drone, own.velocity_odom_mps)
        if self._intake.is_valid(motion, "drone motion", *numbers, *more):
            self._estimator.add_motion(motion, self._map_frame.is_fixed(motion.stamp_ns))
        yield from self._publish(motion)

    def on_prior(self, prior: HeadingPrior) -> Poses:
        """The drone by the autopilot since an earlier run of grd."""
        sigmas = prior.sigma_rad, prior.position_sigma_m, prior.velocity_sigma_mps
        numbers = np.array([prior.yaw_map_rad, prior.yaw_map_odom_rad, *sigmas])
        if self._intake.is_valid(prior, "heading prior", prior.xyz_map_m, prior.velocity_map_mps, numbers):
            self._estimator.earlier.add_restart_prior(prior)
        yield from self._publish(prior)

    def on_visual_motion(self, motion: VisualMotion) -> Poses:
        """Visual odometry of the drone: turns, and directions without scale."""
        if self._intake.is_valid_visual_motion(motion) and self._map_frame.is_fixed(motion.stamp_ns):
            self._estimator.add(motion)
        yield from self._publish(motion)

    def on_track(self, state: TrackState) -> Poses:
        """State of a track."""
        self._track_continuity.add(state)
        yield from self._publish(state)

    def on_fix(self, fix: DroneFix) -> Poses:
        """LiDAR position."""
        if self._intake.is_valid_fix(fix):
            self._add_fix(fix)
        yield from self._publish(fix)

    def _add_fix(self, fix: DroneFix) -> None:
        if not self._track_continuity.accepts(fix.track_id, fix.stamp_ns):
            return
        if fix.track_id != self._track_id:
            self._estimator.change_track()
        self._track_id = fix.track_id
        self._estimator.add(fix)

    def on_rotation(self, rotation: RelativeRotation) -> Poses:
        """Rotation by both cameras, up to a multiple of 90 deg: the heading decides which."""
        if self._intake.is_valid_rotation(rotation):
            self._estimator.add(rotation)
        yield from self._publish(rotation)

    def on_cue(self, cue: DroneCue) -> Poses:
        """Measurement of GNSS, ranging or altitude."""
        used = cue.source in self.settings.cue_sources
        if used and self._intake.is_valid_cue(cue) and self._map_frame.is_fixed(cue.stamp_ns):
            self._estimator.add(cue)
        yield from self._publish(cue)

    def on_servo(self, servo: ServoState) -> Poses:
        """Clock of a replay without other messages."""
        return self._publish(servo)

    def on_tick(self, tick: Tick) -> Poses:
        """The host's clock."""
        return self._publish(tick)

    # output

    def _publish(self, message: Message) -> Poses:
        """Advance to the stamp of a message; a pose when that passes a point of the grid."""
        now_ns = self._intake.pass_time(message.stamp_ns)
        if now_ns is None or now_ns // GRID_NS * GRID_NS <= self._published_ns:
            return iter(())
        return self._poses_at(now_ns, now_ns // GRID_NS * GRID_NS)

    def _poses_at(self, now_ns: int, at_ns: int) -> Poses:
        """The outputs at a point of the grid."""
        fixed = self._map_frame.is_fixed(now_ns)
        if fixed != self._estimator.map_fixed:  # from now on the map frame moves with the vehicle, or stands
            if fixed:
                self._estimator.start_map(self._map_frame.turn_rad)
            else:
                self._estimator.begin_outage()
        self._estimator.map_fixed = fixed
        self._estimator.pass_time(now_ns)
        yield from self._estimator.cue_factors
        self._estimator.cue_factors.clear()
        heading = at_ns // HEADING_NS > self._published_ns // HEADING_NS
        self._published_ns = at_ns
        yield self._pose(at_ns)
        if heading:
            yield self._heading(at_ns)

    def _pose(self, now_ns: int) -> RelativePose:
        e = self._estimator
        known = self._known(now_ns) if e.known else None
        state, reason = state_of(known, e, self.settings.limits, now_ns, self._track_continuity.reason)
        resets = e.resets
        if state is PoseState.LOST or known is None:
            self._jumps.lost()
            return lost(now_ns, self._status(PoseState.LOST, reason))
        self._jumps.add(known, resets)
        return pose(known, self._status(state, reason), self._map_frame)

    def _status(self, state: PoseState, reason: str) -> Status:
        e = self._estimator
        measured_ns, resets = e.fix_ns or e.newest_fix_ns, e.resets + self._jumps.number
        rotation_ns, number = e.measured_rotation_ns, e.map_number
        return Status(state, reason, measured_ns, self._track_id, resets, e.nis, rotation_ns, e.odom_yaw, number)

    def _known(self, now_ns: int) -> MapEstimate:
        """The estimate propagated to now, with the bias covariances added."""
        e = self._estimator
        state = e.at(now_ns)
        R, P = state.R[0], state.covariance[0]
        whole = np.zeros((6, 6))
        velocity = state.velocity_mps[0], P[VELOCITY, VELOCITY]
        if e.decided:
            axes = np.eye(6)
            axes[3:, 3:] = R.T  # position in drone axes
            whole = axes @ P[:6, :6] @ axes.T
            whole[:3, :3] += e.rotation_bias_rad2
            whole[3:, 3:] += R.T @ e.bias_covariance_m2 @ R
            if yaw_sigma_rad(R, whole) <= math.radians(self.settings.limits.yaw_sigma_deg):
                return MapEstimate(now_ns, R, state.xyz_m[0], whole, *velocity)
        whole[3:, 3:] = P[POSITION, POSITION] + e.bias_covariance_m2
        return MapEstimate(now_ns, None, state.xyz_m[0], whole, *velocity)

    def _heading(self, now_ns: int) -> HeadingEstimate:
        e = self._estimator
        yaw, sigma, probability, near = _hypotheses(e)
        reason = "decided" if e.decided else undecided_reason(e, now_ns) if e.known else "no drone is followed"
        return HeadingEstimate(
            stamp_ns=now_ns,
            yaw_map_rad=yaw,
            sigma_rad=sigma,
            probability=probability,
            vehicle_yaw_rad=heading_rad(self._map_frame.vehicle.at(now_ns)[0]),
            near_probability=near,
            decided=e.decided,
            reason=reason,
        )


def _hypotheses(estimator: Estimator) -> tuple[Array64, Array64, Array64, float]:
    """Yaw, sigma and probability of each hypothesis, most probable first; probability near the first."""
    none = np.zeros(0)
    if estimator.graph.running:
        state: InertialState = estimator.graph.state
        return state.yaw_rad, np.sqrt(state.yaw_variance_rad2), np.ones(1), 1.0
    if estimator.heading.bank is None:
        return none, none, none, 0.0
    yaws = estimator.heading.yaws()
    order = np.argsort(-yaws.weight, kind="stable")
    order = order[yaws.weight[order] > LEAST_PUBLISHED]
    sigma = np.sqrt(yaws.variance_rad2[order])
    return yaws.yaw_rad[order], sigma, yaws.weight[order], estimator.heading.near_probability
