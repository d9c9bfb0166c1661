"""The detector's candidates and a table of their states, so that one compiled call processes all of them.

Under trees there are hundreds of short-lived candidates, and each observation and each slice checks every one.

Source: ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from stages.detect.candidate import Candidate, Observation
from stages.detect.observations import Slice
from stages.geometry.frames import Array64
from stages.kernels.detect.candidate_table import NO_PULSE, OUTSIDE, TableArrays, count_pulses, nearest_rows

ROWS = 64  # initial size; the table grows
STATE = 9  # columns: position, velocity, variances


class CandidateTable:
    """Candidates in the order of their creation; `put` each again after a change."""

    def __init__(self) -> None:
        self._candidates: list[Candidate] = []
        self._rows: dict[int, int] = {}  # by number
        self._state = np.empty((ROWS, STATE))
        self._ns = np.empty((ROWS, 2), dtype=np.int64)
        self._promising = np.empty(ROWS, dtype=np.bool_)
        self._reacquired = np.empty(ROWS, dtype=np.bool_)
        self._found = np.empty((ROWS, 3), dtype=np.int64)  # results of the last slice, by row
        self._promising_ns = -1  # no promising candidate was observed later

    def __iter__(self) -> Iterator[Candidate]:
        return iter(self._candidates)

    def __len__(self) -> int:
        return len(self._candidates)

    def put(self, c: Candidate) -> None:
        """Add a candidate, or store its changed state."""
        row = self._rows.setdefault(c.number, len(self._candidates))
        if row == len(self._candidates):
            self._candidates.append(c)
            if row == len(self._promising):
                self._state, self._ns = np.resize(self._state, (2 * row, STATE)), np.resize(self._ns, (2 * row, 2))
                self._promising, self._reacquired = (
                    np.resize(self._promising, 2 * row),
                    np.resize(self._reacquired, 2 * row),
                )
                self._found = np.empty((2 * row, 3), dtype=np.int64)
        if c.is_promising:
            self._promising_ns = max(self._promising_ns, c.seen_ns)
        self._state[row] = (*c.xyz_m.tolist(), *c.velocity_mps.tolist(), *c.p)
        self._ns[row], self._promising[row], self._reacquired[row] = (
            (c.stamp_ns, c.seen_ns),
            c.is_promising,
            c.reacquired_at > 0,
        )

    def keep(self, kept: Iterable[Candidate]) -> None:
        """Remove all other candidates."""
        self._candidates, self._rows, self._promising_ns = [], {}, -1
        for c in kept:
            self.put(c)

    def best_fits(self, s: Observation) -> tuple[Candidate | None, Candidate | None]:
        """The most probable candidates for an observation, of the reacquired and of the others; None: none fits."""
        rows = len(self._candidates)
        if not rows:
            return None, None
        found = nearest_rows(self._state, self._ns, self._reacquired, rows, s.stamp_ns, s.xyz_map_m)
        reacquired, other = (self._candidates[row] if row >= 0 else None for row in found)
        return reacquired, other

    @property
    def arrays(self) -> TableArrays:
        """The candidates, as compiled functions take them."""
        return TableArrays(self._state, self._ns, self._reacquired, len(self._candidates), self._promising_ns)

    def has_promising_since(self, stamp_ns: int) -> bool:
        """Whether a promising candidate may have been observed at this time or later."""
        return self._promising_ns >= stamp_ns

    def rivals_of(self, c: Candidate, apart_m: float) -> Iterator[Candidate]:
        """The promising candidates that are another object: observed in alternation with `c`, `apart_m` away."""
        if not self.has_promising_since(c.first_ns):
            return
        for row in np.flatnonzero(self._promising[: len(self._candidates)]).tolist():
            other = self._candidates[row]
            if other.seen_ns >= c.first_ns and c.seen_ns >= other.first_ns and other.number != c.number:
                now_m = other.xyz_m + (c.stamp_ns - other.stamp_ns) * 1e-9 * other.velocity_mps
                if math.dist(now_m, c.xyz_m) > apart_m:
                    yield other

    def pass_throughs_of(
        self, part: Slice, origin_m: Array64, disc_m: float, most_variance: float
    ) -> Iterator[tuple[Candidate, int, int, bool]]:
        """(candidate, returns from its middle, pulses that passed, whether it is outside the fan), of a slice.

        Only promising candidates, recently observed, with a variance of at most `most_variance` [m^2], that a pulse
        came near or that the fan does not cover.
        """
        rows, pulses = len(self._candidates), part.pulses
        count = count_pulses(
            self._state, self._ns, self._promising, rows, *part.first, *part.last, part.axis, part.half_rad, origin_m,
            pulses.point_stamp_ns, pulses.direction_vehicle, pulses.range_m, disc_m, most_variance, self._found,
        )  # fmt: skip
        if not count:
            return
        for row, (status, returns, pass_throughs) in enumerate(self._found[:rows].tolist()):
            if status != NO_PULSE:
                yield self._candidates[row], returns, pass_throughs, status == OUTSIDE


def positions_of(candidates: Iterable[Candidate]) -> Array64:
    """Positions (n, 3) of candidates in the map frame."""
    return np.array([c.xyz_m for c in candidates]).reshape(-1, 3)
