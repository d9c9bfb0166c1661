"""How much less an error that lasts is worth: measured again within its time, it is much the same error.

A Gauss-Markov error of time constant tau, met each dt, has the correlation rho = exp(-dt / tau) from one to the next;
the mean of n is worth n (1 - rho) / (1 + rho) independent ones. So each is given the variance

    R (1 + rho) / (1 - rho) = R coth(dt / 2 tau)

and a filter that takes them for independent gathers no more than there is. Without it vanishing points 1 deg wrong
for 1 s gave a NEES of 25 (DESIGN). What lasts for longer than a flight, calibration, does not average out at all: that
share is left out of the filter and added to what is given out.

Source: Bayley, Hammersley, The effective number of independent observations (1946); ours.
"""

from __future__ import annotations

import math

MOST = 200.0  # a thousand a second are not worth less than this


def inflation(dt_s: float | None, lasts_s: float) -> float:
    """Factor for the variance of a measurement `dt_s` after the one before; None: it is the first."""
    if dt_s is None or lasts_s == 0.0:
        return 1.0
    return min(1.0 / math.tanh(max(dt_s, 1e-4) / (2.0 * lasts_s)), MOST)


class Worth:
    """The inflation of one kind of measurement, each counted from the one used before."""

    def __init__(self, lasts_s: float) -> None:
        self._lasts_s = lasts_s
        self._last_ns: int | None = None

    def factor(self, stamp_ns: int) -> float:
        """For a measurement that is used now; late ones count by their distance too."""
        dt_s = None if self._last_ns is None else abs(stamp_ns - self._last_ns) * 1e-9
        self._last_ns = stamp_ns if self._last_ns is None else max(stamp_ns, self._last_ns)
        return inflation(dt_s, self._lasts_s)
