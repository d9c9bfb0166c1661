"""Metrics of the outputs of a run: timing, errors of position and rotation, consistency of the covariance.

Each function stores the values of one section of the catalogue (metrics.py) and returns why the ones that it did not
store are missing. Errors are also evaluated over all time, so that a run does not improve by leaving outputs out.

Source: P, tables of errors (RMSE per axis, Euler RMSE); Bar-Shalom, Li, Kirubarajan, 5.4 (NEES); evo
(github.com/MichaelGrupp/evo) for APE and RPE.
"""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from links.evaluation.errors import (
    EULER,
    GRID_NS,
    effective_samples,
    inside_95,
    mean_nees_bounds,
    p95,
    rms,
    wilson_interval,
)
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
from stages.geometry.frames import Array64

BANDS_M: tuple[tuple[float, float], ...] = ((0, 10), (10, 20), (20, 30), (30, 50), (50, math.inf))
BRANCH_RAD = math.radians(45.0)  # an error beyond this is another yaw branch
MIN_FOR_P95 = 20
MIN_FOR_NEES = 10
NO_MOMENT = "truth has no time with a drone in reach"
NO_EVO = "evo is not installed: pip install -e '.[evaluate]'"
NO_ROTATION = "the run never knew the rotation"


def timing(e: Evaluation) -> Value | None:
    """First output, longest gap (the ends of the recording count) and rate."""
    if e.run.no_drone:
        return not_applicable(WITHOUT_DRONE)
    if e.span_ns is None or e.duration_s is None:
        return not_evaluated(NO_SPAN)
    start, end = e.span_ns
    stamps = e.output.poses.stamps_ns
    stamps = stamps[(stamps >= start) & (stamps <= end)]
    edges = np.concatenate([[start], stamps, [end]])
    gaps_ns = np.diff(edges).astype(np.float64)
    gap = np.clip(np.searchsorted(edges, e.out_of_reach_ns, side="right") - 1, 0, len(gaps_ns) - 1)
    gaps_ns -= np.bincount(gap, minlength=len(gaps_ns)) * float(GRID_NS)  # out of reach is not a gap
    longest_s = max(0.0, float(gaps_ns.max())) / 1e9
    e.put_all({"longest_gap_s": longest_s, "rate_hz": len(stamps) / max((end - start) / 1e9, 1e-9)}, len(stamps))
    if not len(stamps):
        return failed(NO_OUTPUT)
    e.put("first_output_s", (int(stamps[0]) - start) / 1e9)
    return None


def track_accuracy(e: Evaluation) -> Value | None:
    """Over all time: is there a current output, is it accurate, how far off is the newest one."""
    held = e.held
    if held is None or e.span_ns is None:
        return e.no_truth()
    if held.empty:
        return not_evaluated(NO_MOMENT)
    e.put_share("track_accuracy", held.accurate)
    e.put_share("availability", held.current)
    e.put("before_first_s", held.distance.isna().sum() * GRID_NS / 1e9)
    inaccurate = ~held.accurate
    longest = inaccurate.groupby(held.accurate.cumsum()).sum().max()  # an accurate time begins each group
    e.put("longest_inaccurate_s", longest * GRID_NS / 1e9)
    distance = held.distance.dropna()
    if len(distance):
        e.put_all(
            {"held_rmse_m": rms(distance), "held_p95_m": p95(distance), "held_max_m": distance.max()}, len(distance)
        )
    else:
        e.put_none(failed(NO_OUTPUT), "held_rmse_m", "held_p95_m", "held_max_m")
    if inaccurate.all():
        return failed("never accurate")
    e.put("first_accurate_s", (held.stamp_ns[held.accurate].iloc[0] - e.span_ns[0]) / 1e9)
    return None


def position_error(e: Evaluation) -> Value | None:
    """Errors of the outputs at their own stamps."""
    errors = e.errors
    if errors is None:
        return e.no_truth()
    if not len(e.output.poses):
        e.findings.append("no output at all, though there was a drone")
    n, distance = len(errors), errors.distance
    if not n:
        return e.no_error()
    e.put_all({f"rmse_{axis}_m": rms(errors[axis].to_numpy()) for axis in "xyz"}, n)
    e.put_all({"rmse_m": rms(distance), "median_m": distance.median(), "max_m": distance.max()}, n)
    if n >= MIN_FOR_P95:
        e.put("p95_m", p95(distance), n)
    else:
        e.put_none(e.too_few(MIN_FOR_P95, "a 95 % point"), "p95_m")
    if n < 2:
        return e.too_few(2, "evo")
    found = _evo(errors)
    if found is None:
        return not_evaluated(NO_EVO)
    e.put_all(found, n)
    return None


def _evo(errors: pd.DataFrame) -> dict[str, float] | None:
    """RMSE of APE, and RMSE and maximum of RPE from output to output [m], by evo; None without evo.

    Nothing is aligned: the vehicle frame is given, an offset in it is an error.
    """
    try:
        from evo.core.metrics import APE, RPE, PoseRelation, StatisticsType, Unit
        from evo.core.trajectory import PoseTrajectory3D
    except ModuleNotFoundError:
        return None
    identity_wxyz = np.tile([1.0, 0.0, 0.0, 0.0], (len(errors), 1))  # only translations are compared
    stamps_s = (errors.stamp_ns - errors.stamp_ns.iloc[0]).to_numpy() / 1e9
    true_m = errors[["true_x", "true_y", "true_z"]].to_numpy()
    truth, estimate = (
        PoseTrajectory3D(xyz_m, identity_wxyz, stamps_s)
        for xyz_m in (true_m, true_m + errors[["x", "y", "z"]].to_numpy())
    )
    ape = APE(PoseRelation.translation_part)
    ape.process_data((truth, estimate))
    rpe = RPE(PoseRelation.translation_part, delta=1, delta_unit=Unit.frames, all_pairs=True)
    rpe.process_data((truth, estimate))
    return {
        "evo_ape_rmse_m": ape.get_statistic(StatisticsType.rmse),
        "evo_rpe_rmse_m": rpe.get_statistic(StatisticsType.rmse),
        "evo_rpe_max_m": rpe.get_statistic(StatisticsType.max),
    }


def error_by_range(e: Evaluation) -> Value | None:
    """RMSE of the outputs and track accuracy in bands of the true range."""
    errors, held = e.errors, e.held
    if errors is None or held is None:
        return e.no_truth()
    for low, high in BANDS_M:
        rmse, accuracy, name = band_key("rmse_m", low), band_key("track_accuracy", low), band_name(low, high)
        here, visited = (frame[frame["range"].between(low, high, inclusive="left")] for frame in (errors, held))
        nothing = not_applicable(f"the drone was never at {name} with truth")
        if len(here):
            e.put(rmse, rms(here.distance), len(here))
        else:
            e.put_none(failed(f"no output while the drone was at {name}") if len(visited) else nothing, rmse)
        if len(visited):
            e.put_share(accuracy, visited.accurate)
        else:
            e.put_none(nothing if len(held) else not_evaluated(NO_MOMENT), accuracy)
    return None


def band_name(low_m: float, high_m: float) -> str:
    """`10-20 m`, `50+ m`."""
    return f"{low_m:g}+ m" if math.isinf(high_m) else f"{low_m:g}-{high_m:g} m"


def band_key(what: str, low_m: float) -> str:
    """`range_10_rmse_m`: a metric of the band that begins at 10 m."""
    return f"range_{low_m:g}_{what}"


def pose_rotation(e: Evaluation) -> Value | None:
    """RMSE of the Euler angles, as in the paper, and how long the yaw was of a wrong branch."""
    errors, poses, truth = e.errors, e.output.poses, e.run.truth
    if errors is None or truth is None:
        return e.no_truth()
    never = e.output.has_rotation is not None and not e.output.has_rotation.any()
    if never or not len(poses):
        reason = NO_ROTATION if len(poses) else NO_OUTPUT
        e.put_none(not_evaluated(reason), "wrong_yaw_branch_s")
        return failed(reason)
    if poses.quaternion_xyzw is None:
        return not_evaluated(f"the run gives no rotation: {poses.why_no_rotation}")
    if truth.quaternion_xyzw is None:
        return not_evaluated(f"truth gives no rotation: {truth.why_no_rotation}")
    if errors.empty:
        return not_evaluated(e.no_error().note)
    known = with_rotation(e, errors)
    if known.empty:
        return not_evaluated("the run has no rotation where truth has one")
    e.put_all({f"rmse_{axis}_deg": rms(np.degrees(known[axis])) for axis in (*EULER, "angle")}, len(known))
    wrong_s, note = _wrong_branch_s(e, errors)
    e.put("wrong_yaw_branch_s", wrong_s, len(known), note)
    if wrong_s > 0:
        e.findings.append(f"yaw off by more than 45 deg for {wrong_s:.1f} s in outputs marked as valid")
    return None


def with_rotation(e: Evaluation, errors: pd.DataFrame) -> pd.DataFrame:
    """Errors of the outputs whose rotation is known; a run that does not mark them has one in each."""
    marks = e.output.has_rotation
    return errors if marks is None else errors.loc[marks[errors.index]]


def _wrong_branch_s(e: Evaluation, errors: pd.DataFrame) -> tuple[float, str]:
    """Time with a wrong yaw branch. An output counts until the next one, at most `max_age_s`."""
    stamps = e.output.poses.stamps_ns
    end = np.append(stamps[1:], np.iinfo(np.int64).max // 2)
    duration_s = np.minimum((end - stamps) / 1e9, e.limits.max_age_s)[errors.index]
    wrong = (errors.yaw.abs() > BRANCH_RAD).to_numpy()
    valid = e.output.sendable if e.output.has_rotation is None else e.output.has_rotation
    if valid is None:
        return float(duration_s[wrong].sum()), "the run does not mark valid outputs: all of them count"
    return float(duration_s[wrong & valid[errors.index]].sum()), ""


def covariance_consistency(e: Evaluation) -> Value | None:
    """NEES and the share of errors inside the 95 % ellipsoid, of the position and of the whole pose."""
    errors = e.errors
    if errors is None:
        return e.no_truth()
    if "nees" not in errors:
        return not_evaluated(f"no covariance: {e.output.why_no_covariance}")
    if len(errors) < MIN_FOR_NEES:
        why = e.too_few(MIN_FOR_NEES, "NEES")
        e.put_none(why, "nees_mean", "inside_95_share")
        return not_evaluated(why.note)
    if broken := int(errors.nees.isna().sum()):
        e.findings.append(f"{broken} of {len(errors)} covariances are not positive definite")
        e.put_none(not_evaluated(f"{broken} covariances are not positive definite"), "nees_mean")
    else:
        e.values["nees_mean"] = mean_nees(e, errors.nees.to_numpy(), 3, "position")
    put_inside_95(e, "inside_95_share", errors.nees.to_numpy(), 3)
    if "pose_nees" not in errors:
        return not_evaluated("no 6x6 covariance with rotation in the run and in truth")
    pose_nees = with_rotation(e, errors).pose_nees.to_numpy()
    if not len(pose_nees):
        return not_evaluated(NO_ROTATION)
    if np.isnan(pose_nees).any():
        return not_evaluated("some 6x6 covariances are not positive definite")
    e.values["pose_nees_mean"] = mean_nees(e, pose_nees, 6, "pose")
    return None


def put_inside_95(e: Evaluation, key: str, nees: Array64, dof: int) -> None:
    """Store the share of errors inside the 95 % ellipsoid, with its counts for statistics over runs."""
    inside = inside_95(nees, dof)
    e.counts[key] = int(inside.sum()), len(inside)
    share, samples = float(inside.mean()), effective_samples(np.nan_to_num(nees, nan=0.0))
    low, high = wilson_interval(share * samples, samples)
    note = f"interval for {samples:.0f} independent samples of {len(inside)}"
    e.values[key] = Value(100 * share, len(inside), 100 * low, 100 * high, note)


def mean_nees(e: Evaluation, nees: Array64, dof: int, what: str) -> Value:
    """Mean NEES with the bounds of a consistent estimator. Above them is a finding, below them a remark."""
    samples = effective_samples(nees)
    low, high = mean_nees_bounds(samples, dof)
    mean = float(nees.mean())
    text = f"mean NEES {mean:.3g}, expected {dof}"
    if mean > high:
        e.findings.append(f"{what} covariance is overconfident: {text} (upper bound {high:.1f})")
    elif mean < low:
        e.remarks.append(f"{what} covariance is conservative: {text} (lower bound {low:.1f})")
    return Value(mean, len(nees), low, high, f"bounds for {samples:.0f} independent samples of {len(nees)}")
