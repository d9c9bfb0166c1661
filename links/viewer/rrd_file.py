"""The .rrd on disk. Rerun writes into a pipe, and we write the file: a full disk then is an OSError here and no more.

Source: ours. Measured with Rerun 0.41: once its own file writer has met an error, disconnect() and the interpreter's
exit wait for ever in 4 of 10 runs.
"""

from __future__ import annotations

import os
import threading
from collections import Counter
from io import FileIO
from pathlib import Path

import rerun as rr

PIPE_READ_BYTES = 1 << 20


class RrdFile:
    """Takes what a `FileSink` writes. After a write error the rest is thrown away, and counted once in `errors`."""

    def __init__(self, path: Path, errors: Counter[str]) -> None:
        """Make the file and its folder; raises OSError."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        self._file = path.open("wb", buffering=0)
        self._errors = errors
        self._from_rerun, self._to_us = os.pipe()
        self.sink = rr.FileSink(f"/dev/fd/{self._to_us}")
        self._thread = threading.Thread(target=self._copy, name="viewer file", daemon=True)
        self._thread.start()

    def connected(self) -> None:
        """Rerun has opened the sink, which is an end of the pipe of its own: ours can go."""
        os.close(self._to_us)

    def close(self) -> None:
        """Wait for the last byte; Rerun must have closed its end."""
        self._thread.join()

    def _copy(self) -> None:
        with os.fdopen(self._from_rerun, "rb", buffering=0) as pipe, self._file as file:
            whole = True
            while data := pipe.read(PIPE_READ_BYTES):
                if whole:
                    whole = self._write(file, data)

    def _write(self, file: FileIO, data: bytes) -> bool:
        try:
            view = memoryview(data)
            while view:
                view = view[file.write(view) :]
        except OSError as error:
            self._errors[f"{self._path} ends early: {error.strerror}; what is there: rerun rrd merge"] += 1
            return False
        return True
