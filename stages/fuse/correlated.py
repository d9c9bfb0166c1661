"""Variance inflation of measurements whose errors are correlated in time.

A Gauss-Markov error of time constant tau, sampled each dt, has correlation rho = exp(-dt / tau) between neighbours;
the mean of n samples has the information of n (1 - rho) / (1 + rho) independent ones. So each gets the variance

    R (1 + rho) / (1 - rho) = R coth(dt / 2 tau)

and a filter that assumes independence gathers no more information than there is. A bias that outlasts a flight
(calibration) does not average out at all: that share stays out of the filter and is added to its output.

Source: Bayley, Hammersley, The effective number of independent observations (1946); ours.
"""

from __future__ import annotations

import math

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
