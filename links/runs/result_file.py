"""A text file with results of a run, written line by line; a live run continues when the disk is full.

Source: ours.
"""

from __future__ import annotations

import io
from pathlib import Path


class ResultFile:
    """A text file. `tolerant`: failed writes are counted in `lost_writes`; otherwise they raise OSError."""

    def __init__(self, path: Path, *, tolerant: bool = False) -> None:
        raw = path.open("wb")
        self._stream = io.TextIOWrapper(raw, encoding="utf-8", newline="", line_buffering=True, write_through=True)
        self._tolerant = tolerant
        self.lost_writes = 0
        self.status: str | None = None

    def write(self, text: str) -> int:
        """Write and flush text; returns its length."""
        try:
            return self._stream.write(text)
        except OSError as error:
            self._failed(error)
            return len(text)

    def close(self) -> None:
        """Flush and close the file."""
        try:
            self._stream.close()
        except OSError as error:
            self._failed(error)

    def _failed(self, error: OSError) -> None:
        if not self._tolerant:
            raise error
        self.lost_writes += 1
        self.status = error.strerror or str(error)
