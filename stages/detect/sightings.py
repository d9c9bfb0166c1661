"""From pulses to sightings: the short, free-ended chords of one look on one thing, and what was measured around it.

A sighting is complete when the rotor has gone on: what stands around a place is known `DELAY_NS` later.

Source: ours; DESIGN, The graph: detect.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.compiled import compiled
from stages.detect import chords as chord
from stages.detect.candidate import Sighting
from stages.detect.chords import ChordFinder
from stages.detect.surroundings import TALLY, BigThings, look_around
from stages.geometry import Array64
from stages.messages import SweptPulses
from stages.pulses import HOLE, LONGEST, STEP, middle_ns

BEAM_SPACING_RAD = math.radians(2.0)  # between two lasers of a VLP-16
WINDOW_NS = 8_600_000  # what is kept: 31 deg of a rotor at 600 rpm and the slice that is begun
MOST_SLICES = 16  # of them
DELAY_NS = 3_300_000  # after which what stands around a sighting has been seen
MEMORY_NS = 3_000_000_000  # of big things, when the vehicle tells how it moves
SHORT_MEMORY_NS = 1_000_000_000  # when it does not
NONE, BIG, SMALL, HIDDEN = range(4)  # kinds of chords
BALL_BULGE_PER_M = (1.2, 9.0)  # 1 / (2 radius), with what a beam's width adds
BALL_ROUGH_M = 0.02


class Slice(NamedTuple):
    """A packet's pulses, or those of a few in a row, and where the vehicle was."""

    pulses: SweptPulses
    R: Array64  # R_local_vehicle, t_local_vehicle
    t: Array64
    axis: Array64  # mean direction, unit


class Limits(NamedTuple):
    """Where a sighting may be."""

    span_m: float
    lowest_rad: float  # over the LiDAR's horizon
    nearest_m: float
    furthest_m: float
    clear_m: float


class _Chord(NamedTuple):
    found_ns: int  # the end of the slice it was found in
    row: Array64
    place_m: tuple[float, ...]  # its middle
    stamp_ns: int


class SightingFinder:
    """Feed it slices in order of time; it keeps the last few, and where big things stand."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        span_m = limits.span_m
        self._chords = ChordFinder(LONGEST * span_m, STEP * span_m, HOLE * span_m)
        self._big = BigThings()
        self._slices: deque[Slice] = deque(maxlen=MOST_SLICES)
        self._lately = Lately()
        self._waiting: list[_Chord] = []
        self.hidden: Counter[str] = Counter()  # short chords that were not free at both ends

    def feed(self, part: Slice, motion_known: bool) -> list[Sighting]:
        """The sightings that are complete with this slice."""
        now_ns = int(part.pulses.point_stamp_ns[-1])
        while self._slices and now_ns - self._slices[0].pulses.point_stamp_ns[-1] > WINDOW_NS:
            self._slices.popleft()
        self._slices.append(part)
        self._lately.add(part.pulses, now_ns)
        self._find(part, now_ns)
        if not self._waiting or now_ns - self._waiting[0].found_ns < DELAY_NS:
            return []
        ready = [c for c in self._waiting if now_ns - c.found_ns >= DELAY_NS]
        self._waiting = self._waiting[len(ready) :]
        found: list[Sighting] = []
        while ready:
            first = ready[0].place_m
            near = [math.dist(c.place_m, first) <= 1.2 * self._limits.span_m for c in ready]
            found.append(self._sighting([c for c, same in zip(ready, near, strict=True) if same], motion_known))
            ready = [c for c, same in zip(ready, near, strict=True) if not same]
        return found

    def _find(self, part: Slice, now_ns: int) -> None:
        limits, pulses = self._limits, part.pulses
        found = self._chords.feed(pulses)
        rows = found.rows
        if not len(rows):
            return
        kinds = kinds_of(rows, pulses.origin_vehicle_m[2], *limits)
        if (big := kinds == BIG).any():
            self._big.add(rows[big, :3] @ part.R.T + part.t, pulses.stamp_ns)
        self.hidden["hidden at an end by something nearer"] += int(np.count_nonzero(kinds == HIDDEN))
        for i in np.nonzero(kinds == SMALL)[0].tolist():
            middle_ns = int(found.first_ns[i] + found.last_ns[i]) // 2
            self._waiting.append(_Chord(now_ns, rows[i], tuple(rows[i, :3].tolist()), middle_ns))

    def _sighting(self, same: list[_Chord], motion_known: bool) -> Sighting:
        span_m = self._limits.span_m
        rows = np.array([c.row for c in same])
        hits, stamp_ns = rows[:, chord.COUNT], same[0].stamp_ns
        middle = hits @ rows[:, :3] / hits.sum()
        then = min(self._slices, key=lambda s: abs(middle_ns(s.pulses) - stamp_ns))
        range_m = float(rows[:, chord.RANGE].mean())
        local = then.R @ middle + then.t
        balls, rugged = round_and_rugged(rows)
        extent_m = max(float(np.linalg.norm(np.ptp(rows[:, :3], axis=0))), float(rows[:, chord.LENGTH].max()))
        since_ns = stamp_ns - (MEMORY_NS if motion_known else SHORT_MEMORY_NS)
        return Sighting(
            stamp_ns=stamp_ns,
            xyz_local_m=local,
            vehicle_local_m=then.t,
            range_m=range_m,
            hits=int(hits.sum()),
            too_long=extent_m > 1.3 * span_m,
            balls=balls,
            rugged=rugged,
            around=self._around(middle, range_m),
            big_m=self._big.nearest_m(local, 1.1 * span_m, self._limits.clear_m, since_ns),
        )

    def _around(self, middle_m: Array64, range_m: float) -> Array64:
        """What the last slices measured about a place of the vehicle frame: (TALLY,)."""
        span_m = self._limits.span_m
        close_m = max(2.4 * span_m, 1.15 * BEAM_SPACING_RAD * range_m)  # two beams wide at least
        outer_m = max(self._limits.clear_m, 1.5 * BEAM_SPACING_RAD * range_m)
        return self._lately.around(middle_m, 0.3 * span_m, 1.1 * span_m, close_m, outer_m, 0.5)


class Lately:
    """The last slices' pulses side by side, so that one compiled call looks at all of them."""

    def __init__(self) -> None:
        self._direction = np.empty((MOST_SLICES, 0, 3), dtype=np.float32)
        self._range_m = np.empty((MOST_SLICES, 0), dtype=np.float32)
        self._origin_m = np.zeros((MOST_SLICES, 3))
        self._sizes = np.zeros(MOST_SLICES, dtype=np.int64)  # 0: none, or too old
        self._end_ns = np.zeros(MOST_SLICES, dtype=np.int64)
        self._next = 0

    def add(self, pulses: SweptPulses, end_ns: int) -> None:
        """One more, whose last pulse left then; those before the window are forgotten."""
        n, k = pulses.range_m.size, self._next
        missing = n - self._range_m.shape[1]
        if missing > 0:
            self._direction = np.pad(self._direction, ((0, 0), (0, missing), (0, 0)))
            self._range_m = np.pad(self._range_m, ((0, 0), (0, missing)))
        self._direction[k, :n], self._range_m[k, :n] = pulses.direction_vehicle, pulses.range_m
        self._origin_m[k], self._sizes[k], self._end_ns[k] = pulses.origin_vehicle_m, n, end_ns
        self._sizes[end_ns - self._end_ns > WINDOW_NS] = 0
        self._next = (k + 1) % MOST_SLICES

    def around(
        self, centre_m: Array64, disc_m: float, inner_m: float, close_m: float, outer_m: float, depth_m: float
    ) -> Array64:
        """What they found around a place (3,) of the vehicle frame: (TALLY,); see `look_around`."""
        return look_around_all(
            self._direction, self._range_m, self._origin_m, self._sizes,
            centre_m, disc_m, inner_m, close_m, outer_m, depth_m,
        )  # fmt: skip


@compiled
def look_around_all(
    direction: NDArray[np.float32],
    range_m: NDArray[np.float32],
    origin_m: Array64,
    sizes: NDArray[np.int64],
    centre_m: Array64,
    disc_m: float,
    inner_m: float,
    close_m: float,
    outer_m: float,
    depth_m: float,
) -> Array64:
    """The tally (TALLY,) of slices (k, most, 3), (k, most), of each the first `sizes` (k,) pulses."""
    tally = np.zeros(TALLY, dtype=np.int64)
    for k in range(sizes.size):
        n = sizes[k]
        look_around(
            direction[k, :n], range_m[k, :n], origin_m[k], centre_m, disc_m, inner_m, close_m, outer_m, depth_m, tally
        )
    return tally.astype(np.float64)


@compiled
def kinds_of(
    rows: Array64,
    origin_z_m: float,
    span_m: float,
    lowest_rad: float,
    nearest_m: float,
    furthest_m: float,
    clear_m: float,
) -> NDArray[np.int64]:
    """What chords (n, COLUMNS) are of: BIG, SMALL and free at both ends, HIDDEN: small, not free, or NONE of these."""
    kinds = np.full(rows.shape[0], NONE)
    for i in range(rows.shape[0]):
        range_m = rows[i, chord.RANGE]
        if rows[i, chord.LONG] > 0.0:
            kinds[i] = BIG
        elif (
            rows[i, chord.Z] - origin_z_m > math.sin(lowest_rad) * range_m
            and nearest_m <= range_m <= furthest_m
            and rows[i, chord.LENGTH] <= LONGEST * span_m
        ):
            kinds[i] = SMALL if rows[i, chord.FREE] == 2.0 else HIDDEN
    return kinds


@compiled
def round_and_rugged(rows: Array64) -> tuple[int, int]:
    """How many chords (n, COLUMNS) with five or more returns bulge as smoothly as a ball, and how many do not."""
    low, high = BALL_BULGE_PER_M
    balls = rugged = 0
    for i in range(rows.shape[0]):
        if rows[i, chord.COUNT] < 5:
            continue
        if (
            low < rows[i, chord.BULGE] < high
            and rows[i, chord.ROUGH] < BALL_ROUGH_M
            and rows[i, chord.GAPS] <= 1
            and rows[i, chord.DEPTH] > 0.2 * rows[i, chord.LENGTH]
        ):
            balls += 1
        else:
            rugged += 1
    return balls, rugged
