"""False outputs, false alarms and invented drones.

An output is false by how far it is from the drone alone: a run that states a huge sigma has as many as one that states
none. Those that are off by many of their own sigmas, too, are counted beside it: nobody was warned of them.

Source: ours; limits in links/evaluation/errors.py.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from links.evaluation.catalogue import Value, failure
from links.evaluation.judged import NO_DRONE, Evaluation, minutes, no_error, no_truth, share

SILENCE_NS = 1_000_000_000  # a track that says nothing for longer has ended


def false_outputs(judged: Evaluation) -> None:
    """Outputs far from the drone, or where there was none."""
    keys = ("false_outputs", "false_per_min", "beyond_1m_share", "sure_false_outputs")
    at, values, limits = judged.at, judged.values, judged.limits
    outputs = len(judged.output.poses)
    if judged.run.no_drone:
        judged.does_not_apply(NO_DRONE, *keys)
        _false_alarms(judged, outputs)
        return
    without = "for recordings without a drone (--no-drone says so)"
    judged.does_not_apply(without, "false_alarms_per_h", "invented_drones")
    if at is None:
        no_truth(judged, *keys)
        return
    if not len(at.index) and outputs:
        judged.cannot(no_error(judged, at).note, *keys)
        return
    false = at.distance_m > limits.wrong_m
    count, note = int(np.count_nonzero(false)), ""
    values["false_outputs"] = Value(float(count), len(at.index))
    assert judged.span_ns is not None
    values["false_per_min"] = Value(count / minutes(judged.span_ns))
    values["beyond_1m_share"] = share(false) if len(at.index) else failure("no output at all")
    if at.sigma_m is None:
        judged.cannot(judged.output.why_no_covariance, "sure_false_outputs")
    else:
        sure = int(np.count_nonzero(false & (at.distance_m > limits.wrong_sigmas * at.sigma_m)))
        values["sure_false_outputs"] = Value(float(sure), len(at.index))
        note = f", {sure} of them by more than {limits.wrong_sigmas:g} of their own sigmas"
    if count:
        judged.findings.append(
            f"{count} of {len(at.index)} outputs are false: farther than {limits.wrong_m:g} m from the drone{note}"
        )


def _false_alarms(judged: Evaluation, outputs: int) -> None:
    """Recordings without a drone: everything that is said is false."""
    invented = stretches(judged.output.poses.stamps_ns, judged.output.track)
    judged.values["invented_drones"] = Value(float(invented), outputs)
    if judged.span_ns is None:
        judged.cannot("the recording's length is not known", "false_alarms_per_h")
    else:
        hours = minutes(judged.span_ns) / 60
        bound = "" if outputs else f"none in {hours * 3600:.0f} s: below {3 / hours:.0f} /h with 95 % confidence"
        judged.values["false_alarms_per_h"] = Value(outputs / hours, outputs, note=bound)
        judged.remarks += [f"false alarms: {bound}"] if bound else []
    if outputs:
        judged.findings.append(f"{outputs} outputs though there was no drone")


def stretches(stamps_ns: NDArray[np.int64], tracks: NDArray[np.int64] | None) -> int:
    """How many things were reported: outputs of one track without a silence of more than a second are one."""
    if tracks is None:
        tracks = np.ones(len(stamps_ns), dtype=np.int64)
    of_each = [stamps_ns[tracks == track] for track in np.unique(tracks)]
    return sum(1 + int(np.count_nonzero(np.diff(own) > SILENCE_NS)) for own in of_each)
