"""Compiled rejection of first observations. Most observations are of edges, leaves and wires: they begin no candidate.

Source: see `stages/detect/rejected.py`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.detect.candidate import neighbour_score, return_count_nats
from stages.kernels.detect.candidate_table import TableArrays, first_within, nearest_rows
from stages.kernels.detect.existence import FalseReturnHistogram, add_false_return, birth_nats, false_returns_per_s
from stages.kernels.detect.isolation import SECTORS, MarkedCells, mark_cells, nearest_marked
from stages.kernels.detect.model import ModelTables, evaluate
from stages.kernels.detect.observations import LARGE_OBJECT, RANGE, RETURNS, ROUGH, ROUND, TALLY_0, TOO_LONG, X, Z

PULSE_RAD = math.radians(0.2)  # between two pulses of a laser: VLP-16, 600 rpm
NONE_M = 4.0  # written where no large object is near
STATIC_M = 0.6  # a static object is observed again within this distance
NEAR_REJECTED_M = 1.5  # a rejected object this close,
NEAR_REJECTED_NS = 20_000_000_000  # and this recent, makes a new candidate less probable
NEAR_REJECTED_UNKNOWN_NS = NEAR_REJECTED_NS // 20  # the same while the vehicle's motion is not known
REVISITED_M = 0.5  # the same position


@compiled
def first_features(
    row: Array64, span_m: float, false_per_s: float, near_rejected: bool, revisited: bool, features: Array64
) -> None:
    """Fill features (n,), as `features_of` a candidate with a single observation, a row of `observe`."""
    counted = np.zeros(SECTORS)
    occupied, measured = neighbour_score(row[TALLY_0:], counted)
    free = 0
    for k in range(SECTORS):
        free += counted[k] >= 1.0
    known = (
        row[RANGE],
        birth_nats(false_per_s),
        false_per_s,
        1.0,
        row[RETURNS],
        row[RETURNS] * PULSE_RAD * row[RANGE] / span_m,
        return_count_nats(row[RETURNS], row[RANGE]),
        float(free),
        counted.min(),
        occupied,
        1.0 * (measured and occupied == 0.0),
        min(row[LARGE_OBJECT], NONE_M),
        1.0 * math.isfinite(row[LARGE_OBJECT]),
        row[TOO_LONG],
        (row[ROUGH] + 1.0) / (row[ROUND] + row[ROUGH] + 2.0),  # by Laplace's rule of succession
        math.nan,
        math.nan,
        0.0,
        0.0,
        math.nan,
        0.0,
        math.nan,
        math.nan,
        0.0,
        1.0 * near_rejected,
        1.0 * revisited,
    )
    features[:] = math.nan
    for k, value in enumerate(known):
        features[k] = value


class Judged(NamedTuple):
    """Results of the model for k observations."""

    log_odds: Array64  # (k,)
    alternative: NDArray[np.int64]  # (k,)
    features: Array64  # (k, n)


@compiled
def near_rejected(
    xyz_m: Array64, stamp_ns: int, motion_known: bool, drone_moves: bool, rejected: MarkedCells
) -> tuple[bool, bool]:
    """Whether a static object was rejected near a position (3,), and at it while the drone reports that it moves."""
    since_ns = stamp_ns - (NEAR_REJECTED_NS if motion_known else NEAR_REJECTED_UNKNOWN_NS)
    away_m = nearest_marked(xyz_m, rejected.cell_m, 0.0, NEAR_REJECTED_M, since_ns, rejected.key, rejected.when)
    return math.isfinite(away_m), away_m < REVISITED_M and drone_moves


@compiled
def reject_first(
    begin: int,
    stamps_ns: NDArray[np.int64],
    rows: Array64,
    motion_known: NDArray[np.bool_],
    drone_moves: NDArray[np.bool_],
    table: TableArrays,
    static_m: Array64,
    rejected: MarkedCells,
    false_returns: FalseReturnHistogram,
    model: ModelTables,
    span_m: float,
    follow_up_nats: float,
    left_out: NDArray[np.int64],
    static: int,
    judged: Judged,
) -> int:
    """Reject observations from `begin` on, as long as each fits no candidate and is not promising by itself.

    Returns the index of the first that is left, of stamps_ns (k,) and rows (k, COLUMNS) of `observe`. It may continue a
    candidate or begin one, or other candidates count. Those rejected are `judged`, counted in `false_returns`, and
    marked in the map `rejected` if they are static.

    motion_known, drone_moves (k,): whether the vehicle's motion is known, and the drone reports that it moves. static_m
    (m, 3): remembered static objects. left_out: features that an ablation does not use. static: index of that
    alternative.
    """
    for i in range(begin, stamps_ns.size):
        row, stamp_ns, features = rows[i], stamps_ns[i], judged.features[i]
        xyz_m = row[X : Z + 1]
        if table.promising_ns >= stamp_ns or first_within(static_m, xyz_m, STATIC_M) >= 0:
            return i
        fit, other = nearest_rows(table.state, table.ns, table.reacquired, table.rows, stamp_ns, xyz_m)
        if fit >= 0 or other >= 0:
            return i
        near, revisited = near_rejected(xyz_m, stamp_ns, motion_known[i], drone_moves[i], rejected)
        alone = not near and not math.isfinite(row[LARGE_OBJECT])
        if alone and table.rows > 0 and motion_known[i] and drone_moves[i]:  # it may be a candidate seen elsewhere
            return i
        first_features(row, span_m, false_returns_per_s(false_returns, row[RANGE], stamp_ns), near, revisited, features)
        for k in left_out:
            features[k] = math.nan
        judged.log_odds[i], judged.alternative[i], _ = evaluate(model, features)
        if judged.log_odds[i] >= follow_up_nats:
            return i
        add_false_return(false_returns, row[RANGE], stamp_ns)
        if judged.alternative[i] == static:
            mark_cells(rows[i : i + 1, X : Z + 1], rejected.cell_m, stamp_ns, rejected.key, rejected.when)
    return stamps_ns.size
