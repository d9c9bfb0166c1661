"""Whether the poses that are sent move as the autopilot's own estimate does.

Displacements since a reference time are compared, because the autopilot's frame has another origin:

    | R_sent_map (p - p_0) - (x - x_0) | <= tolerance        p: position (map), x: the autopilot's position (odom)

R_sent_map turns `map` into the axes that positions are sent in. The tolerance is 3 sigma of both positions. They agree
once the drone has moved horizontally by twice the tolerance: then a pose of a static object, of another drone or in
axes that are 30 deg off exceeds it (2 sin(30 deg / 2) of the way is 1.04 tolerances).

While the autopilot flies by another source, its estimate is evidence. Once it flies on the poses, it contains them:
both then agree whatever they are, and the result is not used any more (`source_switch.py`).

Source: ours. The error of the autopilot's position is that of the simulated GPS (bias of 0.8 m with a time constant of
120 s, 0.15 m of noise), not measured on a real receiver; that of a pose is the limit of the gate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from links.mavlink.poses.autopilot_estimate import AutopilotEstimate
from links.mavlink.poses.sent_frame import SentFrame
from stages.geometry.frames import Array64
from stages.messages import RelativePose

AUTOPILOT_SIGMA_M = 0.5  # of the change of the autopilot's position error within REFERENCE_PERIOD_NS, by GPS
REFERENCE_PERIOD_NS = 20_000_000_000
AGREEMENT_VALID_NS = 60_000_000_000  # so long after the drone has moved they still count as agreeing


@dataclass(frozen=True, slots=True)
class _Reference:
    stamp_ns: int
    xyz_map_m: Array64
    xyz_odom_m: Array64
    track_id: int
    resets: int


class MotionAgreement:
    """Compares sent poses with LOCAL_POSITION_NED."""

    def __init__(self, pose_sigma_m: float) -> None:
        """`pose_sigma_m`: largest position sigma of a pose that is sent."""
        self.tolerance_m = 3.0 * math.hypot(AUTOPILOT_SIGMA_M, pose_sigma_m)
        self.least_m = 2.0 * self.tolerance_m
        self.disagreements = 0
        self._reference: _Reference | None = None
        self._agreed_ns: int | None = None

    def restart(self) -> None:
        """The autopilot has booted, or poses were not sent for a while."""
        self._reference = self._agreed_ns = None

    def add(self, pose: RelativePose, frame: SentFrame, autopilot: AutopilotEstimate) -> float | None:
        """Add a pose that was sent, and the autopilot's newest estimate; returns the distance [m] when it disagrees.

        `frame`: that it was sent in; only its axes count.
        """
        xyz_odom_m = None if autopilot.position is None else autopilot.position.at(pose.stamp_ns)
        if pose.xyz_map_m is None or xyz_odom_m is None:
            return None
        first = self._reference
        if first is None or pose.resets != first.resets or pose.track_id != first.track_id:
            self._agreed_ns = None
            self._start(pose, xyz_odom_m)
            return None
        moved_m = xyz_odom_m - first.xyz_odom_m
        off_m = float(np.linalg.norm(frame.R_sent_map @ (pose.xyz_map_m - first.xyz_map_m) - moved_m))
        if off_m > self.tolerance_m:
            self.disagreements += 1
            self._agreed_ns = None
            self._start(pose, xyz_odom_m)
            return off_m
        if float(np.linalg.norm(moved_m[:2])) >= self.least_m:
            self._agreed_ns = pose.stamp_ns
        if pose.stamp_ns - first.stamp_ns > REFERENCE_PERIOD_NS:
            self._start(pose, xyz_odom_m)
        return None

    def agrees(self, now_ns: int) -> bool:
        """Whether they have moved alike by `least_m` within the last minute, and have not disagreed since."""
        return self._agreed_ns is not None and now_ns - self._agreed_ns < AGREEMENT_VALID_NS

    def _start(self, pose: RelativePose, xyz_odom_m: Array64) -> None:
        assert pose.xyz_map_m is not None
        self._reference = _Reference(pose.stamp_ns, pose.xyz_map_m, xyz_odom_m, pose.track_id, pose.resets)
