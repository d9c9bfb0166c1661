"""Writes a recording to disk without blocking the sensors' threads.

`write` puts a record into a queue bounded in bytes; one thread builds chunks and hands them to the operating system.
Every chunk is closed when it is FLUSH_S old, half of the 0.5 s that a killed recording may lose: the other half is for
a busy machine. A second thread asks the disk to keep the data every SYNC_S, so that a power cut costs about as much.
The file has the user's name from the start, so an interrupted recording is found where it was expected.

Source: ours.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO

from flow.link import LinkError, Record
from links.recording.format import (
    CONFIG_ATTACHMENT,
    MAX_MESSAGE_BYTES,
    MAX_TIME_NS,
    METADATA_LOSSES,
    RIG_ATTACHMENT,
)
from links.recording.mcap_file import McapFile

QUEUE_BYTES = 64 * 2**20  # waiting for the disk: 5 s of two cameras and the lidar
FLUSH_S = 0.25
SYNC_S = 1.0
CLOSE_TIMEOUT_S = 30.0  # for a disk that does not respond
_POLL_S = 0.05
_RECORD_BYTES = 64  # queue size of a record in addition to its data


def beside(source: Path, ending: str) -> Path:
    """The file next to `source` with another ending: `flight.rig.yaml` for `flight.mcap`; also of the folder `.`."""
    named = source if source.name else source.absolute()
    return named.parent / f"{named.stem}{ending}"


def create(path: Path, *, overwrite: bool) -> IO[bytes]:
    """Open a new file for a recording. Raises LinkError with the reason."""
    try:
        return path.open("wb" if overwrite else "xb")
    except FileExistsError:
        raise LinkError(f"{path} exists already: give another name with -o, or --overwrite") from None
    except FileNotFoundError:
        raise LinkError(f"{path}: there is no folder {path.parent}: create it first") from None
    except IsADirectoryError:
        raise LinkError(f"{path} is a folder: name a file, such as {path / 'flight.mcap'}") from None
    except OSError as error:
        raise LinkError(f"{path} cannot be written: {error.strerror}") from None


class RecordingWriter:
    """Write a recording. `with RecordingWriter("flight.mcap", rig_yaml=text) as recording: recording.write(record)`.

    A record that finds the queue full is dropped and counted: the disk is too slow. With `lossless` the caller waits
    instead and chunks are closed by size alone, so that an import or a simulation gives the same bytes each time.
    Sequence numbers are given here, in the order of `write`; a dropped record leaves a gap in them.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        rig_yaml: str | None = None,
        config_yaml: str | None = None,
        metadata: dict[str, str] | None = None,
        channels: dict[str, dict[str, str]] | None = None,
        lossless: bool = False,
        overwrite: bool = False,
        queue_bytes: int = QUEUE_BYTES,
    ) -> None:
        self.path = Path(path)
        self._lossless = lossless
        self._queue_bytes = queue_bytes
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._queue: deque[tuple[Record, int]] = deque()  # each with its sequence number
        self._waiting_bytes = 0  # queued, or in the writer thread's hands
        self._in_hand = 0  # records the writer thread has taken and not yet written
        self._sequence = 0
        self._written = 0
        self._dropped = 0
        self._closing = False
        self._status: str | None = None
        self._stopped = threading.Event()
        attachments = {RIG_ATTACHMENT: rig_yaml, CONFIG_ATTACHMENT: config_yaml}
        self._stream = create(self.path, overwrite=overwrite)
        try:
            self._file = McapFile(
                self._stream,
                attachments={name: text for name, text in attachments.items() if text is not None},
                metadata=metadata or {},
                channels=channels or {},
            )
        except OSError as error:
            with suppress(OSError):  # what is buffered cannot be written either
                self._stream.close()
            if not overwrite and self.path.is_file():  # it is empty, and would block the next attempt
                with suppress(OSError):
                    self.path.unlink()
            raise LinkError(self._disk_status(error)) from None
        self._threads = [threading.Thread(target=self._write_all, name="recording", daemon=True)]
        if not lossless:
            self._sync_fd = os.dup(self._stream.fileno())  # its own: the writer thread closes the stream
            self._threads.append(threading.Thread(target=self._sync, name="recording-sync", daemon=True))
        for thread in self._threads:
            thread.start()

    @property
    def written(self) -> int:
        """Records handed to the operating system or in an open chunk."""
        return self._written

    @property
    def dropped(self) -> int:
        """Records lost because the queue was full or the disk failed."""
        return self._dropped

    @property
    def status(self) -> str | None:
        """The reason why recording stopped, or None. `close` raises it."""
        return self._status

    def write(self, record: Record) -> None:
        """Queue one record; `lossless` waits while the queue is full and raises LinkError when the disk fails."""
        if not (0 <= record.arrival_ns <= MAX_TIME_NS and 0 <= record.stamp_ns <= MAX_TIME_NS):
            raise LinkError(
                f"{record.topic}: times must be nanoseconds from 0 up,"
                f" not arrival {record.arrival_ns}, stamp {record.stamp_ns}"
            )
        if len(record.data) > MAX_MESSAGE_BYTES:
            raise LinkError(f"{record.topic}: a record of {len(record.data)} bytes; {MAX_MESSAGE_BYTES} is the most")
        weight = _RECORD_BYTES + len(record.data)
        with self._lock:
            if self._closing:
                raise LinkError(f"{self.path}: the recording is closed already")
            if self._lossless:
                while self._waiting_bytes and self._waiting_bytes + weight > self._queue_bytes and not self._status:
                    self._changed.notify_all()
                    self._changed.wait()
                if self._status:
                    raise LinkError(self._status)
            sequence = self._sequence
            self._sequence += 1
            if self._status or (self._waiting_bytes and self._waiting_bytes + weight > self._queue_bytes):
                self._dropped += 1
                return
            self._queue.append((record, sequence))
            self._waiting_bytes += weight

    def close(self) -> None:
        """Write what is queued and the summary. LinkError when the disk did not take it all."""
        with self._lock:
            if self._closing:
                return
            self._closing = True
            self._changed.notify_all()
        deadline = time.monotonic() + CLOSE_TIMEOUT_S
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))
        if any(thread.is_alive() for thread in self._threads):
            raise LinkError(f"{self.path}: the disk did not take the data within {CLOSE_TIMEOUT_S:g} s: check the disk")
        if self._status:
            raise LinkError(self._status)

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _write_all(self) -> None:
        """The writer thread."""
        status: str | None = f"{self.path}: the writer thread stopped; see its error above and report it"
        try:
            with self._stream:
                self._drain()
                if self._dropped:
                    self._file.add_metadata(METADATA_LOSSES, {"dropped": str(self._dropped)})
                self._file.finish()
                if not self._lossless:
                    os.fsync(self._stream.fileno())
            status = None
        except OSError as error:
            status = self._disk_status(error)
        finally:
            self._stopped.set()
            if status:
                self._fail(status)
                self._dropped += self._in_hand

    def _drain(self) -> None:
        flush_at = time.monotonic() + FLUSH_S
        while True:
            with self._lock:
                if not self._queue and not self._closing:
                    self._changed.wait(_POLL_S)
                batch, self._queue = self._queue, deque()
                self._in_hand = len(batch)
                closing = self._closing
            for record, sequence in batch:
                self._file.add(record, sequence)
            with self._lock:
                self._written += len(batch)
                self._in_hand = 0
                self._waiting_bytes -= sum([_RECORD_BYTES + len(record.data) for record, _ in batch])
                self._changed.notify_all()
            if closing and not batch:
                return
            if not self._lossless and time.monotonic() >= flush_at:
                self._file.flush()
                flush_at = time.monotonic() + FLUSH_S

    def _sync(self) -> None:
        """The sync thread: a slow disk makes this one wait, not the writer."""
        try:
            while not self._stopped.wait(SYNC_S):
                os.fsync(self._sync_fd)
        except OSError as error:
            self._fail(self._disk_status(error))
        finally:
            os.close(self._sync_fd)

    def _fail(self, status: str) -> None:
        with self._lock:
            self._status = self._status or status
            self._dropped += len(self._queue)
            self._queue.clear()
            self._changed.notify_all()

    def _disk_status(self, error: OSError) -> str:
        return (
            f"{self.path}: {error.strerror or error} after {self._written} records: check the disk and its free space;"
            f" `grd recover {self.path}` saves what is on it"
        )
