"""Messages and texts to the autopilot about the poses: which, when, and with which reset counter. No socket, no clock.

`yaw` decides what ODOMETRY and VISION_POSITION_ESTIMATE contain, and which yaw source the autopilot needs:

    none      a position in the autopilot's own axes; its yaw comes from its compass. It needs no rotation of the drone
    measured  a pose with yaw, while cameras or the raw IMU measure it; its yaw comes from grd alone. The axes are
              parallel to the autopilot's own when the first pose since its boot is sent, by its motion if that shows
              them to 2 deg, else by its attitude; without an attitude they are those of `map`. They are kept while
              `map` is the same. After a restart in flight the attitude contains earlier poses: it chooses the axes, and
              measures nothing

Both are in the frame of the autopilot's own position at the first pose (`SentFrame`). After a restart in flight that
position has drifted meanwhile, and the frame begins there.

The reset counter is incremented with every jump of the pose or of its frame, every change of the drone, and after every
pause that the autopilot noticed, so that it resets to the new position instead of gating it. ArduPilot does not reset
its yaw then. Its initial value is
arbitrary: after a restart of grd it should differ from the previous one.

`max_pose_hz` leaves poses out on a slow link; one after a jump is sent at once.

Texts: `status_texts.py`. Rejection of the pose by the autopilot: `fusion_monitor.py`.

Source: ours; ArduPilot AP_VisualOdom (300 ms health), AP_AHRS::attitudes_consistent (20 deg of yaw); PX4 EKF2
EV_MAX_INTERVAL (200 ms to start, 400 ms to stop).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from links.mavlink.poses.autopilot_estimate import MAX_ATTITUDE_AGE_NS, AutopilotEstimate
from links.mavlink.poses.fusion_monitor import FusionMonitor, OnRejection
from links.mavlink.poses.gate import PoseLimits, RejectReason, reject_reason
from links.mavlink.poses.odom_frame import odom_yaw_rad
from links.mavlink.poses.pose_messages import landing_target, odometry, vision_position_estimate
from links.mavlink.poses.position_gate import gate_reason
from links.mavlink.poses.position_messages import position_odometry, position_vision_estimate
from links.mavlink.poses.sent_frame import ECHO_M, FAR_M, SentFrame
from links.mavlink.poses.status_texts import StatusTexts
from links.mavlink.profiles import ProfileName, YawOutput
from links.mavlink.transport.framing import SEQUENCE
from stages.geometry.frames import Array64
from stages.heading.odometry_heading import SHARP_RAD, WRONG_COMPASS_RAD
from stages.messages import PoseState, RelativePose

PoseMessage = Literal["odometry", "vision_position_estimate", "landing_target"]

POSE_TIMEOUT_NS = 300_000_000  # the autopilot's timeout for poses
STAMP_ERROR_NS = 1_000_000  # ours: poses a period apart by less than this are one period apart
FIRST_POSITION_AGE_NS = 1_000_000_000  # of the autopilot's position against the first pose: it comes at 4 Hz or more


@dataclass(frozen=True, slots=True)
class SentPose:
    """The pose that was sent last."""

    at_ns: int
    stamp_ns: int
    resets: int
    track_id: int


class PoseSender:
    """Converts poses to messages, or rejects them and reports why. Call `due_texts` about ten times per second."""

    def __init__(
        self,
        kinds: Sequence[PoseMessage],
        limits: PoseLimits,
        reset_counter: int = 0,
        *,
        yaw: YawOutput,
        profile: ProfileName = "ardupilot",
        on_rejection: OnRejection = "stop",
        max_pose_hz: float | None = None,
    ) -> None:
        self.rejected: Counter[RejectReason] = Counter()
        self.frame: SentFrame | None = None
        """Frame that poses are sent in; None: none was sent since the autopilot's boot."""
        self._next_frame: SentFrame | None = None  # of the newest messages; `frame` once they were sent
        self.reset_counter = reset_counter % SEQUENCE
        self._kinds: tuple[PoseMessage, ...] = tuple(kinds)
        self._limits = limits
        self._yaw: YawOutput = yaw
        self._profile: ProfileName = profile
        self._least_apart_ns = 0 if max_pose_hz is None else round(1e9 / max_pose_hz) - STAMP_ERROR_NS
        self._yaw_reset = False  # since the first pose
        self._odom_yaw_rad: float | None = None  # of the newest pose that had one
        self._axes_pose: RelativePose | None = None  # first pose sent without yaw since the estimate last jumped
        self._other_boot_rad: float | None = None  # yaw of its axes before its newest boot: not valid any more
        to_ekf: list[PoseMessage] = [kind for kind in self._kinds if kind != "landing_target"]
        self._to_ekf: tuple[PoseMessage, ...] = tuple(to_ekf) or self._kinds
        self._sent: SentPose | None = None  # of `_to_ekf`
        self._newest_ns: int | None = None  # stamp of the newest pose of which anything was sent
        self._incremented = False  # the reset counter, since `_sent`
        self._sending = False
        sufficient = (PoseState.FULL, PoseState.POSITION_ONLY) if yaw == "none" else (PoseState.FULL,)
        self.texts = StatusTexts(sufficient)
        self.fusion = FusionMonitor(on_rejection)
        self.autopilot = AutopilotEstimate()

    @property
    def sends_yaw(self) -> bool:
        """Whether the poses contain the yaw."""
        return self._yaw == "measured"

    @property
    def sending(self) -> bool:
        """Whether poses are being sent."""
        return self._sending

    def turn_rad(self, pose: RelativePose) -> float | None:
        """Angle of the axes of a sent pose against the autopilot's own [rad]; None: not known."""
        own_yaw_rad = self._odom_axes_yaw_rad(self.with_axes(pose))
        return None if own_yaw_rad is None or self.frame is None else self.frame.yaw_rad - own_yaw_rad

    def with_axes(self, pose: RelativePose) -> RelativePose:
        """A pose with the axes of the first one that was sent, until the estimate jumps: positions must not turn."""
        first = self._axes_pose
        if first is None or pose.odom_yaw_rad is None or _estimate_of(pose) != _estimate_of(first):
            return pose
        return replace(pose, odom_yaw_rad=first.odom_yaw_rad, odom_yaw_sigma_rad=first.odom_yaw_sigma_rad)

    def messages(self, pose: RelativePose, now_ns: int, link_reason: RejectReason | None = None) -> list[Any]:
        """Messages of one pose; none if the gate rejects it, or with a `link_reason`. Then call `on_sent`."""
        self.texts.on_state(pose.state, pose.reason, now_ns)
        if pose.odom_yaw_rad is not None:
            self._odom_yaw_rad = pose.odom_yaw_rad
        pose = self.with_axes(pose)
        reasons: dict[PoseMessage, RejectReason | None] = {
            kind: self._reason(kind, pose, now_ns) or link_reason for kind in self._kinds
        }
        self.rejected.update({reason for reason in reasons.values() if reason is not None})
        sendable: list[PoseMessage] = [kind for kind, reason in reasons.items() if reason is None]
        if not any(kind in sendable for kind in self._to_ekf):
            reason = next((reasons[kind] for kind in self._to_ekf), None)
            if reason is not None and reason is not RejectReason.NOT_NEWER:  # a newer one was sent
                self._stop(reason.value)
        else:
            if self._has_jumped(pose, now_ns):
                self._increment_reset_counter()
            elif self._sent is not None and pose.stamp_ns - self._sent.stamp_ns < self._least_apart_ns:
                return []
            self._next_frame = self._frame_of(pose)
        return [self._message(kind, pose) for kind in sendable]

    def on_yaw_reset(self) -> None:
        """The autopilot has reset its yaw. Once its telemetry contains our poses, its axes are then unknown."""
        self._yaw_reset = self._yaw_reset or self.frame is not None

    def on_boot(self) -> None:
        """The autopilot has booted: its axes are others, and their yaw has to be learnt again before a pose is sent."""
        self._yaw_reset = False
        self._other_boot_rad, self.frame, self._axes_pose = self._odom_yaw_rad, None, None
        self.fusion.on_boot()

    def on_estimator_status(self, message: Any, now_ns: int, uses_grd: bool | None = None) -> None:
        """EKF_STATUS_REPORT or ESTIMATOR_STATUS of the autopilot; others are ignored.

        `uses_grd`: whether ArduPilot uses the source set of grd; None: not known.
        """
        rejected = self.fusion.add(message, self._sending, now_ns, uses_grd, self.sends_yaw)
        if rejected is not None:
            text, reset = rejected
            self.texts.warn(text)
            if reset:
                self.reset_counter = (self.reset_counter + 1) % SEQUENCE

    def on_sent(self, pose: RelativePose, now_ns: int, sent: Sequence[Any]) -> None:
        """Messages of this pose that were sent."""
        self._newest_ns = pose.stamp_ns
        if not {message.get_type().lower() for message in sent} & set(self._to_ekf):
            return
        if not self.sends_yaw and (self._axes_pose is None or _estimate_of(pose) != _estimate_of(self._axes_pose)):
            self._axes_pose = pose
        self._sent = SentPose(now_ns, pose.stamp_ns, pose.resets, pose.track_id)
        self._incremented, self.frame = False, self._next_frame
        if not self._sending:
            self._sending = True
            self.texts.on_sending(now_ns)

    def due_texts(self, now_ns: int) -> list[Any]:
        """The STATUSTEXT that is due, if any. Also detects that no pose has been sent for POSE_TIMEOUT_NS."""
        if self._sending and self._sent is not None and now_ns - self._sent.at_ns > POSE_TIMEOUT_NS:
            self._stop("no poses sent")
        return self.texts.due(now_ns)

    def _stop(self, reason: str) -> None:
        if self._sending:
            self._sending = False
            self.texts.on_stopped(reason)

    def _has_jumped(self, pose: RelativePose, now_ns: int) -> bool:
        """Whether the autopilot must not expect a pose near the one that was sent last."""
        last = self._sent
        if last is None:
            return False
        return now_ns - last.at_ns > POSE_TIMEOUT_NS or _estimate_of(pose) != (last.resets, last.track_id)

    def _increment_reset_counter(self) -> None:
        """Increment it with a change, once until a pose is sent."""
        if not self._incremented:
            self.reset_counter = (self.reset_counter + 1) % SEQUENCE
            self._incremented = True

    def _frame_of(self, pose: RelativePose) -> SentFrame:
        """The frame of a pose that the gate has accepted (`SentFrame`)."""
        frame, position, xyz_map_m = self.frame, self.autopilot.position, pose.xyz_map_m
        assert xyz_map_m is not None
        own_m = None if position is None else position.at(pose.stamp_ns, FIRST_POSITION_AGE_NS)
        own_yaw_rad, number = self._odom_axes_yaw_rad(pose), pose.map_number
        if frame is not None and number != frame.map_number and own_m is not None and own_yaw_rad is not None:
            frame = None if self._is_other(frame, xyz_map_m, own_m, own_yaw_rad) else replace(frame, map_number=number)
        yaw_rad = frame.yaw_rad if frame is not None and self.sends_yaw else own_yaw_rad or 0.0
        if frame is None:
            if self.frame is not None:
                self._increment_reset_counter()
            if own_m is None:
                return SentFrame(yaw_rad, np.zeros(3), anchored=False, map_number=number)
            return replace(SentFrame.through(yaw_rad, xyz_map_m, own_m), map_number=number)
        sent_m, anchored = frame.position(xyz_map_m), frame.anchored or own_m is not None
        if own_m is not None and not frame.anchored and np.linalg.norm(sent_m - own_m) > ECHO_M:
            self._increment_reset_counter()
            sent_m = own_m
        elif yaw_rad == frame.yaw_rad:
            return replace(frame, anchored=anchored)
        through = SentFrame.through(yaw_rad, xyz_map_m, sent_m)
        return replace(through, anchored=anchored, map_number=frame.map_number)

    def _is_other(self, frame: SentFrame, xyz_map_m: Array64, own_m: Array64, own_yaw_rad: float) -> bool:
        """Whether `map` is another one than that of the frame, by the autopilot's own position (3,) and axes."""
        if self.sends_yaw and abs(math.remainder(frame.yaw_rad - own_yaw_rad, math.tau)) > WRONG_COMPASS_RAD:
            return True
        return float(np.linalg.norm(frame.position(xyz_map_m) - own_m)) > FAR_M

    def _odom_axes_yaw_rad(self, pose: RelativePose) -> float | None:
        """Yaw of the autopilot's own axes in `map`: as learnt, with yaw if that is sharp, else by its attitude."""
        sigma_rad = math.inf if pose.odom_yaw_sigma_rad is None else pose.odom_yaw_sigma_rad
        unsharp = self.sends_yaw and sigma_rad > SHARP_RAD
        if unsharp or pose.odom_yaw_rad == self._other_boot_rad:
            pose = replace(pose, odom_yaw_rad=None)
        return odom_yaw_rad(pose, self.autopilot)

    def _reason(self, kind: PoseMessage, pose: RelativePose, now_ns: int) -> RejectReason | None:
        if kind == "landing_target":
            reason = reject_reason(pose, now_ns, self._limits)
        else:
            reason = gate_reason(pose, now_ns, self._limits, self._yaw)
            if reason is None and self._yaw == "none":
                reason = self._axes_reason(pose, now_ns)
        if reason is None and kind != "landing_target" and self.fusion.stopped:
            reason = RejectReason.REJECTED_BY_AUTOPILOT
        if reason is None and self._newest_ns is not None and pose.stamp_ns <= self._newest_ns:
            reason = RejectReason.NOT_NEWER
        return reason

    def _axes_reason(self, pose: RelativePose, now_ns: int) -> RejectReason | None:
        """Why the autopilot cannot use a position in the axes that were learnt.

        The first ATTITUDE after a silence shows a boot. While the body's yaw is measured, its difference from the
        autopilot's shows the error of its compass.
        """
        attitude = self.autopilot.attitude
        if attitude is None or now_ns - attitude.arrival_ns > MAX_ATTITUDE_AGE_NS:
            return RejectReason.NO_ATTITUDE
        if self._yaw_reset:
            return RejectReason.ODOM_YAW_RESET
        if pose.odom_yaw_rad is None or pose.odom_yaw_sigma_rad is None or pose.odom_yaw_rad == self._other_boot_rad:
            return RejectReason.ODOM_YAW
        by_compass_rad = odom_yaw_rad(replace(pose, odom_yaw_rad=None), self.autopilot)
        if by_compass_rad is not None:
            off_rad = math.remainder(by_compass_rad - pose.odom_yaw_rad, math.tau)
            return RejectReason.COMPASS if abs(off_rad) > WRONG_COMPASS_RAD else None
        return None

    def _message(self, kind: PoseMessage, pose: RelativePose) -> Any:
        if kind == "landing_target":
            return landing_target(pose)
        frame = self._next_frame
        assert frame is not None
        if self._yaw == "none":
            return self._position_message(kind, pose, frame)
        if kind == "odometry":
            return odometry(pose, frame, self.reset_counter, self._limits, self._profile)
        return vision_position_estimate(pose, frame, self.reset_counter)

    def _position_message(self, kind: PoseMessage, pose: RelativePose, frame: SentFrame) -> Any:
        attitude = self.autopilot.attitude if self._profile == "ardupilot" else None
        if kind == "odometry":
            return position_odometry(pose, frame, self.reset_counter, self._limits, attitude)
        assert attitude is not None  # PX4 has no VISION_POSITION_ESTIMATE
        return position_vision_estimate(pose, frame, self.reset_counter, attitude)


def _estimate_of(pose: RelativePose) -> tuple[int, int]:
    """The same for poses between which the estimate has not jumped."""
    return pose.resets, pose.track_id
