"""What the truth beside a run says of the vehicle's way and of each drone: its path, its returns, what hid it.

Source: links/runs/truth.py, which writes it; file names in links/runs/results.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flow.link import LinkError
from links.evaluation.tum import NO_DRONE, Trajectory, read_stamp_ns, read_table, read_tum
from links.runs.results import TRUTH_FILE, TRUTH_HITS_FILE, TRUTH_VEHICLE_FILE, TRUTH_VISIBLE_FILE, of_drone

NEVER_NS = np.iinfo(np.int64).max // 2  # the end of what did not end
NO_HITS = "the recording does not say which returns came from the drone"
NO_VISIBLE = "the recording does not say when the drone was hidden"


@dataclass(frozen=True, slots=True)
class TrueDrone:
    """One drone by truth. What is None is not known; `missing` says why, by what it is needed for."""

    path: Trajectory | None = None
    hits_ns: NDArray[np.int64] | None = None  # when it returned a pulse, rising
    hidden_ns: NDArray[np.int64] | None = None  # (m, 2) since when and until when it was hidden from the LiDAR, rising
    missing: dict[str, str] = field(default_factory=dict)


def read_true_drones(folder: Path, truth_file: Path | None) -> tuple[tuple[TrueDrone, ...], bool]:
    """-> every drone, at least one, and whether truth says that there was none. `truth_file` stands for drone 1."""
    path, why, said_empty = _read_path(folder, truth_file)
    drones = [_read_drone(folder, 1, path, why)]
    while truth_file is None and (folder / of_drone(TRUTH_FILE, len(drones) + 1)).exists():
        number = len(drones) + 1
        drones.append(_read_drone(folder, number, read_tum(folder / of_drone(TRUTH_FILE, number)), ""))
    return tuple(drones), said_empty


def read_true_vehicle(folder: Path) -> Trajectory | None:
    """T_world_vehicle; None when the run holds none."""
    path = folder / TRUTH_VEHICLE_FILE
    vehicle = read_tum(path, may_be_empty=True) if path.exists() else None
    return vehicle if vehicle is not None and len(vehicle) else None


def _read_path(folder: Path, truth_file: Path | None) -> tuple[Trajectory | None, str, bool]:
    """-> drone 1's path, why there is none, and whether that is because there was no drone."""
    if truth_file is not None:
        return read_tum(truth_file), "", False
    path = folder / TRUTH_FILE
    if not path.exists():
        return None, "the recording holds no truth (real flight?); give one with --truth FILE.tum", False
    truth = read_tum(path, may_be_empty=True)
    if len(truth):
        return truth, "", False
    said_empty = NO_DRONE in truth.header
    return None, "there was no drone" if said_empty else f"{path} is empty", said_empty


def _read_drone(folder: Path, number: int, path: Trajectory | None, why_no_path: str) -> TrueDrone:
    missing = {"truth": why_no_path} if path is None else {}
    hits_ns = hidden_ns = None
    hits_file, visible_file = (folder / of_drone(name, number) for name in (TRUTH_HITS_FILE, TRUTH_VISIBLE_FILE))
    if hits_file.exists():
        rows = read_table(hits_file, ("stamp_s",))
        hits_ns = np.sort(np.array([read_stamp_ns(row["stamp_s"], where) for where, row in rows], dtype=np.int64))
    else:
        missing["hits"] = NO_HITS
    if visible_file.exists():
        hidden_ns = _read_hidden(visible_file)
    else:
        missing["visible"] = NO_VISIBLE
    return TrueDrone(path, hits_ns, hidden_ns, missing)


def _read_hidden(path: Path) -> NDArray[np.int64]:
    """Spans (m, 2) in which the drone was hidden; one that did not end ends at NEVER_NS."""
    spans: list[list[int]] = []
    hidden = False
    for where, row in read_table(path, ("stamp_s", "visible")):
        if row["visible"] not in ("0", "1"):
            raise LinkError(f"{where}: visible is '{row['visible'][:20]}', neither 0 nor 1")
        stamp_ns, was_hidden, hidden = read_stamp_ns(row["stamp_s"], where), hidden, row["visible"] == "0"
        if hidden and not was_hidden:
            spans.append([stamp_ns, NEVER_NS])
        elif was_hidden and not hidden:
            spans[-1][1] = stamp_ns
    return np.array(spans, dtype=np.int64).reshape(-1, 2)
