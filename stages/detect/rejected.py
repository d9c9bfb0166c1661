"""Rejected first observations: where static ones are, how frequent false returns are, and how many of each kind.

Most observations are of edges, leaves and wires. Those that fit no candidate and are not promising by themselves are
rejected by one compiled call for all of a slice.

Source: ours.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.detect.candidate import Alternative, Observation
from stages.detect.candidate_table import CandidateTable
from stages.detect.isolation import LargeObjectMap
from stages.detect.observations import Observations
from stages.detect.trained.existence import FalseReturns
from stages.detect.trained.features import FEATURES, FREE_SPACE
from stages.detect.trained.model import ALTERNATIVES, DetectorModel
from stages.geometry.frames import Array64
from stages.kernels.detect.first_observations import Judged, near_rejected, reject_first

STATIC = ALTERNATIVES.index(Alternative.STATIC)
NO_FEATURES, FREE_SPACE_FEATURES = np.empty(0, dtype=np.int64), np.array(FREE_SPACE)  # that an ablation leaves out


class Criteria(NamedTuple):
    """What a first observation is rejected by."""

    model: DetectorModel
    follow_up_nats: float  # log-odds from which it is promising
    span_m: float  # of the drone
    free_space: bool  # False: the measured surroundings are left out


class RejectedObservations:
    """Memory of rejected first observations."""

    def __init__(self) -> None:
        self.static_map = LargeObjectMap()
        self.false_returns = FalseReturns()
        self.kinds: Counter[str] = Counter()
        """Number of each alternative, since it was last reported."""

    def forget_positions(self) -> None:
        """Frame map has changed."""
        self.static_map = LargeObjectMap()

    def near(self, s: Observation, motion_known: bool, drone_moves: bool) -> tuple[bool, bool]:
        """See `near_rejected`."""
        return near_rejected(s.xyz_map_m, s.stamp_ns, motion_known, drone_moves, self.static_map.arrays)

    def add(self, s: Observation, alternative: Alternative) -> None:
        """Add one."""
        self.kinds[alternative.value] += 1
        self.false_returns.add(s.range_m, s.stamp_ns)
        if alternative is Alternative.STATIC:
            self.static_map.add(s.xyz_map_m[None], s.stamp_ns)

    def add_first(
        self,
        s: Observations,
        begin: int,
        motion_known: NDArray[np.bool_],
        drone_moves: NDArray[np.bool_],
        table: CandidateTable,
        static_m: Array64,
        criteria: Criteria,
    ) -> tuple[int, list[float], Array64]:
        """Add those from `begin` on, up to one that may continue or begin a candidate; see `reject_first`.

        Returns the index of that one, log-odds and features of all observations, valid for those added.
        """
        n = len(s.stamps_ns)
        judged = Judged(np.empty(n), np.empty(n, dtype=np.int64), np.empty((n, len(FEATURES))))
        left = reject_first(
            begin, s.stamps_ns, s.rows, motion_known, drone_moves, table.arrays, static_m, self.static_map.arrays,
            self.false_returns.arrays, criteria.model.tables(compared=False), criteria.span_m, criteria.follow_up_nats,
            NO_FEATURES if criteria.free_space else FREE_SPACE_FEATURES, STATIC, judged,
        )  # fmt: skip
        alternatives: list[int] = judged.alternative[begin:left].tolist()
        self.kinds.update(ALTERNATIVES[k].value for k in alternatives)
        return left, judged.log_odds.tolist(), judged.features
