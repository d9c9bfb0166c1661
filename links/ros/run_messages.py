"""The results in a run's folder as ROS 2 messages: fused poses, LiDAR positions, transforms and diagnostics.

`/grd/pose` and `/grd/odometry` are the drone in frame `vehicle`; an unknown rotation is the identity with a variance of
pi^2 rad^2 about each axis. A transform has no covariance: `/tf` has none while the rotation is unknown. `/grd/position`
is the LiDAR's alone. Recorded at the time of measurement.

Source: the run's files (`links/runs/results.py`); ROS 2 common_interfaces.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from flow.link import LinkError
from links.evaluation.text_files import Trajectory, read_tum
from links.ros.mapping import POSE
from links.ros.message_types import header
from links.ros.recording_messages import TF, Entry, fixed_covariance, pose_values, transform_values
from links.runs.results import (
    COVARIANCE_FILE,
    FIX_FILE,
    POSE_COVARIANCE_FILE,
    POSE_FILE,
    POSE_UPPER,
    UNKNOWN_RAD2,
    UPPER,
)

POSE_MESSAGE, DIAGNOSTICS = "geometry_msgs/msg/PoseWithCovarianceStamped", "diagnostic_msgs/msg/DiagnosticArray"
OK, WARN = 0, 1  # DiagnosticStatus
UNKNOWN = (0.0, 0.0, 0.0, 1.0)
_SHOWN = ("accepted", "rotation", "resets", "nis", "measured_s", "track_id")


def run_messages(folder: Path, *, whole: bool) -> Iterator[Entry]:
    """Messages of a run. LinkError where the folder has no poses or positions; `whole`: it is all that is exported."""
    found = False
    if (folder / POSE_FILE).is_file():
        for entry in _poses(folder):
            found = True
            yield entry
    if (folder / FIX_FILE).is_file():
        for entry in _positions(folder):
            found = True
            yield entry
    if whole and not found:
        raise LinkError(f"{folder}: no pose and no position: is it a run's folder (grd run, grd replay)?")


def _poses(folder: Path) -> Iterator[Entry]:
    """A pose, an odometry and a diagnosis for each fused pose, and a transform where its rotation is known."""
    poses, rows = _pairs(folder, POSE_FILE, POSE_COVARIANCE_FILE)
    upper = np.triu_indices(6)
    for k, row in enumerate(rows):
        at_ns, xyz_m = int(poses.stamps_ns[k]), poses.xyz_m[k]
        q = UNKNOWN if poses.quaternion_xyzw is None else tuple(poses.quaternion_xyzw[k].tolist())
        covariance = np.zeros((6, 6))
        covariance[upper] = [float(row[name]) for name in POSE_UPPER]
        covariance += np.triu(covariance, 1).T
        pose = {"pose": pose_values(xyz_m, q), "covariance": fixed_covariance(covariance, q)}
        yield "/grd/pose", POSE_MESSAGE, at_ns, {"header": header(at_ns, "vehicle"), "pose": pose}
        yield (
            "/grd/odometry",
            POSE,
            at_ns,
            {
                "header": header(at_ns, "vehicle"),
                "child_frame_id": "drone",
                "pose": pose,
                "twist": {"covariance": [-1.0] + 35 * [0.0]},  # not known
            },
        )
        if row["rotation"] == "1":
            yield "/tf", TF, at_ns, transform_values(at_ns, "vehicle", "drone", xyz_m, q)
        yield "/diagnostics", DIAGNOSTICS, at_ns, _diagnosis(at_ns, row)


def _positions(folder: Path) -> Iterator[Entry]:
    """A pose without rotation for each position of the LiDAR."""
    fixes, rows = _pairs(folder, FIX_FILE, COVARIANCE_FILE)
    upper = np.triu_indices(3)
    for k, row in enumerate(rows):
        at_ns = int(fixes.stamps_ns[k])
        block = np.zeros((3, 3))
        block[upper] = [float(row[f"c{name}_m2"]) for name in UPPER]
        covariance = np.diag([0.0] * 3 + [UNKNOWN_RAD2] * 3)
        covariance[:3, :3] = block + np.triu(block, 1).T
        pose = {"pose": pose_values(fixes.xyz_m[k], UNKNOWN), "covariance": covariance.ravel()}
        yield "/grd/position", POSE_MESSAGE, at_ns, {"header": header(at_ns, "vehicle"), "pose": pose}


def _diagnosis(at_ns: int, row: dict[str, str]) -> dict[str, Any]:
    state = row["state"]
    status = {
        "level": OK if state == "FULL" else WARN,
        "name": "grd: pose",
        "message": state,
        "hardware_id": "grd",
        "values": [{"key": name, "value": row.get(name, "")} for name in _SHOWN],
    }
    return {"header": header(at_ns), "status": [status]}


def _pairs(folder: Path, tum: str, table: str) -> tuple[Trajectory, list[dict[str, str]]]:
    """The poses of a TUM file and the rows of its table; LinkError when they do not belong together."""
    poses = read_tum(folder / tum, may_be_empty=True, in_order=False)
    with (folder / table).open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    if len(rows) != len(poses):
        raise LinkError(f"{folder}: {tum} has {len(poses)} lines and {table} {len(rows)}: was the run interrupted?")
    return poses, rows
