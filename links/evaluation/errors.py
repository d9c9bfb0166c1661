"""Where and how far an output was wrong: at its own stamps, and at every moment with the last output held.

Source: ours. Euler angles as the paper's tables: R = Rz(yaw) Ry(pitch) Rx(roll), differences wrapped to +-180 deg.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from links.evaluation.associate import interpolate, newest
from links.evaluation.output import Output
from links.evaluation.run_data import RunData
from links.evaluation.tum import Trajectory
from stages.geometry.frames import Array64, rotations_from_xyzw

GRID_NS = 20_000_000  # time is looked at each 20 ms


@dataclass(frozen=True, slots=True)
class Limits:
    """What counts as what. All are told in the report."""

    max_gap_s: float = 0.15  # truth further apart is not interpolated over
    max_age_s: float = 0.3  # an output serves for this long; an autopilot drops out when it waits longer
    wrong_m: float = 1.0
    wrong_sigmas: float = 3.0
    reach_m: float = 100.0  # the drone is not asked for beyond this: VLP-16 data sheet 63-9229, range
    min_hits: int = 4  # a sweep with this many returns of the drone should find it


@dataclass(frozen=True, slots=True)
class AtOutputs:
    """Outputs against truth interpolated to their own stamps; `known` rows only."""

    index: NDArray[np.int64]  # (n,) which outputs
    stamps_ns: NDArray[np.int64]
    error_m: Array64  # (n, 3) output - truth, vehicle axes
    distance_m: Array64  # (n,)
    range_m: Array64  # (n,) true
    covariance_m2: Array64 | None  # (n, 3, 3) of the position, vehicle axes
    sigma_m: Array64 | None  # (n,) along the error; the largest where there is no error
    nees: Array64 | None  # (n,) NaN where the covariance is not positive definite
    nees6: Array64 | None
    euler_error_rad: Array64 | None  # (n, 3) roll, pitch, yaw
    angle_error_rad: Array64 | None  # (n,)
    true_xyz_m: Array64
    unknown: int  # outputs at times without truth


def at_outputs(output: Output, truth: Trajectory, limits: Limits) -> AtOutputs:
    """Errors of every output that truth covers."""
    poses = output.poses
    both = poses.quaternion_xyzw is not None and truth.quaternion_xyzw is not None
    known, xyz, quaternion = interpolate(
        poses.stamps_ns, truth.stamps_ns, truth.xyz_m, truth.quaternion_xyzw, round(limits.max_gap_s * 1e9)
    )
    index = np.nonzero(known)[0]
    error = poses.xyz_m[index] - xyz[index]
    distance = np.linalg.norm(error, axis=1)
    euler = angle = R_estimate = R_true = None
    if poses.quaternion_xyzw is not None:
        R_estimate = rotations_from_xyzw(poses.quaternion_xyzw[index])
    if both and quaternion is not None and R_estimate is not None:
        R_true = rotations_from_xyzw(quaternion[index])
        euler = wrap(euler_rpy(R_estimate) - euler_rpy(R_true))
        angle = np.linalg.norm(log_rotation(np.swapaxes(R_estimate, 1, 2) @ R_true), axis=1)
    covariance = sigma = nees = nees6 = None
    if output.covariance is not None:
        covariance = output.covariance[index]
        if covariance.shape[1:] == (6, 6):
            if R_estimate is not None and R_true is not None:
                nees6 = mahalanobis(pose_error(R_estimate, poses.xyz_m[index], R_true, xyz[index]), covariance)
            R = np.broadcast_to(np.eye(3), (len(index), 3, 3)) if R_estimate is None else R_estimate
            covariance = R @ covariance[:, 3:, 3:] @ np.swapaxes(R, 1, 2)
        nees = mahalanobis(error, covariance)
        sigma = sigma_along(error, covariance)
    return AtOutputs(
        index,
        poses.stamps_ns[index],
        error,
        distance,
        np.linalg.norm(xyz[index], axis=1),
        covariance,
        sigma,
        nees,
        nees6,
        euler,
        angle,
        xyz[index],
        len(poses) - len(index),
    )


@dataclass(frozen=True, slots=True)
class OverTime:
    """Every moment of the recording at which the drone was in reach and truth knows where."""

    at_ns: NDArray[np.int64]  # (m,)
    range_m: Array64
    has_output: NDArray[np.bool_]  # an output came at or before
    fresh: NDArray[np.bool_]  # and is not older than `max_age_s`
    held_m: Array64  # (m,) distance of the newest output from the drone; NaN before the first
    away_ns: NDArray[np.int64]  # moments at which the drone was known to be out of reach


def over_time(output: Output, truth: Trajectory, span_ns: tuple[int, int], limits: Limits) -> OverTime:
    """Look each 20 ms: how far is the newest output from where the drone is now?"""
    at_ns = np.arange(span_ns[0], span_ns[1] + 1, GRID_NS, dtype=np.int64)
    known, xyz, _ = interpolate(at_ns, truth.stamps_ns, truth.xyz_m, None, round(limits.max_gap_s * 1e9))
    away = known & (np.linalg.norm(xyz, axis=1) > limits.reach_m)
    away_ns = at_ns[away]
    at_ns, xyz = at_ns[known & ~away], xyz[known & ~away]
    stamps = output.poses.stamps_ns
    last = newest(at_ns, stamps)
    has = last >= 0
    held = np.full(len(at_ns), np.nan)
    age_ns = np.full(len(at_ns), np.iinfo(np.int64).max)
    held[has] = np.linalg.norm(output.poses.xyz_m[last[has]] - xyz[has], axis=1)
    age_ns[has] = at_ns[has] - stamps[last[has]]
    return OverTime(at_ns, np.linalg.norm(xyz, axis=1), has, age_ns <= limits.max_age_s * 1e9, held, away_ns)


def span_of(run: RunData) -> tuple[tuple[int, int] | None, str]:
    """The time a run is judged over, and where it comes from: the recording's, else truth's, never the output's own."""
    if run.start_ns is not None and run.end_ns is not None:
        return (run.start_ns, run.end_ns), "the recording"
    if run.truth is not None:
        return (int(run.truth.stamps_ns[0]), int(run.truth.stamps_ns[-1])), "the truth"
    return None, "neither the recording's time nor truth is known"


def euler_rpy(R: Array64) -> Array64:
    """Roll, pitch, yaw (n, 3) [rad] of R = Rz(yaw) Ry(pitch) Rx(roll)."""
    roll = np.arctan2(R[:, 2, 1], R[:, 2, 2])
    pitch = np.arcsin(np.clip(-R[:, 2, 0], -1, 1))
    return np.column_stack([roll, pitch, np.arctan2(R[:, 1, 0], R[:, 0, 0])])


def wrap(angle_rad: Array64) -> Array64:
    """To [-pi, pi)."""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def log_rotation(R: Array64) -> Array64:
    """Rotation vectors (n, 3) [rad], also near half a turn."""
    sine = 0.5 * np.column_stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]])
    cosine = 0.5 * (np.trace(R, axis1=1, axis2=2) - 1)
    length = np.linalg.norm(sine, axis=1)
    angle = np.arctan2(length, cosine)
    scale = np.where(length > 1e-9, angle / np.maximum(length, 1e-300), 1.0)
    vectors = sine * scale[:, None]
    for i in np.nonzero((length <= 1e-6) & (cosine < 0))[0]:  # half a turn: the axis is in the symmetric part
        symmetric = 0.5 * (R[i] + np.eye(3))
        axis = symmetric[:, int(np.argmax(np.diagonal(symmetric)))]
        vectors[i] = np.pi * axis / np.linalg.norm(axis)
    return vectors


def pose_error(R: Array64, xyz: Array64, R_true: Array64, xyz_true: Array64) -> Array64:
    """Log of T_estimate^-1 T_true (n, 6), rotation before translation, tangent at the estimated drone (gtsam's)."""
    R_inverse = np.swapaxes(R, 1, 2)
    omega = log_rotation(R_inverse @ R_true)
    t = np.einsum("nij,nj->ni", R_inverse, xyz_true - xyz)
    # inverse of the left Jacobian of SO(3): J^-1 = I - [w]/2 + (1/a^2 - (1 + cos a) / (2 a sin a)) [w]^2
    angle = np.linalg.norm(omega, axis=1)
    small = angle < 1e-4
    a = np.where(small, 1.0, angle)
    half = a / 2
    factor = np.where(small, 1 / 12, (1 - half / np.tan(half)) / a**2)
    first = np.cross(omega, t)
    v = t - 0.5 * first + factor[:, None] * np.cross(omega, first)
    return np.column_stack([omega, v])


def mahalanobis(error: Array64, covariance: Array64) -> Array64:
    """e^T C^-1 e (n,); NaN where C is not positive definite."""
    result = np.full(len(error), np.nan)
    if len(error):
        fine = np.linalg.eigvalsh(covariance)[:, 0] > 0
        result[fine] = np.sum(error[fine] * np.linalg.solve(covariance[fine], error[fine][..., None])[..., 0], axis=1)
    return result


def sigma_along(error: Array64, covariance: Array64) -> Array64:
    """Standard deviation (n,) in the direction of the error; 0 for a covariance that gives none."""
    length = np.linalg.norm(error, axis=1)
    unit = error / np.where(length > 0, length, 1)[:, None]
    variance = np.einsum("ni,nij,nj->n", unit, covariance, unit)
    widest = np.linalg.eigvalsh(covariance)[:, -1] if len(error) else np.zeros(0)
    return np.sqrt(np.maximum(np.where(length > 0, variance, widest), 0))
