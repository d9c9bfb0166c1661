"""The Rerun recording of one run: a file, a loopback server, one timeline. Used by one thread only.

Source: ours. Rerun 0.41's traps: DESIGN, Links.
"""

from __future__ import annotations

import socket
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from links.viewer.rrd_file import RrdFile
from links.viewer.scene import TIMELINE, Curve, Mark
from stages.geometry.frames import Array64

APPLICATION = "grd"
LOOPBACK = "127.0.0.1"
CURVES_NS = 500_000_000  # of curves are written at a time: in rows, one by one, they cost more than all the rest
EPOCH_FROM_NS = 10**17  # stamps above are times since 1970 (1973 on), below are times since some start


class Stream:
    """A Rerun stream that outlives its sinks: what it cannot write or serve is counted in `errors`."""

    def __init__(
        self, file: Path | None, port: int | None, memory_limit: str, errors: Counter[str], opens: rrb.Blueprint
    ) -> None:
        """`opens`: how a viewer shows it at first."""
        self._styled: set[str] = set()
        self._curves: dict[str, list[tuple[int, Array64]]] = {}  # not yet written
        self._stamp_ns = self._curves_ns = 0
        self._since_1970: bool | None = None
        self._rerun = rr.RecordingStream(APPLICATION)
        self._rerun.set_log_time_enabled(False)  # the sensors' time is the only one
        sinks: list[Any] = []
        if port is not None and _is_free(port):
            # Never GrpcSink (connect_grpc): without a viewer at the other end, log() would block for ever.
            sinks.append(rr.GrpcServerSink(LOOPBACK, port, server_memory_limit=memory_limit))
        elif port is not None:
            errors[f"port {port} is taken, so nothing is served: does another run or viewer have it? Set `port`."] += 1
        self._file: RrdFile | None = None
        if file is not None:
            try:
                self._file = RrdFile(file, errors)
                sinks.append(self._file.sink)
            except OSError as error:
                errors[f"cannot write {file}: {error.strerror}; the run goes on without it"] += 1
        if not sinks:
            self._rerun.disconnect()
            return
        try:
            self._rerun.set_sinks(*sinks, default_blueprint=opens)
        except RuntimeError as error:
            errors[f"nothing is shown, Rerun cannot start: {error}"] += 1
        finally:
            if self._file is not None:
                self._file.connected()

    def at(self, stamp_ns: int) -> bool:
        """Set the time of what follows; true the first time, which decides if the timeline counts from 1970."""
        first = self._since_1970 is None
        if self._since_1970 is None:
            self._since_1970 = abs(stamp_ns) > EPOCH_FROM_NS
        self._stamp_ns = stamp_ns
        if abs(stamp_ns - self._curves_ns) >= CURVES_NS:
            self._curves_ns = stamp_ns
            self._write_curves()
        if self._since_1970:
            self._rerun.set_time(TIMELINE, timestamp=np.datetime64(stamp_ns, "ns"))
        else:
            self._rerun.set_time(TIMELINE, duration=np.timedelta64(stamp_ns, "ns"))
        return first

    def put(self, mark: Mark, *, static: bool = False) -> None:
        """Log a mark; its frame and style go once per entity, static. What clears an entity has neither."""
        if mark.path not in self._styled:
            style = [] if mark.style is None else [mark.style()]
            if mark.frame is not None:
                style.append(rr.CoordinateFrame(mark.frame))
            if style:
                self._styled.add(mark.path)
                self._rerun.log(mark.path, *style, static=True)
        if isinstance(mark, Curve):
            self._curves.setdefault(mark.path, []).append((self._stamp_ns, mark.values))
        else:
            self._rerun.log(mark.path, *mark.parts, static=static)

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
        """Push everything out and end the file."""
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
