"""Is the drone kept once it was right: lost in sight, found again after it was hidden, returns without a long gap?

Source: ours. A drone that is hidden for a second or more may be lost; one in sight may not. Right is an output within
1 m at its own time. Time in which the drone was out of reach counts as hidden.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from links.evaluation.catalogue import Value, failure
from links.evaluation.errors import GRID_NS, AtOutputs
from links.evaluation.judged import Evaluation, no_truth

Spans = NDArray[np.int64]  # (m, 2) [ns], rising and apart
NO_SPANS: Spans = np.zeros((0, 2), dtype=np.int64)
LONG_NS = 1_000_000_000  # hidden for so long it may be lost, silent for longer in sight it is lost
ONE_DRONE = "there was one drone"
ALL_IN_SIGHT = "when the drone was hidden is not recorded: all time in reach counts as in sight"


def keeping(judged: Evaluation) -> None:
    """All metrics of the group."""
    kept = ("lost_count", "longest_hit_gap_s")
    of_hiding, of_hits = ("reacquired_s",), ("longest_hit_gap_whole_s",)
    if judged.output.swaps is None:
        judged.does_not_apply(ONE_DRONE, "identity_swaps")
    elif not len(judged.output.poses):
        judged.values["identity_swaps"] = failure("no track follows it")
    else:
        judged.values["identity_swaps"] = Value(float(judged.output.swaps))
        if judged.output.swaps:
            judged.findings.append(f"tracks went over to another drone {judged.output.swaps} times")
    if judged.at is None or judged.over is None:
        no_truth(judged, *kept, *of_hiding, *of_hits)
        return
    assert judged.span_ns is not None
    away = _away(judged.over.away_ns)
    hidden = NO_SPANS if judged.run.hidden_ns is None else judged.run.hidden_ns
    long_hidden = hidden[hidden[:, 1] - hidden[:, 0] >= LONG_NS]
    note = ALL_IN_SIGHT if judged.run.hidden_ns is None else ""
    right = judged.at.distance_m <= judged.limits.wrong_m
    right_ns = judged.at.stamps_ns[right]
    if len(right_ns):
        excused = merged(np.concatenate([long_hidden, away]))
        lost = lost_count(right_ns, _lost_ns(judged, judged.at, right), excused, judged.span_ns[1])
        judged.values["lost_count"] = Value(float(lost), len(right_ns), note=note)
    else:
        judged.values["lost_count"] = failure("never right, so there was nothing to keep")
    if judged.run.hidden_ns is None:
        judged.cannot(judged.run.missing.get("visible", "when it was hidden is not recorded"), *of_hiding)
    else:
        _reacquired(judged, right_ns, long_hidden, away)
    _hit_gaps(judged, right_ns, merged(np.concatenate([hidden, away])), note)


def _hit_gaps(judged: Evaluation, right_ns: NDArray[np.int64], hidden: Spans, note: str) -> None:
    hits_ns = judged.run.drone_hits_ns
    assert judged.span_ns is not None
    if hits_ns is None:
        reason = judged.run.missing.get("hits", "the drone's returns are not recorded")
        judged.cannot(reason, "longest_hit_gap_s", "longest_hit_gap_whole_s")
        return
    whole_s = longest_gap_s(hits_ns, *judged.span_ns, NO_SPANS)
    judged.values["longest_hit_gap_whole_s"] = Value(whole_s, len(hits_ns), note="ends and hidden time count")
    if not len(right_ns) or right_ns[-1] - right_ns[0] < LONG_NS:
        judged.values["longest_hit_gap_s"] = failure("not right for a second")
        return
    gap_s = longest_gap_s(hits_ns, int(right_ns[0]), int(right_ns[-1]), hidden)
    judged.values["longest_hit_gap_s"] = Value(gap_s, len(hits_ns), note=note)


def _reacquired(judged: Evaluation, right_ns: NDArray[np.int64], hidden: Spans, away: Spans) -> None:
    assert judged.span_ns is not None
    judged.reappeared_s = times_to_find_again_s(right_ns, hidden, away, judged.span_ns)
    worst = max(judged.reappeared_s, default=None)
    n = len(judged.reappeared_s)
    if worst is None:
        judged.does_not_apply("the drone was never hidden for a second and then in sight again", "reacquired_s")
    elif math.isinf(worst):
        never = sum(math.isinf(t) for t in judged.reappeared_s)
        judged.values["reacquired_s"] = failure(f"{never} of {n} times it was not found again")
    else:
        judged.values["reacquired_s"] = Value(worst, n)


def times_to_find_again_s(
    right_ns: NDArray[np.int64], hidden: Spans, away: Spans, span_ns: tuple[int, int]
) -> list[float]:
    """Each time the drone came back in sight: until the first right output; inf when there was none while in sight.

    `hidden`: spans of a second or more. A drone that was hidden from the start does not come back but first appears;
    one that is in sight for less than a second without being found, or comes back out of reach, asks for nothing.
    """
    found: list[float] = []
    for index, (since, back) in enumerate(hidden.tolist()):
        until = int(hidden[index + 1, 0]) if index + 1 < len(hidden) else span_ns[1]
        if since <= span_ns[0] or back >= span_ns[1] or ((away[:, 0] <= back) & (back < away[:, 1])).any():
            continue
        inside = right_ns[(right_ns >= back) & (right_ns <= until)]
        if len(inside):
            found.append((int(inside[0]) - back) / 1e9)
        elif until - back >= LONG_NS:
            found.append(math.inf)
    return found


def lost_count(right_ns: NDArray[np.int64], lost_ns: list[list[int]], excused: Spans, end_ns: int) -> int:
    """How often a right track ended in sight: no right output for more than a second, or its track said LOST.

    `lost_ns`: for each right output when its track said so afterwards. A silence ends with the next right output, where
    the drone is hidden (`excused`), or with the recording.
    """
    count = 0
    for index, at in enumerate(right_ns.tolist()):
        following = int(right_ns[index + 1]) if index + 1 < len(right_ns) else end_ns
        hides = excused[excused[:, 1] > at]
        in_sight_until = min(following, max(at, int(hides[0, 0])) if len(hides) else following)
        said = any(at < stamp <= in_sight_until for stamp in lost_ns[index])
        count += said or in_sight_until - at > LONG_NS
    return count


def _lost_ns(judged: Evaluation, at: AtOutputs, right: NDArray[np.bool_]) -> list[list[int]]:
    """For each right output: when its track was LOST."""
    by_track: dict[int, list[int]] = {}
    for stamp, state, track in judged.run.states:
        if state == "LOST":
            by_track.setdefault(track, []).append(stamp)
    tracks = judged.output.track
    own = np.ones(len(at.index), dtype=np.int64) if tracks is None else tracks[at.index]
    return [by_track.get(track, []) for track in own[right].tolist()]


def longest_gap_s(hits_ns: NDArray[np.int64], start_ns: int, end_ns: int, hidden: Spans) -> float:
    """The longest time between two returns, or a return and an end of the span, with hidden time taken out."""
    inside = hits_ns[(hits_ns > start_ns) & (hits_ns < end_ns)]
    edges = np.concatenate([[start_ns], inside, [end_ns]]).astype(np.int64)
    hidden_until = np.clip(edges[:, None] - hidden[:, 0], 0, hidden[:, 1] - hidden[:, 0]).sum(axis=1)
    return float(np.diff(edges - hidden_until).max()) / 1e9


def merged(spans: Spans) -> Spans:
    """The union of spans that may overlap."""
    result: list[list[int]] = []
    for start, end in sorted(spans.tolist()):
        if result and start <= result[-1][1]:
            result[-1][1] = max(result[-1][1], end)
        else:
            result.append([start, end])
    return np.array(result, dtype=np.int64).reshape(-1, 2)


def _away(away_ns: NDArray[np.int64]) -> Spans:
    """Moments 20 ms apart as spans."""
    return merged(np.column_stack([away_ns, away_ns + GRID_NS]))
