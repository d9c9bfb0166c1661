"""Observations from pulses: the short, free-ended chords of one scan pass on one object, and its surroundings.

An observation is complete `DELAY_NS` after its chord, when the rotor has scanned its surroundings.

Source: ours; DESIGN, The graph: detect.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

import numpy as np

from stages.detect.candidate import Observation
from stages.detect.chords import ChordFinder
from stages.detect.isolation import LargeObjectMap, RecentPulses
from stages.geometry.frames import Array64
from stages.geometry.lidar_models import LidarProfile
from stages.geometry.trajectory import VehicleTrajectory
from stages.kernels.detect.observations import BIG, SMALL, kinds_of, merge_chords, positions_of_kind, round_and_rough
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


class _Chord(NamedTuple):
    stamp_ns: int  # middle
    last_ns: int  # last return
    row: Array64
    middle_m: tuple[float, ...]  # its middle


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

    def feed(self, slice_: Slice, trail: VehicleTrajectory, motion_known: bool) -> list[Observation]:
        """The observations that this slice completes, in order of time."""
        now_ns = int(slice_.pulses.point_stamp_ns[-1])
        self._recent.add(slice_.pulses, slice_.axis, slice_.half_rad, now_ns)
        self._find(slice_)
        if not self._waiting:
            return []
        ready = sorted((c for c in self._waiting if now_ns - c.last_ns >= DELAY_NS), key=lambda c: c.stamp_ns)
        self._waiting = [c for c in self._waiting if now_ns - c.last_ns < DELAY_NS]
        found: list[Observation] = []
        while ready:
            first = ready[0].middle_m
            near = [math.dist(c.middle_m, first) <= 1.2 * self._limits.span_m for c in ready]
            same = [c for c, is_near in zip(ready, near, strict=True) if is_near]
            found.append(self._observation(same, trail, motion_known))
            ready = [c for c, is_near in zip(ready, near, strict=True) if not is_near]
        return found

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
                self._waiting.append(_Chord((first_ns + last_ns) // 2, last_ns, rows[i], tuple(rows[i, :3].tolist())))

    def _observation(self, same: list[_Chord], trail: VehicleTrajectory, motion_known: bool) -> Observation:
        span_m = self._limits.span_m
        rows, stamp_ns = np.array([c.row for c in same]), same[0].stamp_ns
        R, t = trail.at(stamp_ns)
        middle, xyz_map_m, returns, range_m, extent_m = merge_chords(rows, R, t)
        round_chords, rough = round_and_rough(rows)
        since_ns = stamp_ns - (MEMORY_NS if motion_known else SHORT_MEMORY_NS)
        return Observation(
            stamp_ns=stamp_ns,
            xyz_map_m=xyz_map_m,
            vehicle_map_m=t,
            range_m=range_m,
            returns=returns,
            too_long=extent_m > 1.3 * span_m,
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
