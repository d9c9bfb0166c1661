"""A live run's recording as one, whether it has one part or several.

Parts are identified by their metadata (run and number), not by their names. Warnings list parts that are not read.

Source: ours; recordings/README.md.
"""

from __future__ import annotations

import os
import re
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from heapq import heappop, heappush, heapreplace
from pathlib import Path

from flow.link import LinkError, Record
from flow.live.input_order import END_TOPIC
from links.recording.format import Progress
from links.recording.reader import RecordingReader
from links.recording.recorder import PART, SESSION


@dataclass(frozen=True, slots=True)
class _Part:
    """One file of a recording, from its index."""

    path: Path
    run: str | None  # None: of no live run
    number: int  # from 1
    start_ns: int
    end_ns: int
    size: int  # [bytes]
    stops_short: bool  # it was closed, but is not where the run ended in order


class Session:
    """A recording with all parts of its run, read as one: `for record in Session("flight.mcap").records(): ...`.

    The first part stands for all. A later one that is named is read alone, and a part that is missing is left out, both
    with a warning; with `whole` they are a LinkError. Files are open only while records are read.
    """

    def __init__(self, path: str | os.PathLike[str], *, whole: bool = False) -> None:
        self.path = Path(path)
        self.warnings: list[str] = []
        """What is not read, and why; `records` adds to it."""
        with RecordingReader(self.path) as reader:
            named = _part(reader)
            self.rig_yaml, self.config_yaml = reader.rig_yaml, reader.config_yaml
            self._note(reader.warnings)
        found = {named.number: named}
        if named.run is not None:
            found_warnings = self._find_other_parts(named, found)
            self._note(found_warnings if named.number == 1 else [])
        self.known = len(found)
        """Parts of the run that are there."""
        if named.number != 1:
            self._report_later_part(named, found, whole)
            found = {named.number: named}
        elif missing := sorted(set(range(1, max(found))) - set(found)):
            self._report_missing(missing, len(found), whole)
        self._parts = [found[number] for number in sorted(found)]
        last = self._parts[-1]
        if named.number == 1 and last.stops_short:
            text = "the last part here, and the run did not end in it: is one missing, or was the disk full?"
            self._note([f"{last.path}: {text}"])
        spans = [(part.start_ns, part.end_ns) for part in self._parts if part.end_ns] or [(0, 0)]
        self.start_ns, self.end_ns = min(start for start, _ in spans), max(end for _, end in spans)

    @property
    def parts(self) -> list[Path]:
        """The files that are read, in order."""
        return [part.path for part in self._parts]

    def records(self, topics: Collection[str] | None = None, *, progress: Progress | None = None) -> Iterator[Record]:
        """All records, or those of `topics`, by arrival; of several parts as if they were one file."""
        return _merged(self._parts, topics, progress, self._note)

    def _note(self, warnings: Sequence[str]) -> None:
        self.warnings += [text for text in warnings if text not in self.warnings]

    def _find_other_parts(self, named: _Part, found: dict[int, _Part]) -> list[str]:
        """Find the other parts in the folder; returns their warnings and those for other files named like a part."""
        warnings_of_others: list[str] = []
        alike = re.compile(rf"{re.escape(named.path.stem)}-\d+\.mcap")
        for path in sorted(named.path.parent.glob("*.mcap")):
            if path == named.path:
                continue
            try:
                with RecordingReader(path) as reader:
                    part, warnings = _part(reader), reader.warnings
            except LinkError as error:
                if alike.fullmatch(path.name):
                    warnings_of_others.append(f"left out: {error}")
                continue
            if part.run == named.run:
                if found.setdefault(part.number, part) is part:
                    warnings_of_others += warnings
            elif alike.fullmatch(path.name):
                warnings_of_others.append(f"{path} is of another run than {named.path.name}: left out")
        return warnings_of_others

    def _report_later_part(self, named: _Part, found: dict[int, _Part], whole: bool) -> None:
        first = found[1].path.name if 1 in found else "which is not in the folder"
        text = f"{named.path} is part {named.number} of its run"
        if whole:
            raise LinkError(f"{text}: replay the run from its first part, {first}")
        self._note([f"{text}, and read alone; all parts are read where the first is named, {first}"])

    def _report_missing(self, missing: list[int], there: int, whole: bool) -> None:
        numbers = ", ".join(map(str, missing))
        text = f"{self.path.parent}: part {numbers} of this run is missing, there are {there} others"
        if whole:
            raise LinkError(text)
        self._note([f"{text}: what it held is left out"])


def _part(reader: RecordingReader) -> _Part:
    run, number = reader.metadata.get(SESSION), reader.metadata.get(PART, "1")
    return _Part(
        path=reader.path,
        run=run,
        number=int(number) if number.isdecimal() else 1,
        start_ns=reader.start_ns,
        end_ns=reader.end_ns,
        size=reader.path.stat().st_size,
        stops_short=run is not None and reader.finished and END_TOPIC not in reader.topics,
    )


def _merged(
    parts: Sequence[_Part], topics: Collection[str] | None, progress: Progress | None, note: Callable[[list[str]], None]
) -> Iterator[Record]:
    """Records by (arrival, part, sequence). A part is opened when one at or after its start is due.

    Several threads write while parts change: a record in the later part may have arrived first.
    """
    waiting = deque(sorted(parts, key=lambda part: (part.start_ns, part.number)))
    done, whole = dict.fromkeys((part.number for part in parts), 0), sum(part.size for part in parts)

    def stepper(part: _Part) -> Progress:
        def step(read: int, of: int) -> None:
            done[part.number] = part.size * read // of
            if progress is not None:
                progress(sum(done.values()), whole)

        return step

    heap: list[tuple[int, int, Record, Iterator[Record]]] = []  # arrival and part of the record that is next
    with ExitStack() as stack:
        while waiting or heap:
            while waiting and (not heap or waiting[0].start_ns <= heap[0][0]):
                part = waiting.popleft()
                records = stack.enter_context(closing(_read(part.path, topics, stepper(part), note)))
                if (first := next(records, None)) is not None:
                    heappush(heap, (first.arrival_ns, part.number, first, records))
            if not heap:
                continue
            _, number, record, records = heap[0]
            yield record
            after = next(records, None)
            if after is None:
                heappop(heap)
            else:
                heapreplace(heap, (after.arrival_ns, number, after, records))


def _read(
    path: Path, topics: Collection[str] | None, progress: Progress, note: Callable[[list[str]], None]
) -> Generator[Record]:
    """Records of one part; `note` receives the warnings."""
    with RecordingReader(path) as reader:
        yield from reader.records(topics, progress=progress)
        note(reader.warnings)
