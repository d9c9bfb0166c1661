"""Chords: how one beam crosses a thing. Each laser's returns, pulse after pulse, become runs with two ends.

A laser looks every 0.2 deg along its cone. Returns in a row at much the same range are one chord; it ends where the
pulses go on and return nothing or something farther (it is free there), or something nearer (who knows). A drone gives
chords that are short and free at both ends; walls, ground and trunks give long ones. Everything is done as pulses
arrive: a chord is told as soon as it has ended, or as soon as it is longer than any drone.

Source: ours; DESIGN, "free-space evidence ... evaluated as data arrives".
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.detect.chords import BEFORE, MEMORY, find_chords
from stages.messages import SweptPulses

COLUMNS = 14


class Chords(NamedTuple):
    """Chords of a slice: (n, COLUMNS) and the times (n,) of their first and last hit."""

    rows: Array64  # X..Z middle in the vehicle frame, RANGE, LENGTH along, DEPTH in range [m], COUNT of hits, ...
    first_ns: NDArray[np.int64]
    last_ns: NDArray[np.int64]


class ChordFinder:
    """Feed it slices in order of time."""

    def __init__(self, longest_m: float, jump_m: float, hole_m: float, lasers: int = 16) -> None:
        """`longest_m`: what is longer is no drone. A step in range of `jump_m`, a hole of `hole_m` end a chord."""
        self._longest_m, self._jump_m, self._hole_m = longest_m, jump_m, hole_m
        self._open = np.zeros((lasers, MEMORY))
        self._open[:, BEFORE] = math.nan
        self._times = np.zeros((lasers, 3), dtype=np.int64)

    def feed(self, pulses: SweptPulses) -> Chords:
        """The chords that ended, or became too long, in this slice."""
        n = pulses.range_m.size
        rows, times = np.empty((n, COLUMNS)), np.empty((n, 2), dtype=np.int64)
        count = find_chords(
            pulses.point_stamp_ns,
            pulses.direction_vehicle,
            pulses.range_m,
            pulses.laser,
            pulses.reflectivity,
            np.array(pulses.origin_vehicle_m),
            self._longest_m,
            self._jump_m,
            self._hole_m,
            self._open,
            self._times,
            rows,
            times,
        )
        return Chords(rows[:count], times[:count, 0], times[:count, 1])
