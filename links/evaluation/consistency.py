"""Rotation, and whether a run is as sure as it may be: wrong yaw branches marked good, NEES, coverage.

Source: P, tables (Euler RMSE); Bar-Shalom, Li, Kirubarajan, 5.4 (NEES).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from links.evaluation.catalogue import Value, failure
from links.evaluation.errors import AtOutputs
from links.evaluation.judged import Evaluation, no_error, no_truth, rms, too_few
from links.evaluation.statistics import chi2_quantile, effective_samples, mean_nees_bounds, wilson_interval
from stages.geometry.frames import Array64

MIN_FOR_NEES = 10
BRANCH_RAD = math.radians(45.0)  # farther off is another branch


def rotation(judged: Evaluation) -> None:
    """Errors of the Euler angles as the paper has them, and how long a wrong yaw branch was sold as good."""
    keys = ("rmse_roll_deg", "rmse_pitch_deg", "rmse_yaw_deg", "rmse_angle_deg", "branch_wrong_s")
    at, output, truth = judged.at, judged.output, judged.run.truth
    if at is None or truth is None:
        no_truth(judged, *keys)
    elif not len(output.poses):
        judged.values.update((key, failure("no output at all")) for key in keys[:4])
        judged.cannot("no output at all", "branch_wrong_s")
    elif output.rotated is not None and not output.rotated.any():
        judged.values.update((key, failure("the run never knew the rotation")) for key in keys[:4])
        judged.cannot("the run never knew the rotation", "branch_wrong_s")
    elif output.poses.quaternion_xyzw is None:
        judged.cannot(f"the run gives no rotation: {output.poses.why_no_rotation}", *keys)
    elif at.euler_error_rad is None or at.angle_error_rad is None:
        judged.cannot(f"truth gives no rotation: {truth.why_no_rotation}", *keys)
    elif not len(at.index):
        judged.cannot(no_error(judged, at).note, *keys)
    elif not (told := _rotation_told(judged, at)).any():
        judged.cannot("the run knew no rotation where truth does", *keys)
    else:
        n = int(told.sum())
        for key, series in zip(keys, np.degrees(at.euler_error_rad[told]).T, strict=False):
            judged.values[key] = Value(rms(series), n)
        judged.values["rmse_angle_deg"] = Value(rms(np.degrees(at.angle_error_rad[told])), n)
        wrong_s, note = _branch_wrong(judged, at, at.euler_error_rad[:, 2])
        judged.values["branch_wrong_s"] = Value(wrong_s, n, note=note)
        if wrong_s > 0:
            judged.findings.append(f"yaw wrong by more than 45 deg for {wrong_s:.1f} s while told as known")


def _rotation_told(judged: Evaluation, at: AtOutputs) -> NDArray[np.bool_]:
    """Outputs (n,) that give a rotation at all; a run that does not mark them gives one with each."""
    rotated = judged.output.rotated
    return np.ones(len(at.index), dtype=np.bool_) if rotated is None else rotated[at.index]


def _branch_wrong(judged: Evaluation, at: AtOutputs, yaw_error_rad: Array64) -> tuple[float, str]:
    """An output serves until the next one, at most `max_age_s`."""
    stamps = judged.output.poses.stamps_ns
    end = np.append(stamps[1:], np.iinfo(np.int64).max // 2)
    serves_s = np.minimum((end - stamps) / 1e9, judged.limits.max_age_s)[at.index]
    wrong = np.abs(yaw_error_rad) > BRANCH_RAD
    told = judged.output.good if judged.output.rotated is None else judged.output.rotated
    if told is None:
        return float(serves_s[wrong].sum()), "the run does not mark its outputs: all count as told"
    return float(serves_s[wrong & told[at.index]].sum()), ""


def covariance(judged: Evaluation) -> None:
    """NEES and the share inside the 95 % ellipsoid, for position and, when there is one, the whole pose."""
    at = judged.at
    if at is None:
        no_truth(judged, "nees_mean", "inside_95_share", "nees6_mean")
        return
    if at.nees is None:
        judged.cannot(f"no covariance: {judged.output.why_no_covariance}", "nees_mean", "inside_95_share", "nees6_mean")
        return
    if len(at.index) < MIN_FOR_NEES:
        none = too_few(judged, MIN_FOR_NEES, "NEES")
        judged.values.update({"nees_mean": none, "inside_95_share": none})
        judged.cannot(none.note, "nees6_mean")
        return
    broken = int(np.isnan(at.nees).sum())
    if broken:
        judged.findings.append(f"{broken} of {len(at.nees)} covariances are not positive definite")
        judged.cannot(f"{broken} covariances are not positive definite", "nees_mean")
    else:
        judged.values["nees_mean"] = mean_nees(judged, at.nees, 3, "position")
    inside_95(judged, "inside_95_share", at.nees, 3)
    if at.nees6 is None:
        judged.cannot("no 6x6 covariance with rotation in the run and in truth", "nees6_mean")
    elif not (told := _rotation_told(judged, at)).any():
        judged.cannot("the run never knew the rotation", "nees6_mean")
    elif np.isnan(at.nees6[told]).any():
        judged.cannot("some 6x6 covariances are not positive definite", "nees6_mean")
    else:
        judged.values["nees6_mean"] = mean_nees(judged, at.nees6[told], 6, "pose")


def inside_95(judged: Evaluation, key: str, nees: Array64, dof: int) -> None:
    """The share of errors inside the 95 % ellipsoid, kept as counts too; a broken covariance (NaN) holds nothing."""
    inside = np.nan_to_num(nees, nan=np.inf) <= chi2_quantile(0.95, dof)
    judged.counts[key] = int(inside.sum()), len(inside)
    share, worth = float(inside.mean()), effective_samples(np.nan_to_num(nees, nan=0.0))
    low, high = wilson_interval(share * worth, worth)
    note = f"interval for {worth:.0f} independent samples of {len(inside)}"
    judged.values[key] = Value(100 * share, len(inside), 100 * low, 100 * high, note)


def mean_nees(judged: Evaluation, nees: Array64, dof: int, what: str) -> Value:
    """The mean with the bounds of an honest one; beyond them is a finding above and a remark below."""
    worth = effective_samples(nees)
    low, high = mean_nees_bounds(worth, dof)
    mean = float(nees.mean())
    if mean > high:
        judged.findings.append(
            f"{what} covariance promises too much: mean NEES {mean:.1f}, honest is {dof} (up to {high:.1f})"
        )
    elif mean < low:
        judged.remarks.append(
            f"{what} covariance is too careful: mean NEES {mean:.2f}, honest is {dof} (down to {low:.1f})"
        )
    return Value(mean, len(nees), low, high, f"bounds for {worth:.0f} independent samples of {len(nees)}")
