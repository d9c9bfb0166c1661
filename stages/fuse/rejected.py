"""Consecutive rejected measurements: when they agree with each other, the estimate is wrong.

Source: DESIGN, Fusion: restart after 8 mutually consistent rejections; ours: agreement by a line through them.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from stages.geometry.frames import Array64
from stages.geometry.se3 import mahalanobis2

ENOUGH = 8
LONGEST_NS = 3_000_000_000
AGREE = 3.0  # chi-square for each degree of freedom


class Rejected:
    """The last rejected measurements, with their residuals."""

    def __init__(self) -> None:
        self._off: deque[tuple[int, Array64, Array64]] = deque(maxlen=ENOUGH)

    def __len__(self) -> int:
        return len(self._off)

    def clear(self) -> None:
        """A measurement was accepted: start over."""
        self._off.clear()

    def add(self, stamp_ns: int, off: Array64, covariance: Array64) -> bool:
        """Add a rejected measurement with its residual `off` (3,); True: enough of them lie on a line in time.

        A repeated stamp counts once.
        """
        if any(stamp_ns == ns for ns, _, _ in self._off):
            return False
        self._off.append((stamp_ns, off, covariance))
        while self._off[0][0] < stamp_ns - LONGEST_NS:
            self._off.popleft()
        if len(self._off) < ENOUGH:
            return False
        t = np.array([(ns - stamp_ns) * 1e-9 for ns, _, _ in self._off])
        y = np.array([e for _, e, _ in self._off])
        A = np.column_stack([np.ones(len(t)), t])
        left = y - A @ np.linalg.solve(A.T @ A, A.T @ y)
        chi2 = sum(mahalanobis2(left[i], C) for i, (_, _, C) in enumerate(self._off))
        return bool(chi2 <= AGREE * 3 * (ENOUGH - 2))
