"""False outputs, false alarms, and sweeps in which the drone was found or missed.

Source: ours; limits in links/evaluation/errors.py.
"""

from __future__ import annotations

import numpy as np

from links.evaluation.associate import interpolate
from links.evaluation.catalogue import Value, failure
from links.evaluation.errors import GRID_NS
from links.evaluation.judged import NO_DRONE, NO_SPAN, Evaluation, minutes, no_error, no_truth, share
from links.evaluation.statistics import wilson_interval


def false_outputs(judged: Evaluation) -> None:
    """Outputs far from the drone, or where there was none."""
    keys = ("false_outputs", "false_per_min", "beyond_1m_share")
    at, values, limits = judged.at, judged.values, judged.limits
    outputs = len(judged.output.poses)
    if judged.run.no_drone:
        judged.does_not_apply(NO_DRONE, *keys)
        _false_alarms(judged, outputs)
        return
    judged.does_not_apply("for recordings without a drone (--no-drone says so)", "false_alarms_per_h")
    if at is None:
        no_truth(judged, *keys)
        return
    if not len(at.index) and outputs:
        judged.cannot(no_error(judged, at).note, *keys)
        return
    limit = np.full(len(at.index), limits.wrong_m)
    note = ""
    if at.sigma_m is not None:
        limit = np.maximum(limit, limits.wrong_sigmas * at.sigma_m)
    else:
        note = f"no covariance, so farther than {limits.wrong_m:g} m"
    false = at.distance_m > limit
    count = int(np.count_nonzero(false))
    values["false_outputs"] = Value(float(count), len(at.index), note=note)
    assert judged.span_ns is not None
    values["false_per_min"] = Value(count / minutes(judged.span_ns), note=note)
    values["beyond_1m_share"] = share(at.distance_m > limits.wrong_m) if len(at.index) else failure("no output at all")
    if count:
        judged.findings.append(
            f"{count} of {len(at.index)} outputs are false: farther than max({limits.wrong_m:g} m, "
            f"{limits.wrong_sigmas:g} sigma) from the drone"
        )


def _false_alarms(judged: Evaluation, outputs: int) -> None:
    """Recordings without a drone: everything that is said is false."""
    if judged.span_ns is None:
        judged.cannot("the recording's length is not known", "false_alarms_per_h")
    else:
        hours = minutes(judged.span_ns) / 60
        bound = "" if outputs else f"none in {hours * 3600:.0f} s: below {3 / hours:.0f} /h with 95 % confidence"
        judged.values["false_alarms_per_h"] = Value(outputs / hours, outputs, note=bound)
        judged.remarks += [f"false alarms: {bound}"] if bound else []
    if outputs:
        judged.findings.append(f"{outputs} outputs though there was no drone")


def detections(judged: Evaluation) -> None:
    """Sweeps in which the drone was found, missed, or seen where it was not."""
    keys = ("found_share", "missed_sweeps", "false_detections_per_min")
    sweeps, truth, limits = judged.run.sweeps, judged.run.truth, judged.limits
    if sweeps is None:
        judged.cannot(judged.run.missing.get("detections", "no detections recorded"), *keys)
        return
    if judged.span_ns is None:
        judged.cannot(NO_SPAN, *keys)
        return
    false = found = asked = missed = unknown = 0
    for sweep in sweeps:
        if judged.run.no_drone:
            false += len(sweep.accepted_xyz_m)
            continue
        moments = np.append(np.arange(sweep.start_ns, sweep.end_ns, GRID_NS, dtype=np.int64), sweep.end_ns)
        if truth is None:
            break
        known, path, _ = interpolate(moments, truth.stamps_ns, truth.xyz_m, None, round(limits.max_gap_s * 1e9))
        if not known.any():
            unknown += 1
            continue
        away_m = np.linalg.norm(sweep.accepted_xyz_m[:, None] - path[known], axis=2).min(axis=1)
        false += int(np.count_nonzero(away_m > limits.wrong_m))
        here = bool(len(away_m) and away_m[0] <= limits.wrong_m)  # the best one is what a track starts from
        if (np.linalg.norm(path[known], axis=1) <= limits.reach_m).any():
            asked += 1
            found += here
        if judged.run.drone_hits_ns is not None:
            first, last = np.searchsorted(judged.run.drone_hits_ns, [sweep.start_ns, sweep.end_ns + 1])
            missed += int(last - first >= limits.min_hits and not here)
    if unknown:
        judged.remarks.append(f"{unknown} of {len(sweeps)} sweeps have no truth; they are neither found nor false")
    if truth is None and not judged.run.no_drone:
        no_truth(judged, *keys)
        return
    judged.values["false_detections_per_min"] = Value(false / minutes(judged.span_ns), false)
    if judged.run.no_drone:
        judged.does_not_apply(NO_DRONE, "found_share", "missed_sweeps")
        if false:
            judged.findings.append(f"{false} detections though there was no drone")
        return
    if false:
        judged.findings.append(f"{false} false detections in {len(sweeps) - unknown} sweeps")
    if asked:
        low, high = wilson_interval(found, asked)
        judged.values["found_share"] = Value(100 * found / asked, asked, 100 * low, 100 * high)
    else:
        judged.cannot("no whole sweep with a drone in reach", "found_share")
    if judged.run.drone_hits_ns is None:
        judged.cannot(judged.run.missing.get("hits", "the drone's returns are not recorded"), "missed_sweeps")
    else:
        judged.values["missed_sweeps"] = Value(float(missed), len(sweeps) - unknown)
