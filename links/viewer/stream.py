"""The Rerun recording of one run: a file, a server on the loopback interface, one timeline. Used by one thread only.

Rerun writes the recording into a pipe, and `RrdFile` copies the pipe to the file, so a full disk is an OSError here.
With Rerun 0.41, once its own file writer has met an error, disconnect() and the exit of the interpreter can block for
ever.

Source: ours, for the API of Rerun 0.41; DESIGN, Links.
"""

from __future__ import annotations

import os
import socket
import threading
from collections import Counter
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from links.viewer.entities import Curve, Entity
from links.viewer.scene import TIMELINE
from stages.geometry.frames import Array64

APPLICATION = "grd"
LOOPBACK = "127.0.0.1"
CURVE_BATCH_NS = (
    500_000_000  # of curves are written as columns; row by row they would cost more than all other entities
)
EPOCH_FROM_NS = 10**17  # stamps above count from 1970 (1973 and later), stamps below from an arbitrary start
PIPE_READ_BYTES = 1 << 20


class Stream:
    """A Rerun stream that continues when a sink fails. Failures to write or serve are counted in `errors`."""

    def __init__(
        self, file: Path | None, port: int | None, memory_limit: str, errors: Counter[str], blueprint: rrb.Blueprint
    ) -> None:
        """`blueprint`: the initial layout in a viewer."""
        self._styled: set[str] = set()
        self._curves: dict[str, list[tuple[int, Array64]]] = {}  # not yet written
        self._stamp_ns = self._curves_ns = 0
        self._since_1970: bool | None = None
        self._rerun = rr.RecordingStream(APPLICATION)
        self._rerun.set_log_time_enabled(False)  # sensor time is the only timeline
        sinks: list[Any] = []
        if port is not None and _is_free(port):
            # Never GrpcSink (connect_grpc): without a connected viewer log() blocks for ever.
            sinks.append(rr.GrpcServerSink(LOOPBACK, port, server_memory_limit=memory_limit))
        elif port is not None:
            errors[f"port {port} is in use, so nothing is served: stop the other run or viewer, or set `port`."] += 1
        self._file: RrdFile | None = None
        if file is not None:
            try:
                self._file = RrdFile(file, errors)
                sinks.append(self._file.sink)
            except OSError as error:
                errors[f"cannot write {file}: {error.strerror}; the run continues without it"] += 1
        if not sinks:
            self._rerun.disconnect()
            return
        try:
            self._rerun.set_sinks(*sinks, default_blueprint=blueprint)
        except RuntimeError as error:
            errors[f"nothing is recorded, Rerun cannot start: {error}"] += 1
        finally:
            if self._file is not None:
                self._file.connected()

    def at(self, stamp_ns: int) -> bool:
        """Set the time of the next entities. True for the first call, which selects the epoch of the timeline."""
        first = self._since_1970 is None
        if self._since_1970 is None:
            self._since_1970 = abs(stamp_ns) > EPOCH_FROM_NS
        self._stamp_ns = stamp_ns
        if abs(stamp_ns - self._curves_ns) >= CURVE_BATCH_NS:
            self._curves_ns = stamp_ns
            self._write_curves()
        if self._since_1970:
            self._rerun.set_time(TIMELINE, timestamp=np.datetime64(stamp_ns, "ns"))
        else:
            self._rerun.set_time(TIMELINE, duration=np.timedelta64(stamp_ns, "ns"))
        return first

    def put(self, entity: Entity, *, static: bool = False) -> None:
        """Log an entity. Its frame and style are logged once per path, static; an entity that clears has neither."""
        if entity.path not in self._styled:
            style = [] if entity.style is None else [entity.style()]
            if entity.frame is not None:
                style.append(rr.CoordinateFrame(entity.frame))
            if style:
                self._styled.add(entity.path)
                self._rerun.log(entity.path, *style, static=True)
        if isinstance(entity, Curve):
            self._curves.setdefault(entity.path, []).append((self._stamp_ns, entity.values))
        else:
            self._rerun.log(entity.path, *entity.archetypes, static=static)

    def _write_curves(self) -> None:
        curves, self._curves = self._curves, {}
        for path, rows in curves.items():
            stamps_ns = np.array([stamp_ns for stamp_ns, _ in rows])
            if self._since_1970:
                times = rr.TimeColumn(TIMELINE, timestamp=stamps_ns.astype("datetime64[ns]"))
            else:
                times = rr.TimeColumn(TIMELINE, duration=stamps_ns.astype("timedelta64[ns]"))
            columns = rr.Scalars.columns(scalars=np.concatenate([values for _, values in rows]))
            self._rerun.send_columns(path, [times], columns.partition([len(values) for _, values in rows]))

    def close(self) -> None:
        """Flush and close the file."""
        self._write_curves()
        self._rerun.disconnect()
        if self._file is not None:
            self._file.close()


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError:
            return False
    return True


class RrdFile:
    """Receives what a `FileSink` writes. After a write error it discards the rest and counts one error in `errors`."""

    def __init__(self, path: Path, errors: Counter[str]) -> None:
        """Create the file and its folder; raises OSError."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        self._file = path.open("wb", buffering=0)
        self._errors = errors
        self._read_fd, self._write_fd = os.pipe()
        self.sink = rr.FileSink(f"/dev/fd/{self._write_fd}")
        self._thread = threading.Thread(target=self._copy, name="viewer file", daemon=True)
        self._thread.start()

    def connected(self) -> None:
        """Close our write end of the pipe, after Rerun has opened its own."""
        os.close(self._write_fd)

    def close(self) -> None:
        """Wait for the last byte; Rerun must have closed its end before."""
        self._thread.join()

    def _copy(self) -> None:
        with os.fdopen(self._read_fd, "rb", buffering=0) as pipe, self._file as file:
            intact = True
            while data := pipe.read(PIPE_READ_BYTES):
                if intact:
                    intact = self._write(file, data)

    def _write(self, file: FileIO, data: bytes) -> bool:
        try:
            view = memoryview(data)
            while view:
                view = view[file.write(view) :]
        except OSError as error:
            self._errors[f"{self._path} is truncated: {error.strerror}; recover it with: rerun rrd merge"] += 1
            return False
        return True
