"""The MAVLink frames of a telemetry log (.tlog).

The time in the log is used as arrival and as stamp: no better time is known.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import IO

from flow.link import Record
from links.importing.imported_file import AUTOPILOT, ImportedFile
from links.importing.tlog import TlogReport, read_frames


class TelemetryLog(ImportedFile):
    """The MAVLink frames of a telemetry log."""

    def __init__(self, stream: IO[bytes], source: Path) -> None:
        self._stream = stream
        self._source = source
        self._report = TlogReport()

    def records(self) -> Iterator[Record]:
        """See ImportedFile."""
        for time_ns, frame in read_frames(self._stream, self._source, self._report):
            yield Record(AUTOPILOT, time_ns, time_ns, frame)

    def done_bytes(self) -> int:
        """See ImportedFile."""
        return self._report.done_bytes

    def skipped(self) -> dict[str, int]:
        """See ImportedFile."""
        return {"bytes that are no MAVLink frame": self._report.bad_bytes} if self._report.bad_bytes else {}

    def warnings(self) -> list[str]:
        """See ImportedFile."""
        return self._report.warnings

    def nothing_found(self) -> str:
        """See ImportedFile."""
        return f"{self._source}: no MAVLink frame in {self._report.done_bytes} bytes: is it a telemetry log (.tlog)?"
