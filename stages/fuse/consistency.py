"""Consistency of measurements: variance inflation for errors correlated in time, and mutually consistent rejections.

A Gauss-Markov error of time constant tau, sampled each dt, has correlation rho = exp(-dt / tau) between neighbours;
the mean of n samples has the information of n (1 - rho) / (1 + rho) independent ones. So each sample gets the variance

    R (1 + rho) / (1 - rho) = R coth(dt / 2 tau)

and a filter that assumes independence is not overconfident. A bias that is constant over a flight (calibration) does
not average out at all: that share of the variance is not given to the filter but added to its output.

When consecutive rejected measurements agree with each other, the estimate is wrong and is reset.

Source: Bayley, Hammersley, The effective number of independent observations (1946); DESIGN, Fusion: restart after 8
mutually consistent rejections; ours: agreement by a line through them.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from stages.geometry.frames import Array64
from stages.geometry.se3 import mahalanobis2

MOST = 200.0  # bound of the factor


def inflation(dt_s: float | None, time_constant_s: float) -> float:
    """Variance factor of a measurement `dt_s` after the one before; None: the first."""
    if dt_s is None or time_constant_s == 0.0:
        return 1.0
    return min(1.0 / math.tanh(max(dt_s, 1e-4) / (2.0 * time_constant_s)), MOST)


class InformationInflation:
    """Variance factor of one kind of measurement, by the time since the one used before."""

    def __init__(self, time_constant_s: float) -> None:
        self._time_constant_s = time_constant_s
        self._last_ns: int | None = None

    def factor(self, stamp_ns: int) -> float:
        """Factor for a measurement that is used now; a late one counts by its distance in time."""
        dt_s = None if self._last_ns is None else abs(stamp_ns - self._last_ns) * 1e-9
        self._last_ns = stamp_ns if self._last_ns is None else max(stamp_ns, self._last_ns)
        return inflation(dt_s, self._time_constant_s)


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
