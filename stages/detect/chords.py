"""Chords: runs of one laser's consecutive returns at similar ranges, each the crossing of one object by a beam.

A laser fires every 0.1 to 0.4 deg along its cone. A chord ends where the next pulses return nothing or something
farther (the end is free), or something nearer (the end is hidden). A drone gives chords that are short and free at both
ends; walls, ground and trunks give long ones. A chord is reported as soon as it has ended or is longer than any drone.
A chord ends once the beam is a hole's width past it. That is many pulses beside a near object, as a rain drop, and
farther returns among them are of chords of their own.

Source: ours; DESIGN, "free-space evidence ... evaluated as data arrives".
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.geometry.lidar_models import LidarProfile
from stages.kernels.detect.chords import DEPTHS, MEMORY, find_chords
from stages.messages import SweptPulses

COLUMNS = 14
# A laser fires once in a firing sequence. After a longer pause packets are lost, and it points in another direction.
GAP_SEQUENCES = 2.7


class Chords(NamedTuple):
    """Chords of a slice: (n, COLUMNS) and the times (n,) of their first and last hit."""

    rows: Array64  # X..Z middle in the vehicle frame, RANGE, LENGTH along, DEPTH in range [m], COUNT of hits, ...
    first_ns: NDArray[np.int64]
    last_ns: NDArray[np.int64]


class ChordFinder:
    """Finds chords in slices, which must be added in order of time."""

    def __init__(self, longest_m: float, jump_m: float, hole_m: float, profile: LidarProfile) -> None:
        """`longest_m`: longer chords are no drone. A range step of `jump_m` or a gap of `hole_m` ends a chord."""
        self._longest_m, self._jump_m, self._hole_m = longest_m, jump_m, hole_m
        self._gap_ns = round(GAP_SEQUENCES * profile.sequence_ns)
        self._open = np.zeros((profile.lasers, DEPTHS, MEMORY))
        self._times = np.zeros((profile.lasers, DEPTHS, 2), dtype=np.int64)
        self._newest = np.zeros(profile.lasers, dtype=np.int64), np.full(profile.lasers, math.nan)

    def feed(self, pulses: SweptPulses) -> Chords:
        """The chords that ended, or became too long, in this slice."""
        n = pulses.range_m.size + self._times[..., 0].size
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
            self._gap_ns,
            self._open,
            self._times,
            self._newest,
            rows,
            times,
        )
        return Chords(rows[:count], times[:count, 0], times[:count, 1])
