"""The column `is_drone` of a simulated run's candidate log: 1 or 0, empty at times without truth.

It is written when the run has ended, and reaches no stage.

Source: ours.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from flow.link import LinkError
from links.evaluation.association import EvaluationLimits, drone_labels
from links.evaluation.text_files import read_stamp_ns
from links.runs.results import CANDIDATES_FILE
from links.runs.truth import TruthLog

LABEL = "is_drone"
USED = ("stamp_s", "x_m", "y_m", "z_m")


def label_candidates(folder: Path, truth: TruthLog) -> str:
    """Add the column to the candidate log of a run with truth. Returns why it was not possible, or an empty text."""
    file = folder / CANDIDATES_FILE
    paths = [truth.drone_in_vehicle(number) for number, drone in sorted(truth.drones.items()) if drone.pose]
    if not file.exists() or not (paths or truth.no_drone):
        return ""
    labelled = file.with_suffix(".labelled")
    try:
        rows = list(_used(file))
        stamps_ns, xyz_m = np.array([row[0] for row in rows], dtype=np.int64), np.array([row[1:] for row in rows])
        known, is_drone = drone_labels(stamps_ns, xyz_m.reshape(-1, 3), paths, EvaluationLimits())
        labels = [LABEL, *(str(int(drone)) if sure else "" for sure, drone in zip(known, is_drone, strict=True))]
        with file.open(encoding="utf-8", newline="") as lines, labelled.open("w", encoding="utf-8", newline="") as out:
            out.writelines(f"{line.rstrip()},{label}\r\n" for line, label in zip(lines, labels, strict=True))
        labelled.replace(file)
    except (OSError, ValueError, LinkError) as error:  # a live run may have lost lines to a full disk
        labelled.unlink(missing_ok=True)
        return f"{CANDIDATES_FILE} has no labels: {error}"
    return ""


def _used(file: Path) -> Iterator[tuple[int, float, float, float]]:
    """Stamp [ns] and position [m] of each row."""
    with file.open(encoding="utf-8", newline="") as stream:
        for number, row in enumerate(csv.DictReader(stream), start=2):
            if any(row.get(name) is None for name in USED):
                raise LinkError(f"line {number} is cut off")
            stamp_s, x, y, z = (row[name] for name in USED)
            yield read_stamp_ns(stamp_s, f"line {number}"), float(x), float(y), float(z)
