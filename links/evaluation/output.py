"""One output of a run as its files tell it: poses, their covariances, which track each is of.

Source: DESIGN, Outputs of a run; written by links/runs/results.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flow.link import LinkError
from links.evaluation.tum import MatrixRow, Trajectory, read_matrices, read_tum
from stages.geometry.frames import Array64


@dataclass(frozen=True, slots=True)
class Output:
    """One output of a run over time, with what the run itself says about how good each is."""

    name: str  # "fix": the LiDAR's; "pose": fused; "file": a lone TUM file
    poses: Trajectory
    covariance: Array64 | None = None  # (n, 3, 3) [m2] vehicle axes, or (n, 6, 6) rotation first, tangent at the drone
    why_no_covariance: str = ""
    good: NDArray[np.bool_] | None = None  # (n,) what the run marked good; None: it marks nothing
    hits: NDArray[np.int64] | None = None  # (n,) returns used
    track: NDArray[np.int64] | None = None  # (n,) which track; None: the run has one only
    swaps: int | None = None  # how often its tracks went over to another drone; None: there was one drone
    rotated: NDArray[np.bool_] | None = None  # (n,) whether the rotation is known; None: the run does not say


def read_output(name: str, poses_file: Path, covariance_file: Path, size: int) -> Output:
    """Poses with what belongs to each line, by the order of time. Fixes of several tracks may share a stamp."""
    if not covariance_file.exists():
        poses = read_tum(poses_file, may_be_empty=True)
        return Output(name, poses, why_no_covariance=f"the run has no {covariance_file.name}")
    found: dict[tuple[int, int], MatrixRow] = {}
    for row in read_matrices(covariance_file, size):
        found[_next_key(found, row.stamp_ns)] = row
    tracks = [_whole(row, "track_id") for row in found.values() if "track_id" in row.cells]
    poses = read_tum(poses_file, may_be_empty=True, in_order=len(set(tracks)) < 2)
    asked: dict[tuple[int, int], MatrixRow | None] = {}
    for stamp in poses.stamps_ns.tolist():
        key = _next_key(asked, stamp)
        asked[key] = found.get(key)
    order = np.argsort(poses.stamps_ns, kind="stable")
    q = poses.quaternion_xyzw
    poses = replace(
        poses,
        stamps_ns=poses.stamps_ns[order],
        xyz_m=poses.xyz_m[order],
        quaternion_xyzw=None if q is None else q[order],
    )
    rows = [row for row in asked.values() if row is not None]
    if len(rows) < len(asked):
        why = f"{len(asked) - len(rows)} of {len(asked)} lines of {poses_file.name} have none in {covariance_file.name}"
        return Output(name, poses, why_no_covariance=why)
    rows = [rows[i] for i in order]
    covariance = np.array([row.matrix for row in rows]).reshape(-1, size, size)
    good = hits = track = rotated = None
    if rows and "good" in rows[0].cells:
        good = np.array([row.cells["good"].strip().lower() in {"1", "true"} for row in rows])
    if rows and "rotation" in rows[0].cells:
        rotated = np.array([row.cells["rotation"].strip() == "1" for row in rows])
    if rows and "hits" in rows[0].cells:
        hits = np.array([_whole(row, "hits") for row in rows], dtype=np.int64)
    if rows and "track_id" in rows[0].cells:
        track = np.array([_whole(row, "track_id") for row in rows], dtype=np.int64)
    return Output(name, poses, covariance, "", good, hits, track, rotated=rotated)


def _next_key(taken: Mapping[tuple[int, int], object], stamp_ns: int) -> tuple[int, int]:
    """A stamp and how often it came before: tracks may share a stamp, and both files have them in one order."""
    count = 0
    while (stamp_ns, count) in taken:
        count += 1
    return stamp_ns, count


def _whole(row: MatrixRow, column: str) -> int:
    word = row.cells[column].strip()
    if not word.isdigit():
        raise LinkError(f"{row.where}: {column} '{word[:20]}' is no whole number")
    return int(word)
