"""Compiled rejection of first observations. Most observations are of edges, leaves and wires: they begin no candidate.

Source: see `stages/detect/evidence_detect.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.detect.candidate import neighbour_score, return_count_nats
from stages.kernels.detect.candidate_table import first_within, nearest_rows
from stages.kernels.detect.existence import add_false_return, birth_nats, false_returns_per_s
from stages.kernels.detect.isolation import SECTORS, mark_cells, nearest_marked
from stages.kernels.detect.model import evaluate
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


@compiled
def reject_first(
    begin: int,
    stamps_ns: NDArray[np.int64],
    rows: Array64,
    motion_known: NDArray[np.bool_],
    drone_moves: NDArray[np.bool_],
    promising_ns: int,
    state: Array64,
    ns: NDArray[np.int64],
    reacquired: NDArray[np.bool_],
    candidates: int,
    static_m: Array64,
    cell_m: float,
    key: NDArray[np.int64],
    when: NDArray[np.int64],
    count: Array64,
    newest_ns: NDArray[np.int64],
    where: NDArray[np.int64],
    knots: Array64,
    values: Array64,
    missing: Array64,
    priors: Array64,
    span_m: float,
    follow_up_nats: float,
    left_out: NDArray[np.int64],
    static: int,
    log_odds: Array64,
    alternatives: NDArray[np.int64],
    features: Array64,
) -> int:
    """Reject observations from `begin` on, as long as each fits no candidate and is not promising by itself.

    Returns the index of the first that is left, of stamps_ns (k,) and rows (k, COLUMNS) of `observe`. It may continue a
    candidate or begin one, or other candidates count. Of those rejected it fills log_odds (k,), alternatives (k,) and
    features (k, n), counts them as false returns and marks the static ones in the map of rejected objects.

    Whether the vehicle's motion is known and the drone reports that it moves: (k,) each. The candidates are those of
    `nearest_rows`, static_m (m, 3) remembered static objects; map and false returns as in `nearest_marked` and
    `add_false_return`, the model as in `evaluate`; left_out: features that an ablation does not use; static: index of
    that alternative.
    """
    for i in range(begin, stamps_ns.size):
        row, stamp_ns = rows[i], stamps_ns[i]
        xyz_m = row[X : Z + 1]
        if promising_ns >= stamp_ns or first_within(static_m, xyz_m, STATIC_M) >= 0:
            return i
        fit, other = nearest_rows(state, ns, reacquired, candidates, stamp_ns, xyz_m)
        if fit >= 0 or other >= 0:
            return i
        since_ns = stamp_ns - (NEAR_REJECTED_NS if motion_known[i] else NEAR_REJECTED_UNKNOWN_NS)
        rejected_m = nearest_marked(xyz_m, cell_m, 0.0, NEAR_REJECTED_M, since_ns, key, when)
        near_rejected = math.isfinite(rejected_m)
        alone = not near_rejected and not math.isfinite(row[LARGE_OBJECT])
        if alone and candidates > 0 and motion_known[i] and drone_moves[i]:
            return i
        revisited = rejected_m < REVISITED_M and drone_moves[i]
        false_per_s = false_returns_per_s(count, newest_ns, row[RANGE], stamp_ns)
        first_features(row, span_m, false_per_s, near_rejected, revisited, features[i])
        for k in left_out:
            features[i, k] = math.nan
        log_odds[i], alternatives[i], _ = evaluate(where, knots, values, missing, priors, features[i])
        if log_odds[i] >= follow_up_nats:
            return i
        add_false_return(count, newest_ns, row[RANGE], stamp_ns)
        if alternatives[i] == static:
            mark_cells(rows[i : i + 1, X : Z + 1], cell_m, stamp_ns, key, when)
    return stamps_ns.size
