"""The detector's candidates, and where each is in a table, so that one compiled call looks at all of them.

Under trees hundreds of things are followed for a moment, and each sighting and each slice asks about every one.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from stages.detect.candidate import Candidate, Sighting
from stages.detect.observations import Slice
from stages.geometry.frames import Array64
from stages.kernels.detect.candidate_table import ELSEWHERE, NOTHING, look_at_all, nearest_row

ROWS = 64  # at first; the table grows

STATE = 9


class Bank:
    """Candidates in the order in which they came; `put` each again when it has changed."""

    def __init__(self) -> None:
        self._candidates: list[Candidate] = []
        self._rows: dict[int, int] = {}  # by number
        self._state = np.empty((ROWS, STATE))
        self._ns = np.empty((ROWS, 2), dtype=np.int64)
        self._told = np.empty(ROWS, dtype=np.bool_)
        self._joined = np.empty(ROWS, dtype=np.bool_)
        self._found = np.empty((ROWS, 3), dtype=np.int64)  # of the last slice, by row

    def __iter__(self) -> Iterator[Candidate]:
        return iter(self._candidates)

    def __len__(self) -> int:
        return len(self._candidates)

    def put(self, c: Candidate) -> None:
        """A new one, or one that has changed."""
        row = self._rows.setdefault(c.number, len(self._candidates))
        if row == len(self._candidates):
            self._candidates.append(c)
            if row == len(self._told):
                self._state, self._ns = np.resize(self._state, (2 * row, STATE)), np.resize(self._ns, (2 * row, 2))
                self._told, self._joined = np.resize(self._told, 2 * row), np.resize(self._joined, 2 * row)
                self._found = np.empty((2 * row, 3), dtype=np.int64)
        self._state[row] = (*c.xyz_m.tolist(), *c.velocity_mps.tolist(), *c.p)
        self._ns[row], self._told[row], self._joined[row] = (c.stamp_ns, c.seen_ns), c.told, c.joined_at > 0

    def keep(self, kept: Iterable[Candidate]) -> None:
        """Forget all others."""
        self._candidates, self._rows = [], {}
        for c in kept:
            self.put(c)

    def fitting(self, s: Sighting, joined: bool = False) -> Candidate | None:
        """The candidate that a sighting is most likely of, of the joined or of the others; None: of none."""
        rows = len(self._candidates)
        row = nearest_row(self._state, self._ns, self._joined, rows, joined, s.stamp_ns, s.xyz_map_m)
        return self._candidates[row] if row >= 0 else None

    def looked_at(
        self, part: Slice, origin_m: Array64, now_ns: int, disc_m: float, most_variance: float
    ) -> Iterator[tuple[Candidate, int, int, bool]]:
        """(candidate, pulses that hit its middle, pulses that passed it, whether the fan is elsewhere) of a slice.

        Only of those told of, seen lately, and known to within `most_variance` [m^2]; not where no pulse was near one
        that the fan covers.
        """
        rows, pulses = len(self._candidates), part.pulses
        said = look_at_all(
            self._state, self._ns, self._told, rows, now_ns, part.R, part.t, part.axis, origin_m,
            pulses.direction_vehicle, pulses.range_m, disc_m, most_variance, self._found,
        )  # fmt: skip
        if not said:
            return
        for row, (where, hits, passes) in enumerate(self._found[:rows].tolist()):
            if where != NOTHING:
                yield self._candidates[row], hits, passes, where == ELSEWHERE


def places_of(candidates: Iterable[Candidate]) -> Array64:
    """Where some are (n, 3), in the local frame."""
    return np.array([c.xyz_m for c in candidates]).reshape(-1, 3)
