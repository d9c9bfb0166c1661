"""One pose of the drone, fifty times a second, from everything that tells of it.

    fixes, rotations, odometries, each at its own time (estimator.py)
      -> a chain of poses (smoother.py, or ekf.py)  -> predicted to now -> RelativePose

Now is the newest stamp heard on any port, on a grid of 20 ms; it never goes back. Every port but `fix` may be unwired,
fall silent and return. Without `motion` the vehicle's frame at each moment is taken for the start frame, as if it were
parked; only with `parked` is it believed to stand, so that the drone's own odometry is used.

    LOST            no position, or its sigma or age is beyond the limit
    POSITION_ONLY   the LiDAR sees the drone, its yaw is not known
    AMBIGUOUS       as before; a rotation is told, up to quarter turns, or two tell different ones
    FULL            position and rotation
    COASTING        was FULL; the drone's odometry carries the pose over a gap of the LiDAR's

A rotation comes from RelativeRotation when RESOLVED, or from the drone's motion as the LiDAR and its autopilot tell it
(motion_yaw.py): then FULL needs no pictures. Doubt about it (heading.py) ends FULL at once.

Source: ours; DESIGN, Fusion and The graph: fuse.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, PrivateAttr

from flow.message import Message
from flow.stage import Stage
from stages.fuse.back_end import BackEnd
from stages.fuse.ekf import Ekf
from stages.fuse.estimator import Estimator, yaw_sigma_rad
from stages.fuse.following import Following
from stages.fuse.rigid import good_covariance, position_covariance
from stages.fuse.settings import FuseErrors, FuseLimits
from stages.fuse.smoother import Smoother
from stages.fuse.told import Known, Verdict, lost, pose
from stages.geometry import Array64
from stages.messages import (
    BranchState,
    DroneAttitude,
    DroneFix,
    DroneLocalPosition,
    DroneMotion,
    DroneOdometry,
    PoseState,
    RelativePose,
    RelativeRotation,
    ServoState,
    Tick,
    TrackState,
    VehicleMotion,
)
from stages.rotation import log_rotation

GRID_NS = 20_000_000
AHEAD_NS = 1_000_000_000  # a stamp so far ahead of now is a broken clock's, unless several say so
BELIEVED = 5
AMBIGUOUS_NS = 1_000_000_000  # a rotation up to quarter turns counts for so long
JUMP_MPS2, JUMP_RAD_PER_S = 10.0, 4.0  # what a drone can do between two outputs
Told = Iterator[RelativePose]


class Fuse(Stage):
    """The smoother."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset(
        {"rotation", "motion", "position", "odometry", "attitude", "drone_motion", "track", "servo", "tick"}
    )

    parked: bool = False  # the vehicle stands, whether it says so or not
    track_id: int | None = Field(None, ge=1)  # follow this drone; None: the lowest number that is TRACKING
    lag_s: float = Field(3.0, ge=0.5, le=20)
    errors: FuseErrors = FuseErrors()
    limits: FuseLimits = FuseLimits()

    _estimator: Estimator = PrivateAttr()
    _following: Following = PrivateAttr()
    _now_ns: int | None = PrivateAttr(default=None)
    _told_ns: int = PrivateAttr(default=0)
    _ahead: int = PrivateAttr(default=0)  # stamps far ahead, in a row
    _waiting: list[DroneFix | RelativeRotation] = PrivateAttr(
        default_factory=lambda: list[DroneFix | RelativeRotation]()
    )
    _ambiguous_ns: int | None = PrivateAttr(default=None)
    _rotation_reason: str = PrivateAttr(default="no rotation heard")
    _last: Known | None = PrivateAttr(default=None)
    _jumps: int = PrivateAttr(default=0)
    _resets_told: int = PrivateAttr(default=0)
    _refused: Counter[str] = PrivateAttr(default_factory=lambda: Counter[str]())

    def model_post_init(self, context: Any, /) -> None:
        self._estimator = Estimator(self._back_end(), self.errors, self.limits, self.parked)
        self._following = Following(self.track_id)

    def _back_end(self) -> BackEnd:
        return Smoother(self.lag_s)

    @property
    def refused(self) -> Counter[str]:
        """Messages left out because they make no sense, by reason."""
        return self._refused

    @property
    def recoveries(self) -> int:
        """How often the back end had to be begun anew after an error of its library."""
        return self._estimator.back.recoveries

    def on_motion(self, motion: VehicleMotion) -> Told:
        """Where the vehicle is in the start frame."""
        if self._sound(motion, "vehicle motion", motion.xyz_start_m, motion.R_start_vehicle):
            self._estimator.hear_vehicle(motion)
        yield from self._tell(motion)

    def on_odometry(self, odometry: DroneOdometry) -> Told:
        """The autopilot's whole estimate."""
        numbers = (odometry.xyz_local_m, odometry.R_local_drone, odometry.velocity_drone_mps)
        if self._sound(odometry, "odometry", *numbers, odometry.angular_velocity_drone_radps):
            self._estimator.hear_autopilot(odometry)
        yield from self._tell(odometry)

    def on_attitude(self, attitude: DroneAttitude) -> Told:
        """The autopilot's attitude, used while its odometry is not heard."""
        if self._sound(attitude, "attitude", attitude.R_local_drone, attitude.angular_velocity_drone_radps):
            self._estimator.hear_autopilot(attitude)
        yield from self._tell(attitude)

    def on_position(self, position: DroneLocalPosition) -> Told:
        """The autopilot's position, in the same frame."""
        if self._sound(position, "position", position.xyz_local_m, position.velocity_local_mps):
            self._estimator.hear_autopilot(position)
        yield from self._tell(position)

    def on_drone_motion(self, motion: DroneMotion) -> Told:
        """The drone's odometry by its camera: turns, and directions without a scale."""
        if self._sound(motion, "drone motion", motion.R_from_to, motion.covariance_rad2):
            self._estimator.hear_pictures(motion)
        yield from self._tell(motion)

    def on_track(self, state: TrackState) -> Told:
        """Whether the tracker still holds the drone."""
        self._following.hear(state)
        yield from self._tell(state)

    def on_fix(self, fix: DroneFix) -> Told:
        """A LiDAR position."""
        numbers = (fix.xyz_vehicle_m, fix.covariance_m2)
        if self._sound(fix, "fix", *numbers) and self._covariant(fix.covariance_m2, "fix"):
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
        elif self._sound(rotation, "rotation", R, covariance) and self._covariant(covariance, "rotation"):
            self._waiting.append(rotation)
        yield from self._tell(rotation)

    def on_servo(self, servo: ServoState) -> Told:
        """A clock, while a recording is replayed and nothing else is heard."""
        yield from self._tell(servo)

    def on_tick(self, tick: Tick) -> Told:
        """The host's clock."""
        yield from self._tell(tick)

    # checks

    def _sound(self, message: Message, what: str, *numbers: Array64) -> bool:
        """Whether a message is finite and of this time; what is not is counted."""
        if not all(np.isfinite(v).all() for v in numbers):
            self._refused[f"{what}: not finite"] += 1
            return False
        if self._now_ns is not None and message.stamp_ns > self._now_ns + AHEAD_NS and self._ahead < BELIEVED:
            self._refused[f"{what}: from the future"] += 1
            return False
        if self._now_ns is not None and message.stamp_ns < self._now_ns - round(self.lag_s * 1e9):
            self._refused[f"{what}: older than the lag"] += 1
            return False
        return True

    def _covariant(self, covariance: Array64, what: str) -> bool:
        if good_covariance(covariance):
            return True
        self._refused[f"{what}: its covariance is not positive definite"] += 1
        return False

    # output

    def _tell(self, message: Message) -> Told:
        """Let time go on to a message's stamp; a pose when that passes a point of the grid."""
        stamp_ns = message.stamp_ns
        if self._now_ns is None:
            self._now_ns = stamp_ns
        elif stamp_ns > self._now_ns + AHEAD_NS:
            self._ahead += 1
            if self._ahead <= BELIEVED:
                return
        self._ahead = 0
        self._now_ns = max(self._now_ns, stamp_ns)
        self._use_waiting(self._now_ns)
        self._estimator.advance(self._now_ns)
        at_ns = self._now_ns // GRID_NS * GRID_NS
        if at_ns > self._told_ns:
            self._told_ns = at_ns
            yield self._pose(at_ns)

    def _use_waiting(self, now_ns: int) -> None:
        """Fixes and rotations whose moment the drone's odometry has reached, in the order of their time."""
        if not self._waiting:
            return
        later: list[DroneFix | RelativeRotation] = []
        for message in sorted(self._waiting, key=lambda m: m.stamp_ns):
            if self._estimator.must_wait(message.stamp_ns, now_ns):
                later.append(message)
            elif isinstance(message, DroneFix):
                if self._following.takes(message.track_id, message.stamp_ns):
                    self._estimator.follow(message.track_id)
                    self._estimator.see_fix(message)
            elif message.R_vehicle_drone is not None and message.covariance_rad2 is not None:
                self._estimator.see_rotation(
                    message.stamp_ns, message.R_vehicle_drone, message.covariance_rad2, message.switches
                )
        self._waiting = later

    def _pose(self, now_ns: int) -> RelativePose:
        estimator = self._estimator
        known = None if estimator.free.stamp_ns is None else self._known(now_ns)
        state, reason = self._judge(now_ns, known)
        if state is PoseState.LOST or known is None:
            if known is not None:
                estimator.lose()
                self._jumps += 1  # where it is found again is not where it was
            self._last = None
            return lost(now_ns, self._verdict(PoseState.LOST, reason))
        self._count_jump(known)
        self._last = known
        return pose(known, self._verdict(state, reason), estimator.vehicle)

    def _verdict(self, state: PoseState, reason: str) -> Verdict:
        e = self._estimator
        return Verdict(state, reason, e.newest_fix_ns, e.track_id, e.resets + self._jumps, e.nis)

    def _known(self, now_ns: int) -> Known:
        """The estimate carried to now, with what never averages out added."""
        e = self._estimator
        _, R, xyz_m, covariance = e.at(now_ns)
        lasting = self.errors.fix_lasting * e.fix_covariance_m2
        unsure = R is not None and yaw_sigma_rad(R, covariance) > math.radians(self.limits.yaw_sigma_deg)
        whole = covariance.copy()
        if R is None or unsure:
            whole[3:, 3:] = lasting + (covariance[3:, 3:] if R is None else position_covariance(covariance, R))
        else:
            whole[:3, :3] += self.errors.rotation_lasting * e.rotation_covariance_rad2
            whole[3:, 3:] += R.T @ lasting @ R
        R_known = None if unsure else R
        return Known(now_ns, R_known, xyz_m, whole, *e.velocity(now_ns, R_known, whole))

    def _judge(self, now_ns: int, known: Known | None) -> tuple[PoseState, str]:
        """The state, and why."""
        e, limits = self._estimator, self.limits
        if known is None or e.fix_ns is None:
            if e.newest_fix_ns is None:
                return PoseState.LOST, self._following.reason
            silent_s = (now_ns - e.newest_fix_ns) * 1e-9
            return PoseState.LOST, f"no LiDAR position for {silent_s:.1f} s; {self._following.reason}"
        age_s = (now_ns - e.fix_ns) * 1e-9
        worst_m = math.sqrt(float(np.linalg.eigvalsh(known.covariance[3:, 3:])[-1]))
        if age_s > limits.lost_after_s:
            return PoseState.LOST, f"no LiDAR position for {age_s:.1f} s"
        if not worst_m <= limits.lost_sigma_m:
            return PoseState.LOST, f"position known to {worst_m:.1f} m only, {age_s:.1f} s after the last by LiDAR"
        unseen = f"; the LiDAR has not seen it for {age_s:.1f} s" if age_s > limits.coast_after_s else ""
        if known.R_start_drone is None:
            if e.north.heading.contradiction:
                return PoseState.AMBIGUOUS, e.north.heading.contradiction + unseen
            if self._ambiguous_ns is not None and now_ns - self._ambiguous_ns < AMBIGUOUS_NS:
                return PoseState.AMBIGUOUS, f"rotation known up to quarter turns: {self._rotation_reason}{unseen}"
            return PoseState.POSITION_ONLY, f"heading not known: {e.north.by_motion.reason}{unseen}"
        if unseen:
            return PoseState.COASTING, f"carried by odometry{unseen}"
        return PoseState.FULL, e.why_rotation

    def _count_jump(self, known: Known) -> None:
        """A pose that is not where the one before, carried on, would be: the autopilot has to be told."""
        last, told = self._last, self._resets_told
        self._resets_told = self._estimator.resets
        if last is None or self._estimator.resets > told:
            return
        dt = (known.stamp_ns - last.stamp_ns) * 1e-9
        off_m = float(np.linalg.norm(known.xyz_start_m - last.xyz_start_m - dt * last.velocity_start_mps))
        jumped = off_m > self.limits.jump_m + JUMP_MPS2 * dt**2
        if known.R_start_drone is not None and last.R_start_drone is not None:
            turned = float(np.linalg.norm(log_rotation(last.R_start_drone.T @ known.R_start_drone)))
            jumped |= turned > math.radians(self.limits.jump_deg) + JUMP_RAD_PER_S * dt
        self._jumps += jumped


class EkfFuse(Fuse):
    """The same with a Kalman filter in place of the smoother, for comparison."""

    def _back_end(self) -> BackEnd:
        return Ekf()
