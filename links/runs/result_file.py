"""A text file of a run's results, written line by line; a live run goes on though the disk takes no more.

Source: ours.
"""

from __future__ import annotations

import io
from pathlib import Path


class ResultFile:
    """`write` and `close`. `patient`: what the disk does not take is counted in `lost`, else it is OSError."""

    def __init__(self, path: Path, *, patient: bool = False) -> None:
        raw = path.open("wb")
        self._stream = io.TextIOWrapper(raw, encoding="utf-8", newline="", line_buffering=True, write_through=True)
        self._patient = patient
        self.lost = 0
        self.status: str | None = None

    def write(self, text: str) -> int:
        """Line by line, as it comes."""
        try:
            return self._stream.write(text)
        except OSError as error:
            self._failed(error)
            return len(text)

    def close(self) -> None:
        """The last lines, too."""
        try:
            self._stream.close()
        except OSError as error:
            self._failed(error)

    def _failed(self, error: OSError) -> None:
        if not self._patient:
            raise error
        self.lost += 1
        self.status = error.strerror or str(error)
