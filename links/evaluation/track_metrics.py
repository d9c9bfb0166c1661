"""Metrics of tracks: false outputs, continuity, identity, and the poses that the autopilot gate accepts.

An output is false by its distance from the drone alone: a run that states a large sigma has as many as one that states
none. False outputs whose own covariance excludes the drone are counted separately as overconfident.

Source: grd; limits in association.py, autopilot gate in links/mavlink/poses; GOSPA: Rahmathullah, Garcia-Fernandez,
Svensson, "Generalized optimal sub-pattern assignment metric", FUSION (2017), with alpha = 2.
"""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from links.evaluation.association import EvaluationInput, newest
from links.evaluation.errors import GRID_NS, poisson_upper, position_at, rms
from links.evaluation.evaluation import (
    NO_OUTPUT,
    NO_SPAN,
    WITHOUT_DRONE,
    Evaluation,
    Value,
    failed,
    not_applicable,
    not_evaluated,
)
from links.evaluation.pose_metrics import NO_MOMENT, with_rotation
from links.evaluation.run_data import OutputKind
from links.evaluation.text_files import Stamps
from stages.geometry.frames import Array64
from stages.messages import TrackingState

Spans = NDArray[np.int64]  # (m, 2) [ns], rising, without overlap
NO_SPANS: Spans = np.zeros((0, 2), dtype=np.int64)
LONG_NS = 1_000_000_000  # a track may be lost during a longer occlusion, and is lost after a longer gap in sight
NOT_OCCLUDED = "occlusions are not recorded: all time in reach counts as in sight"


def false_outputs(e: Evaluation) -> Value | None:
    """Outputs far from the drone."""
    errors, limits = e.errors, e.limits
    if e.run.no_drone:
        return not_applicable(WITHOUT_DRONE)
    if errors is None or e.duration_s is None:
        return e.no_truth()
    if errors.empty and len(e.output.poses):
        return e.no_error()
    count, n, detail = int(errors.false.sum()), len(errors), ""
    e.put("false_outputs", count, n)
    e.put("false_per_min", count / (e.duration_s / 60))
    if n:
        e.put_share("false_share", errors.false)
    else:
        e.put_none(failed(NO_OUTPUT), "false_share")
    if "sigma" in errors:
        overconfident = int((errors.false & (errors.distance > limits.overconfident_sigmas * errors.sigma)).sum())
        e.put("overconfident_false_outputs", overconfident, n)
        detail = f", {overconfident} of them by more than {limits.overconfident_sigmas:g} of their own sigmas"
    if count:
        e.findings.append(f"{count} of {n} outputs are false: farther than {limits.false_m:g} m from the drone{detail}")
    return not_evaluated(e.output.why_no_covariance)


def false_tracks(e: Evaluation) -> Value | None:
    """Tracks of false outputs: all of them where there is no drone. With a bound of their rate."""
    output = e.output
    rows = np.arange(len(output.poses))
    if not e.run.no_drone:
        if e.errors is None:
            return e.no_truth()
        rows = e.errors.index.to_numpy()[e.errors.false.to_numpy(dtype=np.bool_)]
    tracks = None if output.track is None else output.track[rows]
    count = count_tracks(output.poses.stamps_ns[rows], tracks)
    e.put("false_tracks", count, len(rows))
    if e.duration_s is None:
        return not_evaluated("the recording's length is not known")
    hours = e.duration_s / 3600
    e.put_all({"false_tracks_per_h": count / hours, "false_tracks_below_per_h": poisson_upper(count) / hours}, count)
    return None


def gospa(e: Evaluation) -> Value | None:
    """Mean GOSPA of the current outputs of all tracks against the drone, and the share of them that are at it."""
    if e.span_ns is None:
        return not_evaluated(NO_SPAN)
    if not e.run.no_drone and e.held is None:
        return e.no_truth()
    at_ns = np.arange(e.span_ns[0], e.span_ns[1] + 1, GRID_NS) if e.held is None else e.held.stamp_ns.to_numpy()
    if not len(at_ns):
        return not_evaluated(NO_MOMENT)
    distance_m = _distances_m(e, at_ns)
    e.put("gospa_m", gospa_m(distance_m, not e.run.no_drone, e.limits.false_m).mean(), len(at_ns))
    current = ~np.isnan(distance_m)
    if not current.any():
        return not_applicable(NO_OUTPUT)
    accurate = int((distance_m <= e.limits.false_m).sum())
    e.counts["precision"] = accurate, int(current.sum())
    e.put("precision", 100 * accurate / int(current.sum()), int(current.sum()))
    return None


def gospa_m(distance_m: Array64, drone: bool, cut_off_m: float) -> Array64:
    """GOSPA (times,) with p = 2 of the estimates at each time, against one drone or none.

    `distance_m` (times, tracks): of each current estimate from the drone, inf where there is none; NaN: no estimate.
    An estimate beyond the cut-off is false, and the drone missed: each counts cut_off^2 / 2, as every further estimate.
    """
    n = (~np.isnan(distance_m)).sum(axis=1)
    half = cut_off_m**2 / 2
    if not drone:
        return np.sqrt(n * half)
    nearest_m = np.min(np.nan_to_num(distance_m, nan=np.inf), axis=1, initial=np.inf)
    return np.sqrt(np.where(n == 0, half, (n - 1) * half + np.minimum(nearest_m, cut_off_m) ** 2))


def _distances_m(e: Evaluation, at_ns: Stamps) -> Array64:
    """Distance (times, tracks) of each track's newest output from the drone; NaN: older than `max_age_s`."""
    output, truth = e.output, e.run.truth
    tracks = np.ones(len(output.poses), dtype=np.int64) if output.track is None else output.track
    true_m = None if e.run.no_drone or truth is None else position_at(truth, at_ns, e.limits)[1]
    columns: list[Array64] = []
    for track in np.unique(tracks).tolist():
        poses = output.poses.take(tracks == track)
        last = newest(at_ns, poses.stamps_ns)
        current = (last >= 0) & (at_ns - poses.stamps_ns[last] <= e.limits.max_age_s * 1e9)
        off_m = np.inf if true_m is None else np.linalg.norm(poses.xyz_m[last] - true_m, axis=1)
        columns.append(np.where(current, off_m, np.nan))
    return np.column_stack(columns) if columns else np.full((len(at_ns), 1), np.nan)


def false_alarms(e: Evaluation) -> Value | None:
    """Outputs in a recording without a drone, where all of them are false."""
    if not e.run.no_drone:
        return not_applicable("for recordings without a drone (--no-drone declares that there was none)")
    outputs = len(e.output.poses)
    if outputs:
        e.findings.append(f"{outputs} outputs though there was no drone")
    if e.duration_s is None:
        return not_evaluated("the recording's length is not known")
    hours = e.duration_s / 3600
    bound = "" if outputs else f"none in {hours * 3600:.0f} s: below {3 / hours:.0f} /h with 95 % confidence"
    e.put("false_alarms_per_h", outputs / hours, outputs, note=bound)
    e.remarks += [f"false alarms: {bound}"] if bound else []
    return None


def count_tracks(stamps_ns: Stamps, tracks: NDArray[np.int64] | None) -> int:
    """Number of tracks; one that has no output for more than a second counts again when it has one."""
    stamps = pd.Series(stamps_ns)
    gaps = stamps.groupby(np.ones(len(stamps)) if tracks is None else tracks).diff()
    return int((gaps.isna() | (gaps > LONG_NS)).sum())


def autopilot_gate(e: Evaluation) -> Value | None:
    """Poses that the autopilot gate accepts: how much of the time, and how far off they are."""
    errors, held, sendable = e.errors, e.held, e.output.sendable
    if sendable is None and e.output.kind is OutputKind.POSE and not len(e.output.poses):
        sendable = np.zeros(0, dtype=np.bool_)  # the drone was never found: nothing was sent
    if sendable is None:
        return not_applicable("the run does not mark what the autopilot gate accepts")
    if e.run.no_drone:
        accepted, n = int(sendable.sum()), len(sendable)
        e.put("sendable_false", accepted, n)
        if accepted:
            e.findings.append(f"the autopilot gate accepts {accepted} of {n} poses though there was no drone")
        return not_applicable(WITHOUT_DRONE)
    if errors is None or held is None:
        return e.no_truth()
    if errors.empty and len(sendable):
        return e.no_error()
    if len(held):
        e.put_share("sendable_share", held.current & np.append(sendable, False)[held["last"]])
    else:
        e.put_none(not_evaluated(NO_MOMENT), "sendable_share")
    sent = errors.loc[sendable[errors.index]]
    false, n = int(sent.false.sum()), len(sent)
    e.put("sendable_false", false, n)
    if false:
        far = f"farther than {e.limits.false_m:g} m from the drone"
        e.findings.append(f"{false} of {n} poses that the autopilot gate accepts are {far}")
    if not n:
        return failed("the autopilot gate accepted no pose")
    e.put_all({"sendable_rmse_m": rms(sent.distance), "sendable_max_m": sent.distance.max()}, n)
    if "angle" not in sent:
        return not_evaluated("no rotation in the run and in truth")
    turned = with_rotation(e, sent)
    if not len(turned):
        return not_evaluated("no pose that the autopilot gate accepts has a rotation")
    e.put("sendable_max_deg", np.degrees(turned.angle.max()), len(turned))
    return None


def identity_switches(e: Evaluation) -> Value | None:
    """Changes of the tracks to another drone."""
    switches = e.output.switches
    if switches is None:
        return not_applicable("there was one drone")
    if not len(e.output.poses):
        return failed("no track follows the drone")
    e.put("identity_switches", switches)
    if switches:
        e.findings.append(f"tracks changed to another drone {switches} times")
    return None


def track_continuity(e: Evaluation) -> Value | None:
    """Losses of the track in sight, reacquisition after occlusions, gaps between returns of the drone.

    Time in which the drone is out of reach counts as occluded.
    """
    errors, occluded = e.errors, e.run.target.occluded_ns
    if errors is None or e.span_ns is None:
        return e.no_truth()
    note, occluded = ("", occluded) if occluded is not None else (NOT_OCCLUDED, NO_SPANS)
    out_of_reach = merged(np.column_stack([e.out_of_reach_ns, e.out_of_reach_ns + GRID_NS]))
    long = occluded[occluded[:, 1] - occluded[:, 0] >= LONG_NS]
    accurate = errors[~errors.false]
    accurate_ns = accurate.stamp_ns.to_numpy()
    if len(accurate):
        excused = merged(np.concatenate([long, out_of_reach]))
        losses = track_losses(accurate_ns, _lost_ns(e, accurate.index.to_numpy()), excused, e.span_ns[1])
        e.put("track_losses", losses, len(accurate), note)
    else:
        e.put_none(failed("never accurate, so there was no track to keep"), "track_losses")
    _put_return_gaps(e, accurate_ns, merged(np.concatenate([occluded, out_of_reach])), note)
    if e.run.target.occluded_ns is None:
        return not_evaluated(e.run.why_missing(EvaluationInput.VISIBILITY))
    e.reacquisition_s = reacquisition_times_s(accurate_ns, long, out_of_reach, e.span_ns)
    n, missed = len(e.reacquisition_s), sum(map(math.isinf, e.reacquisition_s))
    if not n:
        return not_applicable("the drone was never occluded for a second and then in sight again")
    if missed:
        return failed(f"not reacquired after {missed} of {n} occlusions")
    e.put("reacquisition_s", max(e.reacquisition_s), n)
    return None


def _put_return_gaps(e: Evaluation, accurate_ns: Stamps, occluded: Spans, note: str) -> None:
    returns_ns = e.run.target.returns_ns
    assert e.span_ns is not None
    if returns_ns is None:
        why = not_evaluated(e.run.why_missing(EvaluationInput.RETURNS))
        e.put_none(why, "longest_return_gap_s", "longest_return_gap_total_s")
        return
    total_s = longest_gap_s(returns_ns, *e.span_ns, NO_SPANS)
    e.put("longest_return_gap_total_s", total_s, len(returns_ns), "ends and occlusions count")
    if not len(accurate_ns) or accurate_ns[-1] - accurate_ns[0] < LONG_NS:
        e.put_none(failed("not accurate for a second"), "longest_return_gap_s")
        return
    gap_s = longest_gap_s(returns_ns, int(accurate_ns[0]), int(accurate_ns[-1]), occluded)
    e.put("longest_return_gap_s", gap_s, len(returns_ns), note)


def reacquisition_times_s(
    accurate_ns: Stamps, occluded: Spans, out_of_reach: Spans, span_ns: tuple[int, int]
) -> list[float]:
    """Time from the end of each occlusion to the first accurate output; inf when there is none while in sight.

    `occluded`: spans of a second or more. Not counted are an occlusion at the start, one that ends out of reach, and
    one after which the drone is in sight for less than a second without an accurate output.
    """
    found: list[float] = []
    nexts = [*occluded[1:, 0].tolist(), span_ns[1]]
    for (begin, end), until in zip(occluded.tolist(), nexts, strict=False):
        away = ((out_of_reach[:, 0] <= end) & (end < out_of_reach[:, 1])).any()
        if begin <= span_ns[0] or end >= span_ns[1] or away:
            continue
        inside = accurate_ns[(accurate_ns >= end) & (accurate_ns <= until)]
        if len(inside):
            found.append((int(inside[0]) - end) / 1e9)
        elif until - end >= LONG_NS:
            found.append(math.inf)
    return found


def track_losses(accurate_ns: Stamps, lost_ns: list[list[int]], excused: Spans, end_ns: int) -> int:
    """How often an accurate track ends in sight: no accurate output for more than a second, or its state is LOST.

    `lost_ns` has, for each accurate output, when the state of its track became LOST. A gap ends with the next accurate
    output, where the drone is occluded or out of reach (`excused`), or with the recording.
    """
    count = 0
    nexts = [*accurate_ns[1:].tolist(), end_ns]
    for at, following, lost in zip(accurate_ns.tolist(), nexts, lost_ns, strict=True):
        hides = excused[excused[:, 1] > at]
        in_sight_until = min(following, max(at, int(hides[0, 0])) if len(hides) else following)
        declared = any(at < stamp <= in_sight_until for stamp in lost)
        count += declared or in_sight_until - at > LONG_NS
    return count


def _lost_ns(e: Evaluation, rows: NDArray[np.int64]) -> list[list[int]]:
    """For each of these outputs: when the state of its track became LOST."""
    by_track: dict[int, list[int]] = {}
    for stamp, state, track in e.run.states:
        if state == TrackingState.LOST.name:
            by_track.setdefault(track, []).append(stamp)
    tracks = np.ones(len(rows), dtype=np.int64) if e.output.track is None else e.output.track[rows]
    return [by_track.get(track, []) for track in tracks.tolist()]


def longest_gap_s(returns_ns: Stamps, start_ns: int, end_ns: int, occluded: Spans) -> float:
    """Longest time between two returns, or a return and an end of the span, without the time occluded."""
    inside = returns_ns[(returns_ns > start_ns) & (returns_ns < end_ns)]
    edges = np.concatenate([[start_ns], inside, [end_ns]]).astype(np.int64)
    occluded_until = np.clip(edges[:, None] - occluded[:, 0], 0, occluded[:, 1] - occluded[:, 0]).sum(axis=1)
    return float(np.diff(edges - occluded_until).max()) / 1e9


def merged(spans: Spans) -> Spans:
    """Union of spans that may overlap."""
    result: list[list[int]] = []
    for start, end in sorted(spans.tolist()):
        if result and start <= result[-1][1]:
            result[-1][1] = max(result[-1][1], end)
        else:
            result.append([start, end])
    return np.array(result, dtype=np.int64).reshape(-1, 2)
