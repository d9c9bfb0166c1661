"""A live run's recording as one, whether it has one part or several.

Source: ours; recordings/README.md.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from pathlib import Path

from flow.link import LinkError, Record
from links.recording.format import Progress
from links.recording.reader import RecordingReader
from links.recording.recorder import PART, SESSION


def parts_of(path: str | os.PathLike[str]) -> list[Path]:
    """All parts of the run that `path` is the first part of, in order; those of other runs beside it are left out.

    A recording that is no part of a run is its only part. LinkError when `path` is a later part, or one is missing.
    """
    first = Path(path)
    part, found = _beside(first)
    if part != 1:
        name = found[1].name if 1 in found else "which is not beside it"
        raise LinkError(f"{first} is part {part} of its run: a run is taken again from its first part, {name}")
    for number in range(1, max(found) + 1):
        if number not in found:
            raise LinkError(f"{first.parent}: part {number} of this run is missing, there are {len(found)} others")
    return [found[number] for number in sorted(found)]


def parts_from(path: str | os.PathLike[str]) -> tuple[list[Path], list[str]]:
    """What can be read of the run from `path` on without a gap; and in words what of the run that leaves out.

    A first part brings the later ones, up to one that is missing; a later part stands for itself.
    """
    first = Path(path)
    part, found = _beside(first)
    if part != 1:
        return [first], [f"{first.name} is part {part} of its run, and is read alone: name the first part for all"]
    parts: list[Path] = []
    while (number := len(parts) + 1) in found:
        parts.append(found[number])
    left_out = len(found) - len(parts)
    missing = f"part {len(parts) + 1} of the run of {first.name} is missing: the {left_out} after it are not read"
    return parts, [missing] if left_out else []


def other_parts(path: str | os.PathLike[str]) -> str | None:
    """That a recording is one part of several, for those that read one only; None: it is the whole run."""
    first = Path(path)
    part, found = _beside(first)
    return (
        None if len(found) == 1 else f"{first.name} is part {part} of {len(found)} of its run: this one alone is read"
    )


def records_of(
    parts: Collection[Path],
    topics: Collection[str] | None = None,
    progress: Progress | None = None,
    warnings: list[str] | None = None,
) -> Iterator[Record]:
    """The records of all parts, one part after the other; `warnings` get what the readers have to say of each."""
    for path in parts:
        with RecordingReader(path) as reader:
            yield from reader.records(topics, progress=progress)
            if warnings is not None:
                warnings += reader.warnings


def _beside(path: Path) -> tuple[int, dict[int, Path]]:
    """Which part of its run a recording is, and all parts of that run in its folder."""
    session, part = _part(path)
    found = {part: path}
    for other in sorted(path.parent.glob("*.mcap")) if session is not None else ():
        if other != path:
            try:
                whose, number = _part(other)
            except LinkError:
                continue  # no recording that can be read: none of ours
            if whose == session:
                found.setdefault(number, other)
    return part, found


def _part(path: Path) -> tuple[str | None, int]:
    with RecordingReader(path) as reader:
        number = reader.metadata.get(PART, "1")
        return reader.metadata.get(SESSION), int(number) if number.isdecimal() else 1
