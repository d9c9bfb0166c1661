"""Searches (sweeps of the paper's detector, intervals of ours): was the drone found, missed, or seen where it was not?

Source: ours; limits in links/evaluation/errors.py. The physical limit stands beside it: a search in which no pulse came
back from the drone can find nothing.

Shares are of the time searched, not of searches: ours end one as soon as they find something, and wait up to three
times as long for nothing, so that a second in which it is found makes more searches than one in which it is not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from links.evaluation.associate import interpolate
from links.evaluation.catalogue import Value
from links.evaluation.errors import GRID_NS
from links.evaluation.judged import NO_DRONE, NO_SPAN, Evaluation, minutes, no_truth, timed_share
from links.evaluation.run_data import Sweep
from links.evaluation.tum import Trajectory
from stages.geometry.frames import Array64

FOUND, BY_HITS = ("found_share",), ("found_when_seen_share", "missed_sweeps", "hit_share", "seen_share")
FALSE = "false_detections_per_min"


def detections(judged: Evaluation) -> None:
    """Every search against where the drone was in its time."""
    sweeps, truth = judged.run.sweeps, judged.run.truth
    if sweeps is None:
        judged.cannot(judged.run.missing.get("detections", "no detections recorded"), *FOUND, *BY_HITS, FALSE)
    elif judged.span_ns is None:
        judged.cannot(NO_SPAN, *FOUND, *BY_HITS, FALSE)
    elif judged.run.no_drone:
        judged.does_not_apply(NO_DRONE, *FOUND, *BY_HITS)
        _tell_false(judged, sum(len(sweep.accepted_xyz_m) for sweep in sweeps), len(sweeps))
    elif truth is None:
        no_truth(judged, *FOUND, *BY_HITS, FALSE)
    else:
        _against_truth(judged, sweeps, truth)


def _against_truth(judged: Evaluation, sweeps: tuple[Sweep, ...], truth: Trajectory) -> None:
    limits, others = judged.limits, judged.run.other_paths
    false = unknown = 0
    length_s: list[float] = []  # of each search with truth
    returns: list[int] = []
    is_asked: list[bool] = []
    is_found: list[tuple[bool, bool]] = []  # by the best candidate, by any
    for sweep in sweeps:
        path = _path(judged, sweep, truth)
        if not len(path):
            unknown += 1
            continue
        here = _nearest_m(sweep, path) <= limits.wrong_m
        at_another = np.zeros(len(here), dtype=bool)
        for other in others:
            at_another |= ~here & (_nearest_m(sweep, _path(judged, sweep, other)) <= limits.wrong_m)
        here = here[~at_another]
        false += int(np.count_nonzero(~here))
        is_found.append((bool(len(here) and here[0]), bool(here.any())))
        length_s.append(max(sweep.end_ns - sweep.start_ns, 1) * 1e-9)
        is_asked.append(bool((np.linalg.norm(path, axis=1) <= limits.reach_m).any()))
        if judged.run.drone_hits_ns is not None:
            first, last = np.searchsorted(judged.run.drone_hits_ns, [sweep.start_ns, sweep.end_ns + 1])
            returns.append(int(last - first))
    if unknown:
        judged.remarks.append(f"{unknown} of {len(sweeps)} sweeps have no truth; they are neither found nor false")
    _tell_false(judged, false, len(sweeps) - unknown)
    asked, found, lengths = np.array(is_asked, dtype=np.bool_), np.array(is_found, dtype=np.bool_), np.array(length_s)
    found = found.reshape(-1, 2)
    if asked.any():
        timed_share(judged, "found_share", found[:, 0], asked, lengths)  # by the best one, which a track starts from
    else:
        judged.cannot("no whole sweep with a drone in reach", *FOUND)
    if judged.run.drone_hits_ns is None:
        judged.cannot(judged.run.missing.get("hits", "the drone's returns are not recorded"), *BY_HITS)
    else:
        _by_hits(judged, np.array(returns, dtype=np.int64), asked, found, lengths)


def _by_hits(
    judged: Evaluation,
    returns: NDArray[np.int64],
    is_asked: NDArray[np.bool_],
    is_found: NDArray[np.bool_],
    length_s: Array64,
) -> None:
    """What could be found, and what of it was. Rows are searches; `is_found`: by the best candidate, by any."""
    seen = returns >= judged.limits.min_hits
    by_best, by_any = is_found.T
    judged.values["missed_sweeps"] = Value(float(np.count_nonzero(seen & ~by_best)), len(returns))
    if seen.any():
        timed_share(judged, "found_when_seen_share", by_any, seen, length_s)
    else:
        judged.does_not_apply(f"no sweep had {judged.limits.min_hits} returns", "found_when_seen_share")
    if is_asked.any():
        timed_share(judged, "hit_share", returns >= 1, is_asked, length_s)
        timed_share(judged, "seen_share", seen, is_asked, length_s)
    else:
        judged.cannot("no whole sweep with a drone in reach", "hit_share", "seen_share")


def _path(judged: Evaluation, sweep: Sweep, truth: Trajectory) -> Array64:
    """Where a drone was in the time of a search (k, 3); empty when truth does not say."""
    moments = np.append(np.arange(sweep.start_ns, sweep.end_ns, GRID_NS, dtype=np.int64), sweep.end_ns)
    max_gap_ns = round(judged.limits.max_gap_s * 1e9)
    known, path, _ = interpolate(moments, truth.stamps_ns, truth.xyz_m, None, max_gap_ns)
    return path[known]


def _nearest_m(sweep: Sweep, path: Array64) -> Array64:
    """Distance of each accepted candidate from a drone's path, at its nearest."""
    return np.linalg.norm(sweep.accepted_xyz_m[:, None] - path, axis=2).min(axis=1, initial=np.inf)


def _tell_false(judged: Evaluation, false: int, sweeps: int) -> None:
    assert judged.span_ns is not None
    judged.values[FALSE] = Value(false / minutes(judged.span_ns), false)
    if false and judged.run.no_drone:
        judged.findings.append(f"{false} detections though there was no drone")
    elif false:
        judged.findings.append(f"{false} false detections in {sweeps} sweeps")
