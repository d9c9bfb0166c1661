"""Slow random errors of the drone's sensors.

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64


class Wander:
    """A first-order Gauss-Markov process, stationary from the start."""

    def __init__(self, sigma: Array64, time_s: float, rng: np.random.Generator) -> None:
        self._sigma, self._time_s, self._rng = sigma, time_s, rng
        self._value = sigma * rng.standard_normal(len(sigma))
        self._at_s: float | None = None

    def at(self, time_s: float) -> Array64:
        """The value at a time; times must not decrease."""
        if self._at_s is not None:
            keep = math.exp(-(time_s - self._at_s) / self._time_s)
            white = self._rng.standard_normal(len(self._sigma))
            self._value = keep * self._value + self._sigma * math.sqrt(1 - keep * keep) * white
        self._at_s = time_s
        return self._value
