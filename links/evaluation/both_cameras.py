"""The rotation of both cameras: how often there is one, how far off, how honest, and when its branch is known.

Source: P, tables (Euler RMSE); ours: a RESOLVED branch that is wrong is worse than none: an autopilot believes it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from links.evaluation.accuracy import MIN_FOR_P95
from links.evaluation.catalogue import AS_GIVEN, CAMERAS, CATALOGUE, MODULO, Value, failure, not_evaluated
from links.evaluation.consistency import BRANCH_RAD, MIN_FOR_NEES, inside_95, mean_nees
from links.evaluation.judged import NO_DRONE, Evaluation, counted_share, no_truth, p95, rms
from links.evaluation.rotation_errors import Off, RotationErrors, rotation_errors, way_m
from links.evaluation.rotations import Rotations

KEYS = tuple(key for key, metric in CATALOGUE.items() if metric.group == CAMERAS)
FIRST_S, FIRST_M, FIRST_GROUND_M = "rotation_resolved_s", "rotation_resolved_m", "rotation_resolved_ground_m"
WRONG, INSIDE, NEES = "rotation_wrong_resolved", "rotation_inside_95_share", "rotation_nees_of_1"


def both_cameras(judged: Evaluation) -> None:
    """Fill in every metric of the rotation; none applies in a run that told no rotation."""
    run = judged.run
    told = run.rotations
    if told is None or not len(told):
        judged.does_not_apply("no rotation stage in this run", *KEYS)
        return
    if run.no_drone or run.drone != 1:
        judged.does_not_apply(NO_DRONE if run.no_drone else "the camera is on drone 1", *KEYS)
        return
    values, accepted = judged.values, int(np.count_nonzero(told.accepted))
    values["rotation_pictures"] = Value(float(len(told)))
    counted_share(judged, "rotation_accepted_share", accepted, len(told))
    values["rotation_resolved"] = Value(float(np.count_nonzero(told.resolved)), accepted)
    values["rotation_switches"] = Value(float(told.switches.max()))
    if run.truth is not None:
        judged.turned = rotation_errors(told, run.truth, run.vehicle, judged.limits.max_gap_s)
    _errors(judged, told, accepted)
    _first_resolved(judged, told)


def _errors(judged: Evaluation, told: Rotations, accepted: int) -> None:
    truth, turned = judged.run.truth, judged.turned
    keys = [key for key in KEYS if key not in judged.values and key not in (FIRST_S, FIRST_M, FIRST_GROUND_M)]
    if truth is None:
        no_truth(judged, *keys)
    elif turned is None:
        judged.cannot(f"truth gives no rotation: {truth.why_no_rotation}", *keys)
    else:
        if turned.unknown:
            judged.remarks.append(f"{turned.unknown} of {accepted} rotations have no truth; they are in no error")
        if judged.run.vehicle is None:
            judged.remarks.append("truth does not say how the vehicle stands; quarter turns are about its own z axis")
        _sizes(judged, AS_GIVEN, turned.given, len(told), accepted)
        _sizes(judged, MODULO, turned.modulo, len(told), accepted)
        _honesty(judged, turned, len(told), accepted)
        wrong = int(np.count_nonzero(turned.resolved & (turned.given.angle_rad > BRANCH_RAD)))
        judged.values[WRONG] = Value(float(wrong), int(np.count_nonzero(turned.resolved)))
        if wrong:
            judged.findings.append(f"{wrong} RESOLVED rotations are more than 45 deg off")


def _sizes(judged: Evaluation, which: str, off: Off, pictures: int, accepted: int) -> None:
    """RMSE, median, 95 % and the Euler angles of one kind of error."""
    names = ("rmse", "median", "p95", "rmse_roll", "rmse_pitch", "rmse_yaw")
    keys = [f"rotation_{which}_{name}_deg" for name in names]
    n, values = len(off.angle_rad), judged.values
    if not n:
        values.update((key, _too_few(0, 1, pictures, accepted)) for key in keys)
        return
    angle, euler = np.degrees(off.angle_rad), np.degrees(off.euler_rad)
    several = _too_few(n, MIN_FOR_P95, pictures, accepted)
    found = [Value(rms(angle), n), Value(float(np.median(angle)), n)]
    found += [Value(p95(angle), n) if n >= MIN_FOR_P95 else several, *(Value(rms(axis), n) for axis in euler.T)]
    values.update(zip(keys, found, strict=True))


def _honesty(judged: Evaluation, turned: RotationErrors, pictures: int, accepted: int) -> None:
    n = len(turned.nees)
    if n < MIN_FOR_NEES:
        judged.values.update((key, _too_few(n, MIN_FOR_NEES, pictures, accepted)) for key in (INSIDE, NEES))
        return
    inside_95(judged, INSIDE, turned.nees, 3)
    broken = int(np.isnan(turned.nees).sum())
    if broken:
        judged.findings.append(f"{broken} of {n} covariances of the rotation are missing or not positive definite")
        judged.cannot(f"{broken} covariances of the rotation are not positive definite", NEES)
        return
    value = mean_nees(judged, turned.nees, 3, "rotation")
    assert value.value is not None
    assert value.low is not None
    assert value.high is not None
    judged.values[NEES] = replace(value, value=value.value / 3, low=value.low / 3, high=value.high / 3)


def _too_few(n: int, needed: int, pictures: int, accepted: int) -> Value:
    """Why there is no number: the run's failure when it had the pictures and accepted too few of them."""
    text = f"{n} rotations with truth, {needed} needed"
    return failure(text) if accepted < needed <= pictures else not_evaluated(text)


def _first_resolved(judged: Evaluation, told: Rotations) -> None:
    """When the branch was first said to be known, and how far the drone had flown by then; a wrong one is a failure."""
    run, turned = judged.run, judged.turned
    keys = (FIRST_S, FIRST_M, FIRST_GROUND_M)
    if judged.span_ns is None:
        judged.cannot("the recording's time is not known", *keys)
        return
    if not told.resolved.any():
        judged.values.update((key, failure("never RESOLVED")) for key in keys)
        return
    first_ns = int(told.stamps_ns[told.resolved].min())
    if turned is not None and (turned.given.angle_rad[turned.stamps_ns == first_ns] > BRANCH_RAD).any():
        judged.values.update((key, failure("the first RESOLVED was wrong")) for key in keys)
        return
    start_ns = judged.span_ns[0]
    judged.values[FIRST_S] = Value((first_ns - start_ns) / 1e9)
    if run.truth is None:
        no_truth(judged, FIRST_M, FIRST_GROUND_M)
    elif run.vehicle is None:
        judged.cannot("truth does not say how the vehicle stands and drives", FIRST_M, FIRST_GROUND_M)
    else:
        for key, over_ground in ((FIRST_M, False), (FIRST_GROUND_M, True)):
            way = way_m(run.truth, run.vehicle, (start_ns, first_ns), judged.limits.max_gap_s, over_ground)
            judged.values[key] = not_evaluated("truth has a gap before it") if way is None else Value(way)
