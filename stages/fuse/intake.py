"""Input checks of the fusion: finite numbers with plausible stamps. Invalid messages are counted by reason.

Now is the newest stamp received. A stamp far ahead of now is rejected, unless several consecutive messages have one.

Source: ours.
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from flow.message import Message
from stages.geometry.frames import Array64
from stages.geometry.se3 import is_covariance
from stages.messages import CueKind, DroneCue, DroneFix, RelativeRotation, VisualMotion

AHEAD_NS = 1_000_000_000
CUE_SIZE = {CueKind.POSITION: 3, CueKind.LEVEL_AND_HEIGHT: 2, CueKind.RANGE: 1, CueKind.HEIGHT: 1}
MAX_REJECTED_STAMPS = 5


class Intake:
    """Validates each message and keeps the time."""

    def __init__(self, lag_ns: int) -> None:
        """`lag_ns`: older messages are rejected."""
        self._lag_ns = lag_ns
        self._ahead = 0  # stamps far ahead, in a row
        self.now_ns: int | None = None
        self.rejected: Counter[str] = Counter()

    def is_valid(self, message: Message, what: str, *numbers: Array64) -> bool:
        """Whether a message is finite and its stamp plausible."""
        if not all(all(map(math.isfinite, v.ravel().tolist())) for v in numbers):  # small arrays
            self.rejected[f"{what}: not finite"] += 1
            return False
        if self.now_ns is not None and message.stamp_ns > self.now_ns + AHEAD_NS and self._ahead < MAX_REJECTED_STAMPS:
            self.rejected[f"{what}: from the future"] += 1
            return False
        if self.now_ns is not None and message.stamp_ns < self.now_ns - self._lag_ns:
            self.rejected[f"{what}: older than the lag"] += 1
            return False
        return True

    def is_covariance(self, covariance: Array64, what: str) -> bool:
        """Whether a matrix is a covariance: symmetric and positive definite."""
        if is_covariance(covariance):
            return True
        self.rejected[f"{what}: its covariance is not positive definite"] += 1
        return False

    def is_valid_fix(self, fix: DroneFix) -> bool:
        """Whether a LiDAR position can be used: also its covariance without that of its bias."""
        velocity = () if fix.velocity_vehicle_mps is None else (fix.velocity_vehicle_mps,)
        bias_m2 = np.zeros((3, 3)) if fix.bias_covariance_m2 is None else fix.bias_covariance_m2
        numbers = (fix.xyz_vehicle_m, fix.covariance_m2, bias_m2, *velocity)
        return self.is_valid(fix, "fix", *numbers) and self.is_covariance(fix.covariance_m2 - bias_m2, "fix")

    def is_valid_rotation(self, rotation: RelativeRotation) -> bool:
        """Whether the rotations by cameras can be used; a message without a match is not counted as rejected."""
        if not len(rotation.rotations):
            return False
        p, covariances = rotation.probabilities, rotation.covariances_rad2
        if not self.is_valid(rotation, "rotation", rotation.rotations, covariances, p):
            return False
        if not (p.min() > 0.0 and p.sum() <= 1.0 + 1e-9):
            self.rejected["rotation: its probabilities are not positive with a sum of at most 1"] += 1
            return False
        return all(self.is_covariance(covariance, "rotation") for covariance in covariances)

    def is_valid_visual_motion(self, motion: VisualMotion) -> bool:
        """Whether a motion by the drone's camera can be used."""
        direction = () if motion.direction_from is None else (motion.direction_from,)
        sigma_rad = np.array(motion.direction_sigma_rad or 0.0)
        return self.is_valid(motion, "visual motion", motion.R_from_to, motion.covariance_rad2, sigma_rad, *direction)

    def is_valid_cue(self, cue: DroneCue) -> bool:
        """Whether a cue can be used."""
        n, times = CUE_SIZE[cue.kind], np.array([cue.bias_time_s, cue.yaw_sigma_rad])
        covariances = cue.covariance_m2, cue.bias_covariance_m2
        if not self.is_valid(cue, "cue", cue.value_m, cue.reference_map_m, times, *covariances):
            return False
        if len(cue.value_m) != n or cue.bias_time_s <= 0.0 or any(C.shape != (n, n) for C in covariances):
            self.rejected["cue: not of its kind"] += 1
            return False
        return all(self.is_covariance(C, "cue") for C in covariances)

    def pass_time(self, stamp_ns: int) -> int | None:
        """The time after a stamp was received; None: the stamp is rejected."""
        if self.now_ns is not None and stamp_ns > self.now_ns + AHEAD_NS:
            self._ahead += 1
            if self._ahead <= MAX_REJECTED_STAMPS:
                return None
        self._ahead = 0
        self.now_ns = stamp_ns if self.now_ns is None else max(self.now_ns, stamp_ns)
        return self.now_ns
