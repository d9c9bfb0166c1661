"""When there was an output, and how far off it was: at its own stamps and over all time with the last one held.

Source: P, tables of errors (RMSE per axis); ours: time counts too, so that saying nothing is never the better answer.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from links.evaluation.catalogue import BANDS_M, Value, band_key, band_name, failure, not_applicable, not_evaluated
from links.evaluation.errors import GRID_NS
from links.evaluation.judged import NO_DRONE, NO_SPAN, Evaluation, no_error, no_truth, p95, rms, share, too_few
from links.evaluation.trajectories import evo_errors

MIN_FOR_P95 = 20


def timing(judged: Evaluation) -> None:
    """First output, longest silence (the ends of the recording count), rate."""
    keys = ("first_output_s", "longest_gap_s", "rate_hz")
    if judged.run.no_drone:
        judged.does_not_apply(NO_DRONE, *keys)
        return
    if judged.span_ns is None:
        judged.cannot(NO_SPAN, *keys)
        return
    start, end = judged.span_ns
    stamps = judged.output.poses.stamps_ns
    stamps = stamps[(stamps >= start) & (stamps <= end)]
    edges = np.concatenate([[start], stamps, [end]])
    silent = np.diff(edges).astype(np.float64)
    if judged.over is not None:  # time in which the drone was out of reach is no silence
        gap = np.clip(np.searchsorted(edges, judged.over.away_ns, side="right") - 1, 0, len(silent) - 1)
        silent -= np.bincount(gap, minlength=len(silent)) * float(GRID_NS)
    judged.values["longest_gap_s"] = Value(max(0.0, float(silent.max())) / 1e9, len(stamps))
    judged.values["rate_hz"] = Value(len(stamps) / max((end - start) / 1e9, 1e-9), len(stamps))
    if len(stamps):
        judged.values["first_output_s"] = Value((int(stamps[0]) - start) / 1e9)
    else:
        judged.values["first_output_s"] = failure("no output at all")


def over_all_time(judged: Evaluation) -> None:
    """At every moment: is there an output, is it right, how far off is the last one?"""
    held_keys = ("held_rmse_m", "held_p95_m", "held_max_m")
    keys = ("right_share", "fresh_share", *held_keys, "before_first_s", "first_right_s", "longest_not_right_s")
    bands = [band_key("right_share", low) for low, _ in BANDS_M]
    over, values, limits = judged.over, judged.values, judged.limits
    if over is None:
        no_truth(judged, *keys, *bands)
        return
    if not len(over.at_ns):
        judged.cannot("truth knows no moment of the recording with a drone in reach", *keys, *bands)
        return
    right = over.fresh & (np.nan_to_num(over.held_m, nan=np.inf) <= limits.wrong_m)
    values["right_share"] = share(right)
    values["fresh_share"] = share(over.fresh)
    values["before_first_s"] = Value(float(np.count_nonzero(~over.has_output)) * GRID_NS / 1e9)
    held = over.held_m[over.has_output]
    for key, number in zip(held_keys, (rms, p95, np.max), strict=True):
        values[key] = Value(float(number(held)), len(held)) if len(held) else failure("no output at all")
    assert judged.span_ns is not None
    first = np.nonzero(right)[0]
    values["first_right_s"] = (
        Value((int(over.at_ns[first[0]]) - judged.span_ns[0]) / 1e9) if len(first) else failure("never right")
    )
    values["longest_not_right_s"] = Value(_longest_run(~right) * GRID_NS / 1e9)
    for low, high in BANDS_M:
        inside = (over.range_m >= low) & (over.range_m < high)
        values[band_key("right_share", low)] = (
            share(right[inside]) if inside.any() else not_applicable(_never_there(low, high))
        )


def _longest_run(flags: NDArray[np.bool_]) -> int:
    """Length of the longest run of True."""
    edges = np.nonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))[0]
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _never_there(low: float, high: float) -> str:
    return f"the drone was never at {band_name(low, high)} with truth"


def at_own_stamps(judged: Evaluation) -> None:
    """Errors of the outputs at their own stamps."""
    axes = ("rmse_x_m", "rmse_y_m", "rmse_z_m")
    whole = ("rmse_m", "median_m", "p95_m", "max_m")
    evo = ("evo_ape_rmse_m", "evo_rpe_rmse_m", "evo_rpe_max_m")
    bands = [band_key("rmse_m", low) for low, _ in BANDS_M]
    at, values = judged.at, judged.values
    if at is None:
        no_truth(judged, *axes, *whole, *evo, *bands)
        return
    n = len(at.index)
    if not n:
        none = no_error(judged, at)
        values.update((key, none) for key in (*axes, *whole, *evo))
    else:
        for key, axis in zip(axes, at.error_m.T, strict=True):
            values[key] = Value(rms(axis), n)
        values["rmse_m"] = Value(rms(at.distance_m), n)
        values["median_m"] = Value(float(np.median(at.distance_m)), n)
        values["p95_m"] = (
            Value(p95(at.distance_m), n) if n >= MIN_FOR_P95 else too_few(judged, MIN_FOR_P95, "a 95 % point")
        )
        values["max_m"] = Value(float(at.distance_m.max()), n)
        if n < 2:
            values.update((key, too_few(judged, 2, "evo")) for key in evo)
        else:
            found = evo_errors(at, judged.output.poses.xyz_m[at.index])
            for key in evo:
                values[key] = not_evaluated(found) if isinstance(found, str) else Value(found[key], n)
    for low, high in BANDS_M:
        key = band_key("rmse_m", low)
        inside = (at.range_m >= low) & (at.range_m < high)
        visited = judged.over is not None and ((judged.over.range_m >= low) & (judged.over.range_m < high)).any()
        if inside.any():
            values[key] = Value(rms(at.distance_m[inside]), int(np.count_nonzero(inside)))
        elif visited:
            values[key] = failure(f"no output while the drone was at {band_name(low, high)}")
        else:
            values[key] = not_applicable(_never_there(low, high))
    if not len(judged.output.poses):
        judged.findings.append("no output at all, though there was a drone")
