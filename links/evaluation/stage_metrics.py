"""Metrics of single stages: searches and probabilities of the detector, rotation by both cameras.

A search is a sweep of the paper's detector or an interval of grd's. Rates are shares of the time searched, not of the
number of searches: grd ends a search when it detects something and waits up to three times as long otherwise, so a
second with a detection has more searches than one without. A search without a return of the drone cannot detect it.

Source: grd; limits in association.py; reliability after Murphy and Winkler, Applied Statistics 26 (1977).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

from links.evaluation.association import EvaluationInput, drone_labels
from links.evaluation.errors import EULER, GRID_NS, p95, path_length_m, position_at, rms, rotation_errors
from links.evaluation.evaluation import (
    NO_SPAN,
    WITHOUT_DRONE,
    Evaluation,
    Value,
    failed,
    not_applicable,
    not_evaluated,
)
from links.evaluation.pose_metrics import BRANCH_RAD, MIN_FOR_NEES, MIN_FOR_P95, mean_nees, put_inside_95
from links.evaluation.run_data import XYZ, RotationLog, Search
from links.evaluation.text_files import Flags, Trajectory
from stages.geometry.frames import Array64

PROBABILITY_EDGES = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.95, 1.0)  # bins of the reliability table
SCORE_RANGES_M = (0.0, 15.0, 25.0, 35.0, 70.0)  # bands in which probabilities are scored
FALSE_DETECTIONS = "false_detections_per_min"
NO_SEARCH = "no complete search with a drone in reach"
PUBLISHED, MODULO_90 = "rotation_published", "rotation_modulo_90"
ANGLES = "rmse", "median", *(f"rmse_{axis}" for axis in EULER), "p95"
OPEN_BRANCH = not_applicable("the stage leaves the yaw branch to the heading")
FIRST_S, FIRST_M, FIRST_GROUND_M = "rotation_resolved_s", "rotation_resolved_m", "rotation_resolved_ground_m"


def searches(e: Evaluation) -> Value | None:
    """Detection rate, missed searches and false detections."""
    found, truth = e.run.searches, e.run.truth
    if found is None:
        return not_evaluated(e.run.why_missing(EvaluationInput.SEARCHES))
    if e.duration_s is None:
        return not_evaluated(NO_SPAN)
    if e.run.no_drone:
        false = sum(len(search.accepted_xyz_m) for search in found)
        e.put(FALSE_DETECTIONS, false / (e.duration_s / 60), false)
        if false:
            e.findings.append(f"{false} detections though there was no drone")
        return not_applicable(WITHOUT_DRONE)
    if truth is None:
        return e.no_truth()
    paths = [_path(e, search, truth) for search in found]
    covered = [(search, path) for search, path in zip(found, paths, strict=True) if len(path)]
    if len(covered) < len(found):
        e.remarks.append(f"{len(found) - len(covered)} of {len(found)} searches have no truth; they are not counted")
    at_drone = [_candidates_at_drone(e, search, path) for search, path in covered]
    false = sum(int((~flags).sum()) for flags in at_drone)
    e.put(FALSE_DETECTIONS, false / (e.duration_s / 60), false)
    if false:
        e.findings.append(f"{false} false detections in {len(covered)} searches")
    return _detection_rates(e, covered, at_drone)


def _detection_rates(e: Evaluation, covered: list[tuple[Search, Array64]], at_drone: list[Flags]) -> Value | None:
    in_reach = np.array([np.linalg.norm(path, axis=1).min() <= e.limits.reach_m for _, path in covered], dtype=np.bool_)
    by_best, by_any = (np.array([flags[:k].any() for flags in at_drone], dtype=np.bool_) for k in (1, None))
    spans = np.array([(search.start_ns, search.end_ns) for search, _ in covered], dtype=np.int64).reshape(-1, 2)
    length_s = np.maximum(np.diff(spans, axis=1)[:, 0], 1) * 1e-9
    if in_reach.any():
        e.put_timed_share("detection_rate", by_best, in_reach, length_s)  # a track starts from the best candidate
    else:
        e.put_none(not_evaluated(NO_SEARCH), "detection_rate")
    if e.run.target.returns_ns is None:
        return not_evaluated(e.run.why_missing(EvaluationInput.RETURNS))
    returns = np.diff(np.searchsorted(e.run.target.returns_ns, spans + np.array([0, 1])), axis=1)[:, 0]
    observable = returns >= e.limits.min_returns
    e.put("missed_searches", (observable & ~by_best).sum(), len(returns))
    if observable.any():
        e.put_timed_share("observable_detection_rate", by_any, observable, length_s)
    else:
        e.put_none(not_applicable(f"no search had {e.limits.min_returns} returns"), "observable_detection_rate")
    if not in_reach.any():
        return not_evaluated(NO_SEARCH)
    e.put_timed_share("return_share", returns >= 1, in_reach, length_s)
    e.put_timed_share("observable_share", observable, in_reach, length_s)
    return None


def _candidates_at_drone(e: Evaluation, search: Search, path: Array64) -> Flags:
    """Accepted candidates (k,) at the drone; those at another drone are left out: they are not false."""
    here = _nearest_m(search, path) <= e.limits.false_m
    at_another = np.zeros(len(here), dtype=np.bool_)
    for number, other in enumerate(e.run.drones, start=1):
        if number != e.run.drone and other.path is not None:
            at_another |= ~here & (_nearest_m(search, _path(e, search, other.path)) <= e.limits.false_m)
    return here[~at_another]


def _path(e: Evaluation, search: Search, truth: Trajectory) -> Array64:
    """Positions of a drone during a search (k, 3) [m]; empty without truth."""
    times = np.append(np.arange(search.start_ns, search.end_ns, GRID_NS, dtype=np.int64), search.end_ns)
    known, path = position_at(truth, times, e.limits)
    return path[known]


def _nearest_m(search: Search, path: Array64) -> Array64:
    """Distance (k,) of each accepted candidate from the nearest point of a path."""
    return np.linalg.norm(search.accepted_xyz_m[:, None] - path, axis=2).min(axis=1, initial=np.inf)


def candidate_outcomes(e: Evaluation) -> pd.DataFrame:
    """Every classification of a candidate: candidate, probability, telemetry, range_m, is_drone.

    It was a drone when it was within `false_m` of one then. Classifications at times without truth are left out.
    """
    run, rows = e.run, e.run.candidates
    if rows is None or (run.truth is None and not run.no_drone):
        columns = ("candidate", "probability", "telemetry", "range_m", "is_drone")
        return pd.DataFrame({name: [] for name in columns})
    drones = [] if run.no_drone else [drone.path for drone in run.drones if drone.path is not None]
    paths = [(path.stamps_ns, path.xyz_m) for path in drones]
    known, is_drone = drone_labels(rows.stamp_ns.to_numpy(), rows[[*XYZ]].to_numpy(), paths, e.limits)
    range_m = np.linalg.norm(rows[[*XYZ]], axis=1)
    columns = {"candidate": rows.candidate, "probability": rows.probability, "telemetry": rows.telemetry}
    counted = np.nonzero(known)[0]
    return pd.DataFrame(columns | {"range_m": range_m, "is_drone": is_drone}).take(counted)


def probability_outcomes(e: Evaluation) -> pd.DataFrame:
    """Outcomes of the detector's probabilities: bin (of PROBABILITY_EDGES), probability, is_drone.

    A candidate counts once in each bin: with its first observation after which its probability is in that bin.
    """
    rows = candidate_outcomes(e)
    bins = np.searchsorted(PROBABILITY_EDGES, rows.probability, side="right") - 1
    rows = rows.assign(bin=np.clip(bins, 0, len(PROBABILITY_EDGES) - 2))
    return rows.drop_duplicates(["candidate", "bin"]).drop(columns=["telemetry", "range_m"])


def camera_rotation(e: Evaluation) -> Value | None:
    """Rotation by both cameras: how much was accepted, its errors, and when its yaw branch was resolved.

    A RESOLVED yaw branch that is wrong is worse than none: the autopilot uses it.
    """
    log, run = e.run.rotations, e.run
    if log is None or not len(log):
        return not_applicable("no rotation stage in this run")
    if run.no_drone or run.drone != 1:
        return not_applicable(WITHOUT_DRONE if run.no_drone else "the camera is on drone 1")
    accepted = int(log.accepted.sum())
    e.put("rotation_images", len(log))
    e.put_counted_share("rotation_accepted_share", accepted, len(log))
    e.put("rotation_resolved", log.resolved.sum(), accepted)
    e.put("rotation_switches", log.switches.max())
    if run.truth is not None:
        e.rotation_errors = rotation_errors(log, run.truth, run.vehicle, e.limits)
    errors = e.rotation_errors
    _first_resolved(e, log)
    if run.truth is None:
        return e.no_truth()
    if errors is None:
        return not_evaluated(f"truth gives no rotation: {run.truth.why_no_rotation}")
    if len(errors) < accepted:
        e.remarks.append(f"{accepted - len(errors)} of {accepted} rotations have no truth; they are in no error")
    if run.vehicle is None:
        e.remarks.append(
            "truth has no attitude of the vehicle: errors modulo 90 deg are about the vehicle's own z axis"
        )
    _angle_statistics(e, log, MODULO_90, errors.loc[:, ["angle", *EULER]])
    if not log.decides:
        e.put_none(OPEN_BRANCH, *(f"{PUBLISHED}_{name}_deg" for name in ANGLES))
        return _rotation_consistency(e, log, errors)
    _angle_statistics(e, log, PUBLISHED, errors.loc[:, [f"published_{name}" for name in ("angle", *EULER)]])
    wrong = int((errors.resolved & (errors.published_angle > BRANCH_RAD)).sum())
    e.put("rotation_wrong_resolved", wrong, int(errors.resolved.sum()))
    if wrong:
        e.findings.append(f"{wrong} RESOLVED rotations are more than 45 deg off")
    return _rotation_consistency(e, log, errors)


def _angle_statistics(e: Evaluation, log: RotationLog, prefix: str, errors_rad: pd.DataFrame) -> None:
    """RMSE, median, 95 % point and RMSE of the Euler angles [deg] of columns angle, roll, pitch, yaw."""
    n, (angle, *euler) = len(errors_rad), np.degrees(errors_rad.to_numpy()).T
    keys = [f"{prefix}_{name}_deg" for name in ANGLES if name != "p95"]
    if n:
        e.put_all(dict(zip(keys, (rms(angle), np.median(angle), *map(rms, euler)), strict=True)), n)
    else:
        e.put_none(_too_few(log, 0, 1), *keys)
    if n >= MIN_FOR_P95:
        e.put(f"{prefix}_p95_deg", p95(angle), n)
    else:
        e.put_none(_too_few(log, n, MIN_FOR_P95 if n else 1), f"{prefix}_p95_deg")


def _rotation_consistency(e: Evaluation, log: RotationLog, errors: pd.DataFrame) -> Value | None:
    n, nees = len(errors), errors.nees.to_numpy()
    if n < MIN_FOR_NEES:
        return _too_few(log, n, MIN_FOR_NEES)
    put_inside_95(e, "rotation_inside_95_share", nees, 3)
    if broken := int(np.isnan(nees).sum()):
        e.findings.append(f"{broken} of {n} covariances of the rotation are missing or not positive definite")
        return not_evaluated(f"{broken} covariances of the rotation are not positive definite")
    v = mean_nees(e, nees, 3, "rotation")
    third = {name: getattr(v, name) / 3 for name in ("value", "low", "high")}
    e.values["rotation_nees_per_dof"] = replace(v, **third)
    return None


def _too_few(log: RotationLog, n: int, needed: int) -> Value:
    """Why a statistic is missing. The run has failed when it had the images for it and accepted too few of them."""
    reason = f"{n} rotations with truth, {needed} needed"
    return failed(reason) if log.accepted.sum() < needed <= len(log) else not_evaluated(reason)


def _first_resolved(e: Evaluation, log: RotationLog) -> None:
    """Time and path of the drone to the first RESOLVED rotation, which must be of the right branch."""
    keys = (FIRST_S, FIRST_M, FIRST_GROUND_M)
    errors, truth, vehicle = e.rotation_errors, e.run.truth, e.run.vehicle
    if e.span_ns is None:
        e.put_none(not_evaluated("the recording's time is not known"), *keys)
        return
    if not log.decides:
        e.put_none(OPEN_BRANCH, *keys, "rotation_wrong_resolved")
        return
    if not log.resolved.any():
        e.put_none(failed("never RESOLVED"), *keys)
        return
    first_ns = int(log.stamps_ns[log.resolved].min())
    if errors is not None and (errors.published_angle[errors.stamp_ns == first_ns] > BRANCH_RAD).any():
        e.put_none(failed("the first RESOLVED rotation was wrong"), *keys)
        return
    e.put(FIRST_S, (first_ns - e.span_ns[0]) / 1e9)
    for key, over_ground in ((FIRST_M, False), (FIRST_GROUND_M, True)):
        if truth is None or vehicle is None:
            e.put_none(e.no_truth() if truth is None else not_evaluated("truth has no pose of the vehicle"), key)
            continue
        length_m = path_length_m(truth, vehicle, (e.span_ns[0], first_ns), e.limits, over_ground)
        if length_m is None:
            e.put_none(not_evaluated("truth has a gap before it"), key)
        else:
            e.put(key, length_m)
