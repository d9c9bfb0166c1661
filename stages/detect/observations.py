"""Observations from pulses: the short, free-ended chords of one scan pass on one object, and its surroundings.

An observation is complete `DELAY_NS` after its chord, when the rotor has scanned its surroundings.

Source: ours; DESIGN, The graph: detect.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from typing import NamedTuple

import numpy as np

from stages.detect.candidate import Observation
from stages.detect.chords import ChordFinder
from stages.detect.isolation import MAX_SLICES, LargeObjectMap, RecentPulses
from stages.geometry.frames import Array64
from stages.geometry.lidar_models import LidarProfile
from stages.kernels.detect.observations import BIG, SMALL, kinds_of, merge_chords, positions_of_kind, round_and_rough
from stages.kernels.detect.pulse_buffer import WINDOW_NS
from stages.kernels.sweep.pulses import HOLE, LONGEST, STEP
from stages.messages import SweptPulses

DELAY_NS = 3_300_000  # after which the surroundings of an observation were scanned
MEMORY_NS = 3_000_000_000  # of large objects, when the vehicle's motion is known
SHORT_MEMORY_NS = 1_000_000_000  # and when it is not


class Slice(NamedTuple):
    """A packet's pulses, or those of a few in a row, and where the vehicle was."""

    pulses: SweptPulses
    R: Array64  # R_map_vehicle, t_map_vehicle
    t: Array64
    axis: Array64  # mean direction, unit


class ObservationLimits(NamedTuple):
    """Limits of an observation's position."""

    span_m: float
    lowest_rad: float  # over the LiDAR's horizon
    nearest_m: float
    furthest_m: float
    clear_m: float


class _Kept(NamedTuple):
    middle_ns: int
    end_ns: int
    R: Array64
    t: Array64


class _Chord(NamedTuple):
    found_ns: int  # end of the slice that completed it
    row: Array64
    middle_m: tuple[float, ...]  # its middle
    stamp_ns: int


class ObservationFinder:
    """Finds observations in slices, which must be added in order of time."""

    def __init__(self, limits: ObservationLimits, profile: LidarProfile) -> None:
        self._limits, self._beam_spacing_rad = limits, profile.beam_spacing_rad
        span_m = limits.span_m
        self._chords = ChordFinder(LONGEST * span_m, STEP * span_m, HOLE * span_m, profile)
        self._large = LargeObjectMap()
        self._slices: deque[_Kept] = deque(maxlen=MAX_SLICES)
        self._recent = RecentPulses()
        self._waiting: list[_Chord] = []
        self.hidden: Counter[str] = Counter()  # short chords that were not free at both ends

    def feed(self, slice_: Slice, motion_known: bool) -> list[Observation]:
        """The observations that this slice completes."""
        now_ns = int(slice_.pulses.point_stamp_ns[-1])
        while self._slices and now_ns - self._slices[0].end_ns > WINDOW_NS:
            self._slices.popleft()
        self._slices.append(_Kept(slice_.pulses.middle_ns, now_ns, slice_.R, slice_.t))
        self._recent.add(slice_.pulses, slice_.axis, now_ns)
        self._find(slice_, now_ns)
        if not self._waiting or now_ns - self._waiting[0].found_ns < DELAY_NS:
            return []
        ready = [c for c in self._waiting if now_ns - c.found_ns >= DELAY_NS]
        self._waiting = self._waiting[len(ready) :]
        found: list[Observation] = []
        while ready:
            first = ready[0].middle_m
            near = [math.dist(c.middle_m, first) <= 1.2 * self._limits.span_m for c in ready]
            found.append(self._observation([c for c, same in zip(ready, near, strict=True) if same], motion_known))
            ready = [c for c, same in zip(ready, near, strict=True) if not same]
        return found

    def _find(self, slice_: Slice, now_ns: int) -> None:
        limits, pulses = self._limits, slice_.pulses
        found = self._chords.feed(pulses)
        rows = found.rows
        if not len(rows):
            return
        kinds = np.empty(len(rows), dtype=np.int64)
        big, small, hidden = kinds_of(rows, pulses.origin_vehicle_m[2], *limits, kinds)
        if big:
            self._large.add(positions_of_kind(rows, kinds, BIG, big, slice_.R, slice_.t), pulses.stamp_ns)
        if hidden:
            self.hidden["hidden at an end by something nearer"] += hidden
        if small:
            for i in np.nonzero(kinds == SMALL)[0].tolist():
                middle_ns = int(found.first_ns[i] + found.last_ns[i]) // 2
                self._waiting.append(_Chord(now_ns, rows[i], tuple(rows[i, :3].tolist()), middle_ns))

    def _observation(self, same: list[_Chord], motion_known: bool) -> Observation:
        span_m = self._limits.span_m
        rows, stamp_ns = np.array([c.row for c in same]), same[0].stamp_ns
        away_ns = [abs(kept.middle_ns - stamp_ns) for kept in self._slices]
        then = self._slices[away_ns.index(min(away_ns))]
        middle, xyz_map_m, returns, range_m, extent_m = merge_chords(rows, then.R, then.t)
        round_chords, rough = round_and_rough(rows)
        since_ns = stamp_ns - (MEMORY_NS if motion_known else SHORT_MEMORY_NS)
        return Observation(
            stamp_ns=stamp_ns,
            xyz_map_m=xyz_map_m,
            vehicle_map_m=then.t,
            range_m=range_m,
            returns=returns,
            too_long=extent_m > 1.3 * span_m,
            extent_m=extent_m,
            round_chords=round_chords,
            rough_chords=rough,
            isolation=self._isolation(middle, range_m),
            large_object_m=self._large.nearest_m(xyz_map_m, 1.1 * span_m, self._limits.clear_m, since_ns),
        )

    def _isolation(self, middle_m: Array64, range_m: float) -> Array64:
        """Sector counts (TALLY,) of the last slices around a position in the vehicle frame."""
        span_m = self._limits.span_m
        close_m = max(2.4 * span_m, 1.15 * self._beam_spacing_rad * range_m)  # at least two beam spacings wide
        outer_m = max(self._limits.clear_m, 1.5 * self._beam_spacing_rad * range_m)
        return self._recent.isolation(middle_m, 0.3 * span_m, 1.1 * span_m, close_m, outer_m, 0.5)
