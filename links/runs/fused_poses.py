"""The fused poses of a run, read back from its files, and their errors against the truth.

The poses are read whole at the end of the run; during a run they are in its files only.

Source: ours; files in links/runs/results.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from links.evaluation.association import bracket, follow
from links.runs.results import POSE_COVARIANCE_FILE, POSE_FILE, POSE_UPPER, UPPER_6
from links.runs.truth import CHI2_95_3, MAX_GAP_NS, TruthLog

if TYPE_CHECKING:  # scipy is imported when a run has ended
    from scipy.spatial.transform import Rotation

Array64 = NDArray[np.float64]
FULL = ("FULL", "COASTING")  # states with a position and a rotation


@dataclass(frozen=True, slots=True)
class FusedPoses:
    """n poses with a known position. Angles and errors are NaN where the rotation or the truth is not known."""

    stamps_ns: NDArray[np.int64]
    state: NDArray[np.str_]
    xyz_m: Array64  # (n, 3) vehicle axes
    yaw_rad: Array64
    sigma_m: Array64  # root of the position covariance's trace
    sigma_rad: Array64  # root of the rotation covariance's trace
    error_m: Array64  # (n, 3) pose - truth, vehicle axes
    angle_rad: Array64  # between the pose's rotation and the true one
    nees: Array64  # of the position; 3 on average when the covariance is consistent

    @property
    def full(self) -> NDArray[np.bool_]:
        """Poses with a rotation (n,)."""
        return np.isin(self.state, FULL)

    @property
    def rmse_xyz_m(self) -> Array64:
        """Root mean square error of the position per axis (3,), of all poses with truth."""
        return np.sqrt(np.nanmean(self.error_m**2, axis=0))

    @property
    def distance_m(self) -> Array64:
        """Distance from the true position (n,)."""
        return np.linalg.norm(self.error_m, axis=1)

    @property
    def has_truth(self) -> bool:
        """Whether the truth is known for any pose."""
        return bool(np.isfinite(self.error_m).any())

    @property
    def inside_95(self) -> float:
        """Share of positions whose 95 % ellipsoid contains the truth."""
        return float(np.mean(self.nees[np.isfinite(self.nees)] <= CHI2_95_3))


def read_fused_poses(folder: Path, truth: TruthLog) -> FusedPoses | None:
    """The poses in the folder of a run; None when there are none, or a full disk has cut the files off."""
    from scipy.spatial.transform import Rotation

    try:
        lines = (folder / POSE_FILE).read_text("utf-8").splitlines()[1:]
        head, *rows = (folder / POSE_COVARIANCE_FILE).read_text("utf-8").splitlines()
        if not lines or len(lines) != len(rows):
            return None
        poses = np.loadtxt(lines, usecols=range(1, 8), ndmin=2)
        table = np.loadtxt(rows, dtype=str, delimiter=",", ndmin=2)
        of = dict(zip(head.split(","), table.T, strict=True))
    except (FileNotFoundError, ValueError):
        return None
    stamps_ns = np.array([int(text.replace(".", "")) for text in of["stamp_s"]], dtype=np.int64)
    covariance = np.zeros((len(poses), 6, 6))
    upper = np.stack([of[name] for name in POSE_UPPER], axis=1).astype(np.float64)
    covariance[:, UPPER_6[0], UPPER_6[1]] = covariance[:, UPPER_6[1], UPPER_6[0]] = upper
    rotated = of["rotation"] == "1"
    R = Rotation.from_quat(poses[:, 3:])
    position = R.as_matrix() @ covariance[:, 3:, 3:] @ np.swapaxes(R.as_matrix(), 1, 2)  # to vehicle axes
    error_m, angle_rad = _errors(stamps_ns, poses[:, :3], R, of["track_id"].astype(np.int64), truth)
    unknown = np.where(rotated, 1.0, np.nan)
    return FusedPoses(
        stamps_ns=stamps_ns,
        state=of["state"],
        xyz_m=poses[:, :3],
        yaw_rad=unknown * R.as_euler("ZYX")[:, 0],
        sigma_m=np.sqrt(np.trace(position, axis1=1, axis2=2)),
        sigma_rad=unknown * np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2)),
        error_m=error_m,
        angle_rad=unknown * angle_rad,
        nees=np.einsum("ni,ni->n", error_m, np.linalg.solve(position, error_m[..., None])[..., 0]),
    )


def _errors(
    stamps_ns: NDArray[np.int64], xyz_m: Array64, R: Rotation, tracks: NDArray[np.int64], truth: TruthLog
) -> tuple[Array64, Array64]:
    """Errors of the positions (n, 3) and of the rotations (n,), against the drone that each track follows."""
    from scipy.spatial.transform import Rotation

    error_m, angle_rad = np.full((len(xyz_m), 3), np.nan), np.full(len(xyz_m), np.nan)
    numbers = [number for number, drone in sorted(truth.drones.items()) if drone.pose]
    paths = [truth.drone_in_vehicle(number) for number in numbers]
    if not any(len(path[0]) for path in paths):
        return error_m, angle_rad
    followed = follow(stamps_ns, xyz_m, tracks, paths, MAX_GAP_NS).drone
    for index, (number, (true_ns, true_m)) in enumerate(zip(numbers, paths, strict=True)):
        own = np.flatnonzero(followed == index)
        between = bracket(stamps_ns[own], true_ns, MAX_GAP_NS)
        rows, before, after = own[between.known], between.before[between.known], between.after[between.known]
        weight = between.weight[between.known][:, None]
        error_m[rows] = xyz_m[rows] - ((1 - weight) * true_m[before] + weight * true_m[after])
        true_xyzw = truth.rotation_in_vehicle(number)
        R_before, R_after = Rotation.from_quat(true_xyzw[before]), Rotation.from_quat(true_xyzw[after])
        between_R = R_before * Rotation.from_rotvec(weight * (R_before.inv() * R_after).as_rotvec())
        angle_rad[rows] = (Rotation.from_quat(R.as_quat()[rows]).inv() * between_R).magnitude()
    return error_m, angle_rad


def rms(values: Array64) -> float:
    """Root mean square of the values that are not NaN; NaN if there is none."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
