"""Compiled functions of a candidate's existence: the rate of false returns by range, and the log-odds of a birth.

Source: see `stages/detect/trained/existence.py`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

SHELL_M = 4.0  # of the range histogram of false returns
SHELLS = 32
MEMORY_S = 6.0  # false returns count for this long (1 / e)
BIRTHS_PER_S = 0.02  # assumed: one object appears in the sky in 50 s
LEAST_FALSE_PER_S = 0.05  # false returns of a clear sky, per shell: the prior of the histogram


class FalseReturnHistogram(NamedTuple):
    """False returns by range, faded to the time of the newest."""

    counts: Array64  # (SHELLS,)
    newest_ns: NDArray[np.int64]  # (1,)


@compiled
def _shell(range_m: float) -> int:
    return min(int(range_m / SHELL_M), SHELLS - 1)


@compiled
def add_false_return(histogram: FalseReturnHistogram, range_m: float, stamp_ns: int) -> None:
    """Count one."""
    counts, newest_ns = histogram.counts, histogram.newest_ns
    if stamp_ns > newest_ns[0]:
        counts *= math.exp(-(stamp_ns - newest_ns[0]) * 1e-9 / MEMORY_S)
        newest_ns[0] = stamp_ns
    counts[_shell(range_m)] += 1.0


@compiled
def false_returns_per_s(histogram: FalseReturnHistogram, range_m: float, stamp_ns: int) -> float:
    """Rate [1/s] in the shell at this range, at least LEAST_FALSE_PER_S."""
    fading = math.exp(-max(stamp_ns - histogram.newest_ns[0], 0) * 1e-9 / MEMORY_S)
    return LEAST_FALSE_PER_S + histogram.counts[_shell(range_m)] * fading / MEMORY_S


@compiled
def birth_nats(false_per_s: float) -> float:
    """Log-odds after the first observation; the volume cancels."""
    return math.log(BIRTHS_PER_S / SHELLS / false_per_s)
