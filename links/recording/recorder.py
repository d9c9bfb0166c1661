"""The recorder of a live run: every received and every sent record.

A session is one file, or several parts (flight.mcap, flight-2.mcap, ...): each has the rig and the configuration and
can be replayed alone. A separate thread opens and closes parts and checks the disk; a sensor's thread only puts its
record into the writer's queue. When the disk is nearly full, or fails, recording stops, the run continues, and
recording is retried. A killed run leaves the records up to 0.5 s before (`RecordingWriter`).

Source: ours; recordings/README.md.
"""

from __future__ import annotations

import shutil
import threading
import time
import uuid
from pathlib import Path
from typing import Any

import yaml
from pydantic import Field

from flow.link import LinkError, Record, Run, Tap
from flow.message import Message
from flow.stage import Settings
from links.recording.writer import RecordingWriter

CHECK_S = 0.25  # period of the checks of size, age and disk
MB = 1_000_000
RETRY_S = 10.0  # period of retries after a stop
SESSION, PART = "session", "part"
"""Metadata of a recording: which run it is of, and its number among that run's parts, from 1."""


class _Intake:
    """Where records go now. A plain object: a record costs less than to set an attribute of a `Tap` would."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.writer: RecordingWriter | None = None
        self.part_bytes = 0
        self.missed = 0  # while nothing was recorded


class RecorderSettings(Settings):
    """Settings of `Recorder`."""

    file: str = Field("flight.mcap", pattern=r"^[\w.-]+\.mcap$")
    split_s: float = Field(900.0, ge=1)  # a part is this long at most
    split_mb: float = Field(2000.0, ge=1)  # and holds so much, before compression
    reserve_mb: float = Field(200.0, ge=0)  # is left free on the disk, for the results


class Recorder(Tap[RecorderSettings]):
    """Records a live run into its folder. Replays it ignores: they have their recording."""

    def __init__(self, settings: RecorderSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._intake = _Intake()
        self._run: Run | None = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._session: str = ""
        self._parts: int = 0
        self._part_s: float = 0.0  # when it was opened, monotonic
        self._stopped_s: float = 0.0
        self._before: tuple[int, int] = (0, 0)  # written and dropped in earlier parts
        self._status: str | None = None

    def wants(self, message: type[Message]) -> bool:
        """Records only."""
        return False

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Messages are not recorded, they follow from the records."""

    @property
    def counters(self) -> dict[str, int]:
        """Records written, dropped (a slow disk), missed (no recording), and parts."""
        written, dropped = self._totals()
        return {"written": written, "dropped": dropped, "missed": self._intake.missed, "parts": self._parts}

    @property
    def status(self) -> str | None:
        """The reason why nothing is recorded; None while recording."""
        return self._status

    def open(self, run: Run) -> None:
        """Begin the first part. That nothing can be recorded is `status`, and does not stop a run."""
        if not run.live:
            return
        self._run, self._session = run, uuid.uuid4().hex
        self._closing.clear()
        self._begin_part()
        self._thread = threading.Thread(target=self._look_after, name="recorder", daemon=True)
        self._thread.start()

    def record(self, record: Record) -> None:
        """Into the queue. LinkError for a record that no recording can hold."""
        intake = self._intake
        with intake.lock:
            if intake.writer is None:
                intake.missed += 1
                return
            intake.part_bytes += len(record.data)
            intake.writer.write(record)

    def close(self) -> None:
        """Write what is queued and end the part."""
        if self._thread is None:
            return
        self._closing.set()
        self._thread.join()
        self._thread = None
        self._end_part(self._swap(None))

    def _look_after(self) -> None:
        while not self._closing.wait(CHECK_S):
            try:
                self._look()
            except LinkError as error:
                self._give_up(str(error))

    def _look(self) -> None:
        settings = self.settings
        writer, now_s = self._intake.writer, time.monotonic()
        if writer is None:
            if now_s >= self._stopped_s + RETRY_S and self._free_bytes() > 2 * settings.reserve_mb * MB:
                self._begin_part()
        elif writer.status is not None:
            self._give_up(writer.status)
        elif self._free_bytes() < settings.reserve_mb * MB:
            self._give_up(f"less than {settings.reserve_mb:g} MB are free at {writer.path.parent}: make room")
        elif now_s - self._part_s >= settings.split_s or self._intake.part_bytes >= settings.split_mb * MB:
            self._begin_part()

    def _begin_part(self) -> None:
        """A new file takes the records from here on; the one before is ended."""
        assert self._run is not None
        path = self._path(self._run.out_dir, self._parts + 1)
        values = yaml.safe_load(self._run.settings_yaml) or {}
        rig_yaml = yaml.safe_dump(values["rig"], sort_keys=False) if "rig" in values else None
        try:
            if self._free_bytes() < self.settings.reserve_mb * MB:
                raise LinkError(f"less than {self.settings.reserve_mb:g} MB are free at {path.parent}: make room")
            writer = RecordingWriter(
                path,
                rig_yaml=rig_yaml,
                config_yaml=self._run.settings_yaml,
                metadata={
                    "made_by": "grd run",
                    "run": self._run.name,
                    SESSION: self._session,
                    PART: str(self._parts + 1),
                },
                channels=self._run.senders,
            )
        except LinkError as error:
            self._give_up(str(error))
            return
        self._parts += 1
        before = self._swap(writer)
        self._part_s, self._status = time.monotonic(), None
        self._end_part(before)

    def _path(self, folder: Path, part: int) -> Path:
        file = folder / self.settings.file
        return file if part == 1 else file.with_stem(f"{file.stem}-{part}")

    def _swap(self, writer: RecordingWriter | None) -> RecordingWriter | None:
        intake = self._intake
        with intake.lock:
            before, intake.writer = intake.writer, writer
            intake.part_bytes = 0
        return before

    def _end_part(self, writer: RecordingWriter | None) -> None:
        if writer is None:
            return
        try:
            writer.close()
        except LinkError as error:
            self._status = self._status or str(error)
        self._before = self._before[0] + writer.written, self._before[1] + writer.dropped

    def _give_up(self, why: str) -> None:
        self._status = f"{why}; nothing is recorded now, the run goes on"
        self._stopped_s = time.monotonic()
        self._end_part(self._swap(None))

    def _totals(self) -> tuple[int, int]:
        writer = self._intake.writer
        now = (writer.written, writer.dropped) if writer is not None else (0, 0)
        return self._before[0] + now[0], self._before[1] + now[1]

    def _free_bytes(self) -> int:
        """Free space of the disk; LinkError when the disk or the folder is missing."""
        assert self._run is not None
        try:
            return shutil.disk_usage(self._run.out_dir).free
        except OSError as error:
            raise LinkError(f"{self._run.out_dir}: {error.strerror or error}: is the disk still there?") from None
