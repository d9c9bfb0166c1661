"""Observations from pulses: the short, free-ended chords of one scan pass on one object, and its surroundings.

An observation is complete `DELAY_NS` after its chord, when the rotor has scanned its surroundings.

Source: ours; DESIGN, The graph: detect.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.detect.candidate import Observation
from stages.detect.chords import ChordFinder
from stages.detect.isolation import LargeObjectMap, RecentPulses
from stages.geometry.frames import Array64
from stages.geometry.lidar_models import LidarProfile
from stages.geometry.trajectory import VehicleTrajectory
from stages.kernels.detect.observations import (
    BIG,
    RANGE,
    SMALL,
    TALLY_0,
    X,
    Z,
    group_chords,
    kinds_of,
    observe,
    positions_of_kind,
)
from stages.kernels.sweep.pulses import HOLE, LONGEST, STEP
from stages.messages import SweptPulses

DELAY_NS = 4_000_000  # after its last return, the surroundings of an observation were scanned
MEMORY_NS = 3_000_000_000  # of large objects, when the vehicle's motion is known
SHORT_MEMORY_NS = 1_000_000_000  # and when it is not


class Slice(NamedTuple):
    """A slice's pulses, the cone around their directions, and where the vehicle was."""

    pulses: SweptPulses
    axis: Array64  # mean direction, unit
    half_rad: float
    first: tuple[Array64, Array64]  # R_map_vehicle, t_map_vehicle at the first pulse
    last: tuple[Array64, Array64]  # at the last


class ObservationLimits(NamedTuple):
    """Limits of an observation's position."""

    span_m: float
    lowest_rad: float  # over the LiDAR's horizon
    nearest_m: float
    furthest_m: float
    clear_m: float


class Observations(NamedTuple):
    """Observations of a slice, in order of time."""

    stamps_ns: NDArray[np.int64]  # (k,)
    rows: Array64  # (k, COLUMNS) as of `observe`
    vehicle_map_m: Array64  # (k, 3) position of the vehicle

    def one(self, k: int) -> Observation:
        """Observation number k."""
        range_m, large_object_m, returns, too_long, round_chords, rough = self.rows[k, RANGE:TALLY_0].tolist()
        return Observation(
            stamp_ns=int(self.stamps_ns[k]),
            xyz_map_m=self.rows[k, X : Z + 1],
            vehicle_map_m=self.vehicle_map_m[k],
            range_m=range_m,
            returns=int(returns),
            too_long=bool(too_long),
            round_chords=int(round_chords),
            rough_chords=int(rough),
            isolation=self.rows[k, TALLY_0:],
            large_object_m=large_object_m,
        )


class _Chord(NamedTuple):
    stamp_ns: int  # middle
    last_ns: int  # last return
    row: Array64


class ObservationFinder:
    """Finds observations in slices, which must be added in order of time."""

    def __init__(self, limits: ObservationLimits, profile: LidarProfile) -> None:
        self._limits, self._beam_spacing_rad = limits, profile.beam_spacing_rad
        span_m = limits.span_m
        self._chords = ChordFinder(LONGEST * span_m, STEP * span_m, HOLE * span_m, profile)
        self._large = LargeObjectMap()
        self._recent = RecentPulses()
        self._waiting: list[_Chord] = []
        self.hidden: Counter[str] = Counter()  # short chords that were not free at both ends

    def feed(self, slice_: Slice, trail: VehicleTrajectory, motion_known: bool) -> Observations | None:
        """The observations that this slice completes, in order of time."""
        now_ns = int(slice_.pulses.point_stamp_ns[-1])
        self._recent.add(slice_.pulses, slice_.axis, slice_.half_rad, now_ns)
        self._find(slice_)
        if not self._waiting:
            return None
        ready = sorted((c for c in self._waiting if now_ns - c.last_ns >= DELAY_NS), key=lambda c: c.stamp_ns)
        self._waiting = [c for c in self._waiting if now_ns - c.last_ns < DELAY_NS]
        return self._observations(ready, trail, motion_known) if ready else None

    def _find(self, slice_: Slice) -> None:
        limits, pulses = self._limits, slice_.pulses
        found = self._chords.feed(pulses)
        rows = found.rows
        if not len(rows):
            return
        kinds = np.empty(len(rows), dtype=np.int64)
        big, small, hidden = kinds_of(rows, pulses.origin_vehicle_m[2], *limits, kinds)
        if big:
            self._large.add(positions_of_kind(rows, kinds, BIG, big, *slice_.first), pulses.stamp_ns)
        if hidden:
            self.hidden["hidden at an end by something nearer"] += hidden
        if small:
            for i in np.nonzero(kinds == SMALL)[0].tolist():
                first_ns, last_ns = int(found.first_ns[i]), int(found.last_ns[i])
                self._waiting.append(_Chord((first_ns + last_ns) // 2, last_ns, rows[i]))

    def _observations(self, chords: list[_Chord], trail: VehicleTrajectory, motion_known: bool) -> Observations:
        """The observations of chords in order of time, one of each object."""
        limits, rows = self._limits, np.array([c.row for c in chords])
        groups = np.empty(len(rows), dtype=np.int64)
        count = group_chords(rows, 1.2 * limits.span_m, groups)
        numbers = groups.tolist()
        stamps_ns = np.array([chords[numbers.index(k)].stamp_ns for k in range(count)], dtype=np.int64)
        R, t = trail.at_each(stamps_ns)
        since_ns = stamps_ns - (MEMORY_NS if motion_known else SHORT_MEMORY_NS)
        found = observe(
            rows, groups, R, t, since_ns, limits.span_m, limits.clear_m, self._beam_spacing_rad,
            *self._recent.arrays, *self._large.arrays,
        )  # fmt: skip
        return Observations(stamps_ns, found, t)
