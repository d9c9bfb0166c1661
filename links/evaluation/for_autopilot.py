"""Poses that were good enough for the autopilot, by its gate (links/mavlink/gate.py): how many, and how far off.

Source: ours; DESIGN, Safety: a pose that is wrong and sent crashes a drone, one that is not sent does not.
"""

from __future__ import annotations

import numpy as np

from links.evaluation.associate import newest
from links.evaluation.catalogue import Value, failure
from links.evaluation.judged import NO_DRONE, Evaluation, no_error, no_truth, rms, share

POSE = "pose"  # output of that name (run_data.py): the fused one
NONE_GOOD = "no pose was good enough for the autopilot"


def for_autopilot(judged: Evaluation) -> None:
    """All metrics of the group. A run that does not mark its outputs, or has positions only, sends none."""
    errors = ("good_rmse_m", "good_max_m", "good_max_deg")
    keys = ("good_share", *errors, "good_false")
    at, over, good, values = judged.at, judged.over, judged.output.good, judged.values
    if good is None and judged.output.name == POSE and not len(judged.output.poses):
        good = np.zeros(0, dtype=np.bool_)  # the drone was never found: nothing was sent
    if good is None:
        judged.does_not_apply("the run does not mark what the autopilot may have", *keys)
        return
    if judged.run.no_drone:
        judged.does_not_apply(NO_DRONE, "good_share", *errors)
        _false(judged, int(good.sum()), len(good), "of no drone: there was none")
        return
    if at is None or over is None:
        no_truth(judged, *keys)
        return
    if not len(at.index) and len(good):
        judged.cannot(no_error(judged, at).note, *keys)
        return
    if len(over.at_ns):
        last = newest(over.at_ns, judged.output.poses.stamps_ns)
        values["good_share"] = share(over.fresh & (last >= 0) & np.append(good, False)[last])
    else:
        judged.cannot("truth knows no moment of the recording with a drone in reach", "good_share")
    sent = good[at.index]
    far = int(np.count_nonzero(sent & (at.distance_m > judged.limits.wrong_m)))
    _false(judged, far, int(sent.sum()), f"farther than {judged.limits.wrong_m:g} m from the drone")
    if not sent.any():
        values.update((key, failure(NONE_GOOD)) for key in errors)
        return
    values["good_rmse_m"] = Value(rms(at.distance_m[sent]), int(sent.sum()))
    values["good_max_m"] = Value(float(at.distance_m[sent].max()), int(sent.sum()))
    if at.angle_error_rad is None:
        judged.cannot("no rotation in the run and in truth", "good_max_deg")
    else:
        values["good_max_deg"] = Value(float(np.degrees(at.angle_error_rad[sent].max())), int(sent.sum()))


def _false(judged: Evaluation, count: int, of: int, what: str) -> None:
    judged.values["good_false"] = Value(float(count), of)
    if count:
        judged.findings.append(f"{count} of {of} poses good enough for the autopilot are {what}")
