"""Errors of a run against truth, as data frames, and their statistics.

Source: grd; Euler angles as in the paper's tables: R = Rz(yaw) Ry(pitch) Rx(roll), differences wrapped to +-180 deg;
Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 5.4 (NEES); Wilson, J. Am. Stat.
Assoc. 22 (1927) (interval of a share); Brier, Monthly Weather Review 78 (1950).
"""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pandas as pd
from scipy import signal, stats
from scipy.spatial.transform import Rotation

from links.evaluation.association import EvaluationLimits, bracket, interpolate, newest
from links.evaluation.run_data import RotationLog, RunData, RunTrajectory
from links.evaluation.text_files import Flags, Stamps, Trajectory
from stages.geometry.frames import Array64

GRID_NS = 20_000_000  # period at which the newest output is evaluated
EULER = ["roll", "pitch", "yaw"]
Z_95 = float(stats.norm.ppf(0.975))  # two-sided 95 % of the normal distribution


def output_errors(output: RunTrajectory, truth: Trajectory, limits: EvaluationLimits) -> pd.DataFrame:
    """Errors of the outputs at their own stamps, one row for each output that truth covers; the index is the output.

    Columns: stamp_ns; x, y, z and distance [m] of output - truth in vehicle axes; range [m] and true_x, true_y, true_z
    of truth; false. With a covariance also sigma_x, sigma_y, sigma_z and sigma along the error [m] (the largest one
    where there is no error) and nees; with rotations roll, pitch, yaw and angle [rad]; with both pose_nees. A NEES is
    NaN where the covariance is not positive definite.
    """
    known, true_m = position_at(truth, output.poses.stamps_ns, limits)
    index = np.nonzero(known)[0]
    covered, true_m = output.take(index), true_m[index]
    stamps_ns, xyz_m, covariance = covered.poses.stamps_ns, covered.poses.xyz_m, covered.covariance
    error = xyz_m - true_m
    distance = np.linalg.norm(error, axis=1)
    columns = {"stamp_ns": stamps_ns, "distance": distance, "range": np.linalg.norm(true_m, axis=1)}
    frame = pd.DataFrame(columns | {"false": distance > limits.false_m}, index=index)
    frame[["x", "y", "z"]], frame[["true_x", "true_y", "true_z"]] = error, true_m
    R = R_true = None
    if covered.poses.quaternion_xyzw is not None:
        R = Rotation.from_quat(covered.poses.quaternion_xyzw)
        if truth.quaternion_xyzw is not None:
            R_true = _rotation_at(truth, stamps_ns, limits)[1]
            frame[EULER], frame["angle"] = euler_error(R, R_true), (R.inv() * R_true).magnitude()
    if covariance is not None:
        if covariance.shape[1:] == (6, 6):
            if R is not None and R_true is not None:
                frame["pose_nees"] = mahalanobis(pose_error(R, xyz_m, R_true, true_m), covariance)
            axes = np.broadcast_to(np.eye(3), (len(index), 3, 3)) if R is None else R.as_matrix()
            covariance = axes @ covariance[:, 3:, 3:] @ np.swapaxes(axes, 1, 2)
        frame["nees"], frame["sigma"] = mahalanobis(error, covariance), sigma_along(error, covariance)
        variance = np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0)
        frame[["sigma_x", "sigma_y", "sigma_z"]] = np.sqrt(variance)
    return frame


def held_errors(
    output: RunTrajectory, truth: Trajectory, span_ns: tuple[int, int], limits: EvaluationLimits
) -> pd.DataFrame:
    """Errors of the newest output each GRID_NS, one row for each time at which truth is known.

    Columns: stamp_ns; range [m] of truth; in_reach; last, the newest output, -1 before the first; distance [m] of it
    from the drone, NaN before the first; current, when it is not older than `max_age_s`; accurate, when it is not
    false, too.
    """
    at_ns = np.arange(span_ns[0], span_ns[1] + 1, GRID_NS, dtype=np.int64)
    known, true_m = position_at(truth, at_ns, limits)
    at_ns, true_m = at_ns[known], true_m[known]
    stamps = output.poses.stamps_ns
    last = newest(at_ns, stamps)
    has = last >= 0
    distance = np.full(len(at_ns), np.nan)
    distance[has] = np.linalg.norm(output.poses.xyz_m[last[has]] - true_m[has], axis=1)
    current = has.copy()
    current[has] = at_ns[has] - stamps[last[has]] <= limits.max_age_s * 1e9
    frame = pd.DataFrame({"stamp_ns": at_ns, "range": np.linalg.norm(true_m, axis=1), "last": last})
    frame = frame.assign(distance=distance, current=current, accurate=current & (distance <= limits.false_m))
    return frame.assign(in_reach=~(frame["range"] > limits.reach_m))


def time_span(run: RunData) -> tuple[tuple[int, int] | None, str]:
    """Time that a run is evaluated over and where it comes from: the recording, else truth, never the output."""
    if run.start_ns is not None and run.end_ns is not None:
        return (run.start_ns, run.end_ns), "the recording"
    if run.truth is not None:
        return (int(run.truth.stamps_ns[0]), int(run.truth.stamps_ns[-1])), "the truth"
    return None, ""


def rotation_errors(
    log: RotationLog, drone: Trajectory, vehicle: Trajectory | None, limits: EvaluationLimits
) -> pd.DataFrame | None:
    """Errors of the accepted rotations by both cameras at their own stamps, where truth is known.

    Columns: stamp_ns; resolved; nees; angle, roll, pitch, yaw [rad] of the nearest of the four yaw branches, which are
    turned by 90 deg about the vertical of the world (this is the accuracy of the measurement alone); published_angle,
    published_roll, ... [rad] of the published branch. None when truth has no rotation of the drone. `vehicle` is
    T_world_vehicle; None: the vehicle is assumed to be level.
    """
    if drone.quaternion_xyzw is None:
        return None
    at_ns = log.stamps_ns[log.accepted]
    known, R_true = _rotation_at(drone, at_ns, limits)
    R_world_vehicle = Rotation.from_matrix(np.broadcast_to(np.eye(3), (len(at_ns), 3, 3)))
    if vehicle is not None:
        known_vehicle, R_world_vehicle = _rotation_at(vehicle, at_ns, limits)
        known = known & known_vehicle
    R = Rotation.from_matrix(log.R_vehicle_drone[log.accepted][known])
    R_true, R_world_vehicle = (Rotation.from_quat(r.as_quat()[known]) for r in (R_true, R_world_vehicle))
    turns = [Rotation.from_euler("z", branch * math.pi / 2) for branch in range(4)]
    branches = [R_world_vehicle.inv() * turn * R_world_vehicle * R_true for turn in turns]
    phi = np.array([(R.inv() * branch).as_rotvec() for branch in branches])  # (4, n, 3)
    angle, euler = np.linalg.norm(phi, axis=2), np.array([euler_error(R, branch) for branch in branches])
    nearest, row = np.argmin(angle, axis=0), np.arange(len(R))
    covariance = log.covariance_rad2[log.accepted][known]
    frame = pd.DataFrame({"stamp_ns": at_ns[known], "resolved": log.resolved[log.accepted][known]})
    frame["angle"], frame[EULER] = angle[nearest, row], euler[nearest, row]
    frame["published_angle"], frame[[f"published_{axis}" for axis in EULER]] = angle[0], euler[0]
    return frame.assign(nees=mahalanobis(phi[nearest, row], covariance))


def path_length_m(
    drone: Trajectory, vehicle: Trajectory, span_ns: tuple[int, int], limits: EvaluationLimits, over_ground: bool
) -> float | None:
    """Length [m] of the drone's path, over ground or relative to the vehicle in axes that do not turn with it.

    None when truth has a gap in the span. A recording may begin a little before truth does.
    """
    begin_ns, end_ns = max(span_ns[0], int(drone.stamps_ns[0])), span_ns[1]
    if begin_ns - span_ns[0] > limits.max_gap_ns:
        return None
    inside = (drone.stamps_ns > begin_ns) & (drone.stamps_ns < end_ns)
    at_ns = np.concatenate([[begin_ns], drone.stamps_ns[inside], [end_ns]])
    known, t_vehicle_drone = position_at(drone, at_ns, limits)
    known_position, t_world_vehicle = position_at(vehicle, at_ns, limits)
    known_rotation, R_world_vehicle = _rotation_at(vehicle, at_ns, limits)
    if not (known & known_position & known_rotation).all():
        return None
    path = R_world_vehicle.apply(t_vehicle_drone) + (t_world_vehicle if over_ground else 0.0)
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def position_at(path: Trajectory, at_ns: Stamps, limits: EvaluationLimits) -> tuple[Flags, Array64]:
    """Positions of a trajectory at given times: known (m,) and xyz (m, 3) [m], whose unknown rows mean nothing."""
    return interpolate(at_ns, path.stamps_ns, path.xyz_m, limits.max_gap_ns)


def _rotation_at(path: Trajectory, at_ns: Stamps, limits: EvaluationLimits) -> tuple[Flags, Rotation]:
    """Rotations of a trajectory at given times, by slerp: known (m,) and m rotations (unknown ones mean nothing)."""
    if path.quaternion_xyzw is None:
        return np.zeros(len(at_ns), dtype=np.bool_), Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (len(at_ns), 1)))
    b = bracket(at_ns, path.stamps_ns, limits.max_gap_ns)
    return b.known, slerp(path.quaternion_xyzw[b.before], path.quaternion_xyzw[b.after], b.weight)


def slerp(before_xyzw: Array64, after_xyzw: Array64, weight: Array64) -> Rotation:
    """Spherical linear interpolation between unit quaternions (m, 4), along the shorter arc (Shoemake 1985)."""
    before = Rotation.from_quat(before_xyzw)
    step = (before.inv() * Rotation.from_quat(after_xyzw)).as_rotvec()
    return before * Rotation.from_rotvec(weight[:, None] * step)


def euler_error(R: Rotation, R_true: Rotation) -> Array64:
    """Differences of roll, pitch and yaw (n, 3) [rad] in [-pi, pi)."""
    difference = (R.as_euler("ZYX") - R_true.as_euler("ZYX"))[:, ::-1]
    return (difference + np.pi) % (2 * np.pi) - np.pi


def pose_error(R: Rotation, xyz_m: Array64, R_true: Rotation, true_m: Array64) -> Array64:
    """Log of T_estimate^-1 T_true (n, 6), rotation before translation, tangent at the estimated drone."""
    estimate, truth = (
        [gtsam.Pose3(gtsam.Rot3(r), t) for r, t in zip(rotations.as_matrix(), translations, strict=True)]
        for rotations, translations in ((R, xyz_m), (R_true, true_m))
    )
    errors = [gtsam.Pose3.Logmap(a.between(b)) for a, b in zip(estimate, truth, strict=True)]
    return np.array(errors, dtype=np.float64).reshape(-1, 6)


def mahalanobis(error: Array64, covariance: Array64) -> Array64:
    """e^T C^-1 e (n,); NaN where C is not positive definite."""
    result = np.full(len(error), np.nan)
    if len(error):
        valid = np.linalg.eigvalsh(covariance)[:, 0] > 0
        solved = np.linalg.solve(covariance[valid], error[valid][..., None])[..., 0]
        result[valid] = np.sum(error[valid] * solved, axis=1)
    return result


def sigma_along(error: Array64, covariance: Array64) -> Array64:
    """Standard deviation (n,) in the direction of the error, the largest one where there is no error."""
    length = np.linalg.norm(error, axis=1)
    unit = error / np.where(length > 0, length, 1)[:, None]
    variance = np.einsum("ni,nij,nj->n", unit, covariance, unit)
    largest = np.linalg.eigvalsh(covariance)[:, -1] if len(error) else np.zeros(0)
    return np.sqrt(np.maximum(np.where(length > 0, variance, largest), 0))


def rms(values: Array64 | pd.Series) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def p95(values: Array64 | pd.Series) -> float:
    """95 % point, interpolated."""
    return float(np.percentile(values, 95))


def inside_95(nees: Array64 | pd.Series, dof: int) -> Flags:
    """Errors inside the 95 % ellipsoid; an invalid covariance (NaN) contains nothing."""
    return np.nan_to_num(np.asarray(nees), nan=np.inf) <= stats.chi2.ppf(0.95, dof)


def mean_nees_bounds(samples: float, dof: int) -> tuple[float, float]:
    """Two-sided 95 % bounds of the mean NEES of a consistent estimator: chi2_{n dof}(2.5 %, 97.5 %) / n."""
    n = max(samples, 1.0)
    low, high = stats.chi2.ppf([0.025, 0.975], n * dof) / n
    return float(low), float(high)


def wilson_interval(successes: float, trials: float) -> tuple[float, float]:
    """95 % confidence interval of a share; `trials` may be an effective number of samples, which is not whole."""
    share, z2 = successes / trials, Z_95**2
    middle = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = Z_95 / (1 + z2 / trials) * math.sqrt(share * (1 - share) / trials + z2 / (4 * trials**2))
    return max(0.0, middle - half), min(1.0, middle + half)


def poisson_upper(events: int) -> float:
    """One-sided 95 % upper bound of a Poisson mean after so many events: chi2_{2 events + 2}(95 %) / 2."""
    return float(stats.chi2.ppf(0.95, 2 * events + 2)) / 2


def brier_and_log_loss(probability: Array64, outcome: Flags) -> tuple[float, float]:
    """Mean Brier score and log loss [nats] of probabilities (n,); a certain and wrong one counts 13.8 nats."""
    p = np.clip(probability, 1e-6, 1 - 1e-6)
    return float(np.mean((p - outcome) ** 2)), float(-np.log(np.where(outcome, p, 1 - p)).mean())


def effective_samples(series: Array64) -> float:
    """Number of independent samples in a series: n / (1 + 2 sum of its autocorrelation), from 1 to n.

    The sum ends at the first lag with a correlation of 0 or less.
    """
    n = len(series)
    centred = series - series.mean() if n else series
    power = float(centred @ centred)
    if n < 3 or power <= 1e-12 * n * float(np.square(series).mean()):
        return float(min(n, 1))  # a constant series repeats one sample
    correlation = signal.correlate(centred, centred, method="fft")[n : 2 * n - 2] / power
    ends = np.nonzero(correlation <= 0)[0]
    total = float(correlation[: ends[0] if len(ends) else None].sum())
    return max(1.0, n / (1 + 2 * total))
