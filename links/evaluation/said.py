"""What a detector said may be a drone, and with what probability, look by look.

Source: ours; the file's name and columns in links/runs/results.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from links.evaluation.tum import read_number, read_stamp_ns, read_table
from stages.geometry.frames import Array64


@dataclass(frozen=True, slots=True)
class Said:
    """Things that a detector gave a probability to, look by look, in the order of being told."""

    stamps_ns: NDArray[np.int64]  # (n,)
    thing: NDArray[np.int64]  # (n,) from 0, the same for all looks at one
    probability: Array64  # (n,)
    xyz_m: Array64  # (n, 3) vehicle frame


def read_said(path: Path) -> Said:
    """A run's table of candidates. LinkError when it is damaged."""
    numbers: dict[tuple[str, str], int] = {}
    rows: list[tuple[int, int, list[float]]] = []
    columns = ("probability", "x_m", "y_m", "z_m")
    for where, row in read_table(path, ("stamp_s", "candidate", "detector_life", *columns)):
        thing = numbers.setdefault((row["detector_life"], row["candidate"]), len(numbers))
        rows.append((read_stamp_ns(row["stamp_s"], where), thing, [read_number(row[name], where) for name in columns]))
    told = np.array([values for _, _, values in rows]).reshape(-1, len(columns))
    stamps, things = (np.array([row[k] for row in rows], dtype=np.int64) for k in (0, 1))
    return Said(stamps, things, told[:, 0], told[:, 1:])
