"""Probability that one object causes a candidate's observations (Bernoulli filter).

Recursively from the first return, in log-odds L, with kappa [1/m^3] the density of false observations per scan pass at
that range:

    birth           L = ln(births / kappa),  births: objects that appear in a scan pass, per m^3
    survival        P(exists) *= exp(-dt / LIFETIME_S)
    observation     L += ln(p_D N(innovation; S) / kappa)
    pass-throughs   L += ln(1 - p_D),  p_D = 1 - (1 - q)^pulses,  q: a pulse through the middle of a drone returns

kappa is measured by range over the last seconds (`FalseReturns`): observations that begin no candidate, also those of
static objects, and candidates that are not observed again. It is high in rain and near trees. An observation's returns
are the lower limit of its pulses in p_D.

Source: Ristic, Vo, Vo, Farina, "A tutorial on Bernoulli filters", IEEE TSP 61 (2013), Equations 22 to 28; ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.kernels.detect.existence import SHELL_M, SHELLS, FalseReturnHistogram, add_false_return, false_returns_per_s

PASS_S = 0.1  # between scan passes: 600 rpm
CERTAIN_NATS = 30.0  # limit of arithmetic
LIFETIME_S = 30.0  # assumed mean time that an object stays in view
RETURNS_AT_MIDDLE = 0.6  # of the pulses through the middle of a drone: assumed; the track estimates its own
RETURNS_TO_M = 35.0  # a dark drone returns them to this range, fewer by the inverse square beyond


class FalseReturns:
    """Rate of observations that belong to no candidate, by range: false returns, rain drops, leaves, static objects."""

    def __init__(self) -> None:
        self.arrays = FalseReturnHistogram(np.zeros(SHELLS), np.zeros(1, dtype=np.int64))

    def add(self, range_m: float, stamp_ns: int) -> None:
        """Count one."""
        add_false_return(self.arrays, range_m, stamp_ns)

    def per_s(self, range_m: float, stamp_ns: int) -> float:
        """Rate [1/s] in the shell at this range, at least LEAST_FALSE_PER_S."""
        return false_returns_per_s(self.arrays, range_m, stamp_ns)


def survived_nats(nats: float, dt_s: float) -> float:
    """Log-odds after dt_s without information."""
    exists = 1.0 / (1.0 + math.exp(-max(min(nats, CERTAIN_NATS), -CERTAIN_NATS))) * math.exp(-dt_s / LIFETIME_S)
    return math.log(exists / (1.0 - exists))


def observed_nats(distance2_m2: float, variance_m2: float, range_m: float, returns: int, false_per_s: float) -> float:
    """Log ratio of an observation at this squared distance from a prediction with this variance on each axis.

    `returns`: of the observation; a lower limit of the pulses of p_D, so that the ratio is one, too.
    """
    volume_m3 = 2.0 * math.pi * range_m**2 * SHELL_M
    expected = false_per_s * PASS_S / volume_m3
    density = math.exp(-0.5 * distance2_m2 / variance_m2) / (2.0 * math.pi * variance_m2) ** 1.5
    return math.log(max(detection_probability(range_m, max(returns, 1)) * density, 1e-12) / expected)


def passed_nats(range_m: float, pulses: float) -> float:
    """Log ratio of a scan pass whose pulses through the middle all passed."""
    return pulses * math.log(1.0 - _returned(range_m))


def detection_probability(range_m: float, pulses: float) -> float:
    """Probability that one of `pulses` through the middle of a drone returns."""
    return 1.0 - (1.0 - _returned(range_m)) ** pulses


def _returned(range_m: float) -> float:
    return RETURNS_AT_MIDDLE * min(1.0, (RETURNS_TO_M / range_m) ** 2)
