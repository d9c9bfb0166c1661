"""TUM trajectories and tables of covariances as text: read strictly, every complaint with its line.

Source: TUM RGB-D benchmark, file formats (`stamp_s tx ty tz qx qy qz qw`); DESIGN, Outputs of a run.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flow.link import LinkError
from links.runs.results import UPPER
from stages.geometry.frames import Array64

COLUMNS = "stamp_s tx ty tz qx qy qz qw"
POSITION_ONLY, FULL_POSE, NO_DRONE = "position only", "full pose", "no drone"  # words of a header that say what it is
QUATERNION_TOLERANCE = 1e-3
MAX_STAMP_S = 9_000_000_000  # int64 nanoseconds end at 9.2e9 s


@dataclass(frozen=True, slots=True)
class Trajectory:
    """T_vehicle_drone over time. `quaternion_xyzw` is None when it was not measured; `why_no_rotation` says so."""

    path: Path
    stamps_ns: NDArray[np.int64]  # (n,) rising
    xyz_m: Array64  # (n, 3)
    quaternion_xyzw: Array64 | None  # (n, 4) unit
    why_no_rotation: str = ""
    header: str = ""

    def __len__(self) -> int:
        return len(self.stamps_ns)


def read_tum(path: Path, may_be_empty: bool = False, in_order: bool = True) -> Trajectory:
    """Read a TUM file. LinkError names the first line that is wrong and what is wrong with it.

    Stamps must rise, unless `in_order` is False: fixes of several tracks come as they were made.
    """
    header: list[str] = []
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in _lines(path):
        text = line.strip()
        if not text or text.startswith("#"):
            header += [text.lstrip("# ")] if text else []
            continue
        where = f"{path}:{number}"
        words = text.split()
        if len(words) != 8:
            raise LinkError(f"{where}: {len(words)} columns, a TUM line has 8: {COLUMNS}")
        stamp_ns = read_stamp_ns(words[0], where)
        if in_order and stamps and stamp_ns <= stamps[-1]:
            what = "the same stamp as" if stamp_ns == stamps[-1] else "earlier than"
            raise LinkError(f"{where}: {what} the line before it; stamps must rise: sort the file, drop duplicates")
        values = [read_number(word, where) for word in words[1:]]
        length = math.hypot(*values[3:])
        if abs(length - 1) > QUATERNION_TOLERANCE:
            raise LinkError(f"{where}: the quaternion has length {length:.4g}, not 1; columns are {COLUMNS}")
        stamps.append(stamp_ns)
        rows.append(values)
    if not rows and not may_be_empty:
        raise LinkError(f"{path}: no pose in it; a TUM line is: {COLUMNS}")
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    title = " ".join(header)
    quaternion = table[:, 3:] / np.linalg.norm(table[:, 3:], axis=1, keepdims=True)
    why = _why_no_rotation(quaternion, title)
    return Trajectory(
        path, np.array(stamps, dtype=np.int64), table[:, :3].copy(), None if why else quaternion, why, title
    )


def _why_no_rotation(quaternion: Array64, header: str) -> str:
    if POSITION_ONLY in header:
        return "the file says it holds positions only"
    if not len(quaternion):
        return "there is no pose"
    if FULL_POSE not in header and (np.abs(quaternion[:, 3]) == 1).all():
        return (
            f"every quaternion is 0 0 0 1, which stands for 'not measured' (a comment '# {FULL_POSE}' says otherwise)"
        )
    return ""


def read_table(path: Path, needed: tuple[str, ...]) -> Iterator[tuple[str, dict[str, str]]]:
    """Rows of a CSV file with a header: ("file:line", cells by column). LinkError when a column or cell is missing."""
    rows = csv.reader(line for _, line in _lines(path))
    header = next(rows, [])
    missing = [name for name in needed if name not in header]
    if missing:
        raise LinkError(f"{path}:1: no column {', '.join(missing)}; is it a file of `grd run` or `grd replay`?")
    for cells in rows:
        where = f"{path}:{rows.line_num}"
        if len(cells) != len(header):
            raise LinkError(f"{where}: {len(cells)} cells, the header has {len(header)}; is the file cut off?")
        yield where, dict(zip(header, cells, strict=True))


@dataclass(frozen=True, slots=True)
class MatrixRow:
    """One line of a table of covariances."""

    where: str  # "file:line"
    stamp_ns: int
    matrix: Array64  # symmetric
    cells: dict[str, str]  # by column


def read_matrices(path: Path, size: int) -> list[MatrixRow]:
    """The lines of a CSV of upper triangles (`upper_names`), in their order."""
    names = upper_names(size)
    found: list[MatrixRow] = []
    for where, row in read_table(path, ("stamp_s", *names)):
        stamp_ns = read_stamp_ns(row["stamp_s"], where)
        found.append(MatrixRow(where, stamp_ns, symmetric([read_number(row[name], where) for name in names]), row))
    return found


def symmetric(upper: Sequence[float]) -> Array64:
    """The matrix of an upper triangle by rows: n (n + 1) / 2 numbers."""
    size = round((math.sqrt(8 * len(upper) + 1) - 1) / 2)
    matrix = np.zeros((size, size))
    matrix[np.triu_indices(size)] = upper
    return matrix + np.triu(matrix, 1).T


def upper_names(size: int) -> tuple[str, ...]:
    """Columns of an upper triangle by rows: a position's (3) or a pose's (6), rotation [rad] before translation [m]."""
    if size == 3:
        return tuple(f"c{name}_m2" for name in UPPER)
    return tuple(f"c{a}{b}" for a in range(size) for b in range(a, size))


def read_stamp_ns(word: str, where: str) -> int:
    """Decimal seconds as nanoseconds, exactly."""
    try:
        value = Decimal(word)
    except InvalidOperation:
        raise LinkError(f"{where}: stamp '{word[:40]}' is no number") from None
    if not value.is_finite() or abs(value) > MAX_STAMP_S:
        raise LinkError(f"{where}: stamp {word[:40]} is no time in seconds; are these nanoseconds?")
    return round(value.scaleb(9))


def read_number(word: str, where: str) -> float:
    """A finite number."""
    try:
        value = float(word)
    except ValueError:
        raise LinkError(f"{where}: '{word[:40]}' is no number") from None
    if not math.isfinite(value):
        raise LinkError(f"{where}: {word} is not finite")
    return value


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    try:
        with path.open(encoding="utf-8", newline=None) as stream:
            yield from enumerate(stream, start=1)
    except UnicodeDecodeError as error:
        raise LinkError(
            f"{path}: not a text file (byte {error.start}); a TUM file or a run's folder is wanted"
        ) from None
