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
    session, part = _part(first)
    if session is None:
        return [first]
    found = {part: first}
    for other in sorted(first.parent.glob("*.mcap")):
        if other != first:
            try:
                whose, number = _part(other)
            except LinkError:
                continue  # no recording that can be read: none of ours
            if whose == session:
                found.setdefault(number, other)
    if part != 1:
        name = found[1].name if 1 in found else "which is not beside it"
        raise LinkError(f"{first} is part {part} of its run: a run is taken again from its first part, {name}")
    for number in range(1, max(found) + 1):
        if number not in found:
            raise LinkError(f"{first.parent}: part {number} of this run is missing, there are {len(found)} others")
    return [found[number] for number in sorted(found)]


def records_of(
    parts: Collection[Path], topics: Collection[str] | None = None, progress: Progress | None = None
) -> Iterator[Record]:
    """The records of all parts, one part after the other."""
    for path in parts:
        with RecordingReader(path) as reader:
            yield from reader.records(topics, progress=progress)


def _part(path: Path) -> tuple[str | None, int]:
    with RecordingReader(path) as reader:
        number = reader.metadata.get(PART, "1")
        return reader.metadata.get(SESSION), int(number) if number.isdecimal() else 1
