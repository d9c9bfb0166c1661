"""Whether a cue is of the drone that the LiDAR follows: it must move as that does.

A constant offset says nothing, it is the cue's bias. Over spans of SPAN_NS in which the LiDAR sees the drone, the
change of the cue is compared with that of the drone:

    own        the change of what the cue would measure of the drone
    follows    no change: an object that follows the vehicle
    stands     minus the vehicle's displacement: an object that stands (POSITION only)
    flies      any change, FLIES_MPS an axis

A drone that hovers over its vehicle looks like another one that hovers: its cue is not used until it moves.

Source: Bar-Shalom, Li, Kirubarajan (2001), 11.6 (static multiple model); ours.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stages.geometry.frames import Array64

SPAN_NS, LONGEST_NS = 1_000_000_000, 3_000_000_000
FLIES_MPS = 3.0
OUTLIERS = 0.05  # share of spans that no hypothesis explains: a reflection begins or ends
DENSITY_M = 20.0  # density of those, an axis: 1 / DENSITY_M
PRIOR = np.array([0.7, 0.1, 0.1, 0.1])  # as outlier_probability of stages/cues/evidence.py
LEAST = 1e-4  # of each hypothesis, so that a change is noticed
CERTAIN, DENIED = 0.999, 0.5


class _Sample(NamedTuple):
    stamp_ns: int
    value_m: Array64
    own_m: Array64
    vehicle_m: Array64


class CueOwner:
    """Probabilities of the four hypotheses."""

    def __init__(self) -> None:
        self._probability: Array64 = PRIOR.copy()
        self._from: _Sample | None = None

    @property
    def certain(self) -> bool:
        """Whether the cue is of the drone."""
        return bool(self._probability[0] > CERTAIN)

    @property
    def denied(self) -> bool:
        """Whether the cue is of another object, more probably."""
        return bool(self._probability[0] < DENIED)

    def pause(self) -> None:
        """The LiDAR does not see the drone: the span ends."""
        self._from = None

    def add(
        self, stamp_ns: int, value_m: Array64, own_m: Array64, vehicle_m: Array64, change_m2: tuple[Array64, Array64]
    ) -> None:
        """Add a measurement `value_m` (n,), what it would be of the drone, and the vehicle's position (3,).

        `change_m2`: variances (n, n) of the difference of two measurements, and of their bias in one second.
        """
        now = _Sample(stamp_ns, value_m, own_m, vehicle_m)
        if self._from is None or stamp_ns - self._from.stamp_ns > LONGEST_NS:
            self._from = now
            return
        if stamp_ns - self._from.stamp_ns < SPAN_NS:
            return
        before, self._from = self._from, now
        dt_s, n = (stamp_ns - before.stamp_ns) * 1e-9, len(value_m)
        S = change_m2[0] + dt_s * change_m2[1]
        change_m = value_m - before.value_m
        stands_m = before.vehicle_m - vehicle_m if n == 3 else np.zeros(n)
        free = S + (FLIES_MPS * dt_s) ** 2 * np.eye(n)
        expected = (own_m - before.own_m, S), (np.zeros(n), S), (stands_m, S), (np.zeros(n), free)
        outlier = OUTLIERS * DENSITY_M**-n
        likelihood = [(1.0 - OUTLIERS) * _density(change_m - mean, C) + outlier for mean, C in expected]
        self._probability = np.maximum(self._probability * likelihood / (self._probability @ likelihood), LEAST)
        self._probability /= self._probability.sum()


def _density(off_m: Array64, S: Array64) -> float:
    return math.exp(-0.5 * float(off_m @ np.linalg.solve(S, off_m))) / math.sqrt(np.linalg.det(math.tau * S))
