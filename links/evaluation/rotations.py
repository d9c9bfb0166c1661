"""The rotations that a run told of both cameras' pictures, as its table holds them.

Source: stages/messages/cameras.py; written by links/runs/results.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flow.link import LinkError
from links.evaluation.associate import Stamps
from links.evaluation.tum import read_number, read_stamp_ns, read_table, symmetric
from links.runs.results import QUATERNION, ROTATION_UPPER
from stages.geometry.frames import Array64, rotations_from_xyzw
from stages.messages import BranchState


@dataclass(frozen=True, slots=True)
class Rotations:
    """What was told, one row for each of the drone's pictures."""

    stamps_ns: Stamps  # (n,)
    accepted: NDArray[np.bool_]  # (n,) False: no rotation was given
    R_vehicle_drone: Array64  # (n, 3, 3) the branch given; the unit where there is none
    covariance_rad2: Array64  # (n, 3, 3) of phi in R exp(phi), the drone's axes; zero where there is none
    resolved: NDArray[np.bool_]  # (n,) said to be the right branch
    switches: NDArray[np.int64]  # (n,) changes of the branch so far

    def __len__(self) -> int:
        return len(self.stamps_ns)


def read_rotations(path: Path) -> Rotations:
    """Read a run's table of rotations. LinkError names the first line that is wrong."""
    stamps: list[int] = []
    accepted: list[bool] = []
    quaternions: list[list[float]] = []
    covariances: list[Array64] = []
    resolved: list[bool] = []
    switches: list[int] = []
    for where, row in read_table(path, ("stamp_s", "accepted", *QUATERNION, *ROTATION_UPPER, "state", "switches")):
        if row["accepted"] not in ("0", "1"):
            raise LinkError(f"{where}: accepted is '{row['accepted'][:20]}', neither 0 nor 1")
        if row["state"] not in BranchState.__members__:
            raise LinkError(f"{where}: state is '{row['state'][:20]}', none of {', '.join(BranchState.__members__)}")
        stamps.append(read_stamp_ns(row["stamp_s"], where))
        accepted.append(row["accepted"] == "1")
        quaternions.append([read_number(row[name], where) for name in QUATERNION] if accepted[-1] else [0, 0, 0, 1])
        measured = accepted[-1] and row[ROTATION_UPPER[0]] != ""
        covariances.append(symmetric([read_number(row[name], where) if measured else 0.0 for name in ROTATION_UPPER]))
        resolved.append(row["state"] == BranchState.RESOLVED.name)
        switches.append(round(read_number(row["switches"], where)))
    quaternion = np.array(quaternions, dtype=np.float64).reshape(-1, 4)
    if not np.linalg.norm(quaternion, axis=1).all():
        raise LinkError(f"{path}: a quaternion is 0 0 0 0, which is no rotation")
    return Rotations(
        np.array(stamps, dtype=np.int64),
        np.array(accepted, dtype=np.bool_),
        rotations_from_xyzw(quaternion),
        np.array(covariances, dtype=np.float64).reshape(-1, 3, 3),
        np.array(resolved, dtype=np.bool_),
        np.array(switches, dtype=np.int64),
    )
