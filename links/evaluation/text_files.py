"""Strict readers of TUM trajectories and CSV tables: an error names the file, the line and the cell.

Source: TUM RGB-D benchmark, file formats (`stamp_s tx ty tz qx qy qz qw`); CSV columns in links/runs/results.py.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flow.link import LinkError
from stages.geometry.frames import Array64

COLUMNS = "stamp_s tx ty tz qx qy qz qw"
POSITION_ONLY, FULL_POSE, NO_DRONE = "position only", "full pose", "no drone"  # marks in the header of a TUM file
QUATERNION_TOLERANCE = 1e-3
MAX_STAMP_S = 9_000_000_000  # int64 nanoseconds end at 9.2e9 s
Stamps = NDArray[np.int64]
Flags = NDArray[np.bool_]
Rows = NDArray[np.int64] | Flags


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses over time. `quaternion_xyzw` is None when the rotation was not measured, see `why_no_rotation`."""

    path: Path
    stamps_ns: Stamps  # (n,) rising
    xyz_m: Array64  # (n, 3)
    quaternion_xyzw: Array64 | None  # (n, 4) unit
    why_no_rotation: str = ""
    header: str = ""

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def take(self, rows: Rows) -> Trajectory:
        """The poses of some rows, in that order."""
        q = None if self.quaternion_xyzw is None else self.quaternion_xyzw[rows]
        return replace(self, stamps_ns=self.stamps_ns[rows], xyz_m=self.xyz_m[rows], quaternion_xyzw=q)


def read_tum(path: Path, may_be_empty: bool = False, in_order: bool = True) -> Trajectory:
    """Read a TUM file. LinkError names the first wrong line.

    Stamps must rise, unless `in_order` is False: fixes of several tracks are written as they are made.
    """
    header: list[str] = []
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in _lines(path):
        where, text = f"{path}:{number}", line.strip()
        if not text or text.startswith("#"):
            header += [text.lstrip("# ")] if text else []
            continue
        cells = text.split()
        if len(cells) != 8:
            raise LinkError(f"{where}: {len(cells)} columns, a TUM line has 8: {COLUMNS}")
        stamp_ns, values = read_stamp_ns(cells[0], where), [_number(cell, where) for cell in cells[1:]]
        if in_order and stamps and stamp_ns <= stamps[-1]:
            what = "the same stamp as" if stamp_ns == stamps[-1] else "earlier than"
            raise LinkError(f"{where}: {what} the line before it; stamps must rise: sort the file, drop duplicates")
        length = math.hypot(*values[3:])
        if abs(length - 1) > QUATERNION_TOLERANCE:
            raise LinkError(f"{where}: the quaternion has length {length:.4g}, not 1; columns are {COLUMNS}")
        stamps.append(stamp_ns)
        rows.append(values)
    if not rows and not may_be_empty:
        raise LinkError(f"{path}: no pose in it; a TUM line is: {COLUMNS}")
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    xyz_m, quaternion = table[:, :3].copy(), table[:, 3:] / np.linalg.norm(table[:, 3:], axis=1, keepdims=True)
    title = " ".join(header)
    why = _why_no_rotation(quaternion, title)
    return Trajectory(path, np.array(stamps, dtype=np.int64), xyz_m, None if why else quaternion, why, title)


def _why_no_rotation(quaternion: Array64, header: str) -> str:
    """Why the file holds no rotations; empty when it does."""
    if POSITION_ONLY in header:
        return "the header of the file declares positions only"
    if not len(quaternion):
        return "there is no pose"
    if FULL_POSE not in header and (np.abs(quaternion[:, 3]) == 1).all():
        return f"every quaternion is 0 0 0 1, which means 'not measured' (unless the header has '# {FULL_POSE}')"
    return ""


class TextTable:
    """A CSV file with a header, as text by column. Methods convert a column; LinkError names the first wrong line."""

    def __init__(self, path: Path, needed: Sequence[str]) -> None:
        """Read the file. LinkError when a column is missing or a row has too many or too few cells."""
        rows = csv.reader(line for _, line in _lines(path))
        header = next(rows, [])
        if missing := [name for name in needed if name not in header]:
            raise LinkError(f"{path}:1: no column {', '.join(missing)}; is it a file of `grd run` or `grd replay`?")
        self._where: list[str] = []
        self._columns: dict[str, list[str]] = {name: [] for name in header}
        for cells in rows:
            where = f"{path}:{rows.line_num}"
            if len(cells) != len(header):
                raise LinkError(f"{where}: {len(cells)} cells, the header has {len(header)}; is the file cut off?")
            self._where.append(where)
            for name, cell in zip(header, cells, strict=True):
                self._columns[name].append(cell)

    def __contains__(self, name: str) -> bool:
        return name in self._columns

    def text(self, name: str) -> list[str]:
        """A column as it is in the file."""
        return self._columns[name]

    def filled(self, name: str) -> Flags:
        """The rows (n,) in which a column is not empty."""
        return np.array([cell != "" for cell in self._columns[name]], dtype=np.bool_)

    def stamps_ns(self, name: str) -> Stamps:
        """A column of decimal seconds (n,) [ns]."""
        return np.array([read_stamp_ns(cell, where) for cell, where in self._cells(name)], dtype=np.int64)

    def numbers(self, names: Sequence[str], rows: Flags | None = None) -> Array64:
        """Columns of finite numbers (n, k); where `rows` is False the result is zero and the file is not read."""
        result = np.zeros((len(self._where), len(names)))
        for column, name in enumerate(names):
            for row, (cell, where) in enumerate(self._cells(name)):
                if rows is None or rows[row]:
                    result[row, column] = _number(cell, where)
        return result

    def symmetric(self, names: Sequence[str], rows: Flags | None = None) -> Array64:
        """Symmetric matrices (n, size, size) from the columns of their upper triangles by rows."""
        upper = self.numbers(names, rows)
        size = round((math.sqrt(8 * len(names) + 1) - 1) / 2)
        matrices = np.zeros((len(upper), size, size))
        i, j = np.triu_indices(size)
        matrices[:, i, j] = matrices[:, j, i] = upper
        return matrices

    def whole_numbers(self, name: str) -> NDArray[np.int64]:
        """A column of whole numbers (n,), 0 or larger."""
        for cell, where in self._cells(name):
            if not cell.strip().isdecimal():
                raise LinkError(f"{where}: {name} '{cell[:20]}' is not a whole number")
        return np.array(self._columns[name], dtype=np.int64)

    def equals(self, name: str, value: str, allowed: Sequence[str] = ("0", "1")) -> Flags:
        """Where a column (n,) that holds nothing but the allowed texts has a value."""
        for cell, where in self._cells(name):
            if cell not in allowed:
                raise LinkError(f"{where}: {name} is '{cell[:20]}', not one of {', '.join(allowed)}")
        return np.array([cell == value for cell in self._columns[name]], dtype=np.bool_)

    def _cells(self, name: str) -> Iterator[tuple[str, str]]:
        return zip(self._columns[name], self._where, strict=True)


def read_stamp_ns(text: str, where: str) -> int:
    """Decimal seconds as nanoseconds, exactly."""
    try:
        value = Decimal(text)
    except InvalidOperation:
        raise LinkError(f"{where}: stamp '{text[:40]}' is not a number") from None
    if not value.is_finite() or abs(value) > MAX_STAMP_S:
        raise LinkError(f"{where}: stamp {text[:40]} is not a time in seconds; is it in nanoseconds?")
    return round(value.scaleb(9))


def _number(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise LinkError(f"{where}: '{text[:40]}' is not a number") from None
    if not math.isfinite(value):
        raise LinkError(f"{where}: {text} is not finite")
    return value


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    try:
        with path.open(encoding="utf-8", newline=None) as stream:
            yield from enumerate(stream, start=1)
    except UnicodeDecodeError as error:
        text = f"{path}: not a text file (byte {error.start}); expected a TUM file or the folder of a run"
        raise LinkError(text) from None
