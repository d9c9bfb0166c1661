"""What the fusion lets in: finite numbers of this time. What is left out is counted by reason.

Now is the newest stamp heard. A stamp far ahead of now is a broken clock's, unless several in a row say so.

Source: ours.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from flow.message import Message
from stages.geometry.frames import Array64
from stages.geometry.se3 import is_covariance

AHEAD_NS = 1_000_000_000
BELIEVED = 5


class Intake:
    """Checks each message before it counts, and keeps the time."""

    def __init__(self, lag_ns: int) -> None:
        """`lag_ns`: what is older is of no use."""
        self._lag_ns = lag_ns
        self._ahead = 0  # stamps far ahead, in a row
        self.now_ns: int | None = None
        self.refused: Counter[str] = Counter()

    def sound(self, message: Message, what: str, *numbers: Array64) -> bool:
        """Whether a message is finite and of this time."""
        if not all(np.isfinite(v).all() for v in numbers):
            self.refused[f"{what}: not finite"] += 1
            return False
        if self.now_ns is not None and message.stamp_ns > self.now_ns + AHEAD_NS and self._ahead < BELIEVED:
            self.refused[f"{what}: from the future"] += 1
            return False
        if self.now_ns is not None and message.stamp_ns < self.now_ns - self._lag_ns:
            self.refused[f"{what}: older than the lag"] += 1
            return False
        return True

    def covariant(self, covariance: Array64, what: str) -> bool:
        """Whether a covariance is one."""
        if is_covariance(covariance):
            return True
        self.refused[f"{what}: its covariance is not positive definite"] += 1
        return False

    def pass_time(self, stamp_ns: int) -> int | None:
        """Now, after a stamp was heard; None: the stamp is not believed."""
        if self.now_ns is not None and stamp_ns > self.now_ns + AHEAD_NS:
            self._ahead += 1
            if self._ahead <= BELIEVED:
                return None
        self._ahead = 0
        self.now_ns = stamp_ns if self.now_ns is None else max(self.now_ns, stamp_ns)
        return self.now_ns
