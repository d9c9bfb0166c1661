"""Read a recording in the order of arrival, finished or not, with memory for a few chunks only.

Damage loses only the chunk that contains it; `warnings` has its byte offset. A file without a readable record is a
LinkError.

Source: ours; MCAP specification 0 (https://mcap.dev/spec).
"""

from __future__ import annotations

import heapq
import os
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from types import TracebackType
from typing import IO

from mcap.writer import MCAP0_MAGIC

from flow.link import LinkError, Record
from links.recording.chunk import ChunkRef, Damage, chunk_messages, read_chunk
from links.recording.format import (
    CONFIG_ATTACHMENT,
    FORMAT_VERSION,
    MAX_TIME_NS,
    METADATA_FORMAT,
    METADATA_LOSSES,
    METADATA_USER,
    PROFILE,
    RIG_ATTACHMENT,
    Progress,
)
from links.recording.index import FileIndex, read_index

MAX_OVERLAP_BYTES = 512 * 2**20  # chunks that overlap in time are in memory together
_ENTRY_BYTES = 256  # memory of a record in addition to its data
_IMPORTABLE = {
    b"\xd4\xc3\xb2\xa1": "a pcap capture",
    b"\xa1\xb2\xc3\xd4": "a pcap capture",
    b"\x4d\x3c\xb2\xa1": "a pcap capture",
    b"\xa1\xb2\x3c\x4d": "a pcap capture",
    b"\x0a\x0d\x0d\x0a": "a pcapng capture",
    b"#ROS": "a ROS bag",
    b"SQLi": "a ROS bag",
    b"ULog": "a PX4 log",
    b"\xa3\x95\x80\x80": "an ArduPilot log",
}

_Entry = tuple[int, int, Record]  # arrival_ns, sequence, record


class RecordingReader:
    """Read a recording. `with RecordingReader("flight.mcap") as recording: for record in recording.records(): ...`."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._stream = open_file(self.path)
        try:
            index = self._read_index()
        except BaseException:
            self._stream.close()
            raise
        self._chunks = index.chunks
        self._topic_by_channel = {channel.id: channel.topic for channel in index.topics.values()}
        self.finished = index.finished
        """Whether the recording was closed properly."""
        self.topics: dict[str, int] = dict(
            sorted(Counter({self._topic_by_channel.get(i, "?"): n for i, n in index.counts.items() if n}).items())
        )
        """Messages by topic, as the file's indexes count them."""
        self.channels: dict[str, dict[str, str]] = {
            channel.topic: channel.metadata for channel in index.topics.values() if channel.metadata
        }
        """Properties of the sender of each topic: model, port, sender."""
        self.metadata: dict[str, str] = index.metadata.get(METADATA_USER, {})
        self.start_ns = min((chunk.start_ns for chunk in index.chunks), default=0)
        self.end_ns = max((chunk.end_ns for chunk in index.chunks), default=0)
        self.warnings: list[str] = []
        """Unreadable parts with their offsets; `records` adds to it while reading."""
        for text in index.warnings:
            self._warn(text)
        if index.cut_off:
            count = sum(self.topics.values())
            self._warn(
                f"ends at byte {index.readable_bytes} of {self._size}: {count} messages readable"
                f"{recover_hint(self.path) if count else ''} ({index.ending or 'it was never closed'})"
            )
        dropped = index.metadata.get(METADATA_LOSSES, {}).get("dropped")
        if dropped:
            self._warn(f"{dropped} records were dropped while recording: the disk was too slow")
        self.rig_yaml = self._text(index, RIG_ATTACHMENT)
        self.config_yaml = self._text(index, CONFIG_ATTACHMENT)

    def records(self, topics: Collection[str] | None = None, *, progress: Progress | None = None) -> Iterator[Record]:
        """All records, or those of `topics`, sorted by (arrival_ns, sequence)."""
        for _, _, record in self._merge(None if topics is None else frozenset(topics), progress):
            yield record

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def __enter__(self) -> RecordingReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _read_index(self) -> FileIndex:
        self._size = os.fstat(self._stream.fileno()).st_size
        check_magic(self.path, self._stream.read(len(MCAP0_MAGIC)))
        try:
            index = read_index(self._stream, self._size)
        except Damage as damage:
            raise LinkError(
                f"{self.path}: the header at byte {len(MCAP0_MAGIC)} cannot be read: {damage}."
                " Nothing of the file can be used"
            ) from None
        except OSError as error:
            raise LinkError(f"{self.path} cannot be read: {error.strerror}: check the disk") from None
        if index.profile != PROFILE:
            raise LinkError(
                f"{self.path} is an MCAP file of profile {index.profile!r}, not of grd's {PROFILE!r}:"
                " grd reads what it recorded or imported itself (`grd import --help`)"
            )
        self._check_version(index)
        return index

    def _check_version(self, index: FileIndex) -> None:
        text = index.metadata.get(METADATA_FORMAT, {}).get("format_version", "")
        major = text.partition(".")[0]
        if not major.isdecimal():
            index.warnings.append(f"the format's version cannot be read: taken as {FORMAT_VERSION[0]}")
        elif int(major) > FORMAT_VERSION[0]:
            raise LinkError(
                f"{self.path}: recording format {text} is newer than this grd, which reads up to {FORMAT_VERSION[0]}.x:"
                " update grd"
            )

    def _text(self, index: FileIndex, name: str) -> str | None:
        try:
            return index.attachments[name].decode()
        except KeyError:
            return None
        except UnicodeDecodeError as error:
            self._warn(f"attachment {name} is no UTF-8 text: byte {error.start}")
            return None

    def _warn(self, text: str) -> None:
        line = f"{self.path}: {text}"
        if line not in self.warnings:
            self.warnings.append(line)

    def _merge(self, topics: frozenset[str] | None, progress: Progress | None) -> Iterator[_Entry]:
        """Merge the chunks' sorted records. A chunk is loaded when a record at or after its start is due."""
        waiting = sorted(self._chunks, key=lambda chunk: (chunk.start_ns, chunk.offset))
        total = sum(chunk.length for chunk in waiting)
        done = loaded = overlap_bytes = 0
        heap: list[tuple[int, int, int, list[_Entry], int]] = []  # first entry's key, chunk, its entries and size
        while heap or loaded < len(waiting):
            while loaded < len(waiting) and (not heap or waiting[loaded].start_ns <= heap[0][0]):
                chunk = waiting[loaded]
                entries = self._load(chunk, topics)
                loaded += 1
                done += chunk.length
                if entries:
                    size = chunk.uncompressed + len(entries) * _ENTRY_BYTES
                    overlap_bytes += size
                    heapq.heappush(heap, (*entries[-1][:2], loaded, entries, size))
                if overlap_bytes > MAX_OVERLAP_BYTES:
                    raise LinkError(
                        f"{self.path}: at byte {chunk.offset} more than {MAX_OVERLAP_BYTES} bytes overlap in time;"
                        " grd writes no such file: record it again, or look for damage with `grd recover`"
                    )
                if progress:
                    progress(done, total)
            if not heap:
                continue
            _, _, number, entries, size = heapq.heappop(heap)
            limit = (waiting[loaded].start_ns, -1) if loaded < len(waiting) else (2**64, 0)
            if heap:
                limit = min(limit, heap[0][:2])
            while entries and entries[-1][:2] <= limit:
                yield entries.pop()
            if entries:
                heapq.heappush(heap, (*entries[-1][:2], number, entries, size))
            else:
                overlap_bytes -= size

    def _load(self, chunk: ChunkRef, topics: frozenset[str] | None) -> list[_Entry]:
        """A chunk's records, the earliest last. A damaged chunk is a warning and gives none."""
        try:
            data = read_chunk(self._stream, chunk)
            messages = chunk_messages(data)
            if messages and not chunk.start_ns <= min(messages)[0] <= max(messages)[0] <= chunk.end_ns:
                raise Damage("its messages are outside the times it claims")
        except (Damage, OSError) as damage:
            self._warn(
                f"chunk at bytes {chunk.offset} to {chunk.offset + chunk.length - 1} cannot be read: {damage}."
                f" Its messages are missing, from {chunk.start_ns} to {chunk.end_ns} ns"
            )
            return []
        entries: list[_Entry] = []
        for log_time, sequence, publish_time, channel, start, end in messages:
            topic = self._topic_by_channel.get(channel)
            if topic is None:
                self._warn(
                    f"chunk at byte {chunk.offset}: channel {channel} was never declared; its messages are missing"
                )
            elif publish_time > MAX_TIME_NS:
                self._warn(f"chunk at byte {chunk.offset}: a message on {topic} has no valid stamp; it is left out")
            elif topics is None or topic in topics:
                record = Record(topic, log_time, publish_time, data[start:end], sequence)
                entries.append((log_time, sequence, record))
        entries.sort(key=lambda entry: entry[:2], reverse=True)
        return entries


def recover_hint(path: Path) -> str:
    """What a warning adds for a recording of which a part can be read."""
    return f"; `grd recover {path}` writes a clean copy"


def open_file(path: Path) -> IO[bytes]:
    """Open a file for reading. LinkError when it cannot be opened or is empty."""
    if path.exists() and not path.is_file() and not path.is_dir():
        raise LinkError(f"{path} is no regular file: copy what comes from it to a file first")
    try:
        stream = path.open("rb")
    except FileNotFoundError:
        raise LinkError(f"{path}: no such file: check the name") from None
    except IsADirectoryError:
        raise LinkError(f"{path} is a folder: name a recording in it, such as {path / 'flight.mcap'}") from None
    except OSError as error:
        raise LinkError(f"{path} cannot be read: {error.strerror}") from None
    if os.fstat(stream.fileno()).st_size == 0:
        stream.close()
        raise LinkError(f"{path} is empty: the recording never started, or the disk was full")
    return stream


def check_magic(path: Path, magic: bytes) -> None:
    """LinkError, saying what the file seems to be, when it does not start as MCAP files do."""
    if magic == MCAP0_MAGIC:
        return
    if MCAP0_MAGIC.startswith(magic):
        raise LinkError(f"{path} ends after {len(magic)} bytes: the recording was cut off before anything was written")
    kind = _IMPORTABLE.get(magic[:4])
    if kind is None and path.suffix == ".tlog":
        kind = "a MAVLink telemetry log"
    if kind is not None:
        raise LinkError(f"{path} is {kind}: make a recording of it first with `grd import {path}`")
    raise LinkError(f"{path} is no recording: it starts with {magic!r}, not as an MCAP file does")
