"""Records into the bytes of one MCAP file, in the calling thread. The mcap package's writer knows one compression per
file; here each chunk has its own, so chunks are built from mcap's record classes.

Source: MCAP specification 0 (https://mcap.dev/spec); the chunk rules are ours (format.py).
"""

from __future__ import annotations

import struct
import zlib
from typing import IO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from flow.link import Record
from links import __version__
from links.recording.format import FORMAT_VERSION, MAX_TIME_NS, METADATA_FORMAT, METADATA_USER, PROFILE, topic

CHUNK_BYTES = 2**20  # a chunk is closed at this size [uncompressed]
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log_time, publish_time
_MESSAGE_OPCODE = int(Opcode.MESSAGE)  # packed faster than the member
_MESSAGE_FIELDS_BYTES = 22
_INDEX_HEAD = struct.Struct("<BQHI")  # opcode, length, channel, bytes of the index: times and offsets
_FOOTER_START = struct.Struct("<BQQQ")  # opcode, length, summary_start, summary_offset_start: covered by the CRC


class _OpenChunk:
    """Messages collected for one chunk."""

    def __init__(self, compression: str) -> None:
        self.compression = compression
        self.clear()

    def clear(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0
        self.start_ns = MAX_TIME_NS
        self.end_ns = 0
        self.indexes: dict[int, list[int]] = {}  # by channel: time and offset of each message

    def add(self, channel_id: int, record: Record, sequence: int) -> None:
        arrival_ns, data = record.arrival_ns, record.data
        index = self.indexes.get(channel_id)
        if index is None:
            index = self.indexes[channel_id] = []
        index += arrival_ns, self.size
        length = _MESSAGE_FIELDS_BYTES + len(data)
        head = _MESSAGE.pack(_MESSAGE_OPCODE, length, channel_id, sequence & 0xFFFF_FFFF, arrival_ns, record.stamp_ns)
        self.parts += head, data
        self.size += 9 + length
        if arrival_ns < self.start_ns:
            self.start_ns = arrival_ns
        if arrival_ns > self.end_ns:
            self.end_ns = arrival_ns


class McapFile:
    """Writes a recording to an open binary stream. `flush` closes the chunks, `finish` adds indexes and footer."""

    def __init__(
        self,
        stream: IO[bytes],
        *,
        attachments: dict[str, str],
        metadata: dict[str, str],
        channels: dict[str, dict[str, str]],
    ) -> None:
        self._stream = stream
        self._offset = 0
        self._channel_metadata = channels
        self._compressor = zstandard.ZstdCompressor()
        self._chunks = {True: _OpenChunk("zstd"), False: _OpenChunk("")}
        self._schemas: dict[str, Schema] = {}
        self._channels: dict[str, tuple[Channel, _OpenChunk]] = {}
        self._counts: dict[int, int] = {}
        self._start_ns, self._end_ns = MAX_TIME_NS, 0
        self._indexes = {kind: RecordBuilder() for kind in _INDEX_OPCODES}
        self._index_counts = dict.fromkeys(_INDEX_OPCODES, 0)

        start = RecordBuilder()
        start.write(MCAP0_MAGIC)
        Header(PROFILE, f"grd {__version__}").write(start)
        self._put(start.end())
        self.add_metadata(METADATA_FORMAT, {"format_version": "{}.{}".format(*FORMAT_VERSION)})
        if metadata:
            self.add_metadata(METADATA_USER, metadata)
        for name, text in attachments.items():
            self._add_attachment(name, text)
        self._stream.flush()

    def add(self, record: Record, sequence: int | None = None) -> None:
        """Append one record, with this sequence number or its own."""
        channel, chunk = self._channels.get(record.topic) or self._open_channel(record.topic)
        chunk.add(channel.id, record, record.sequence if sequence is None else sequence)
        self._counts[channel.id] += 1
        if chunk.size >= CHUNK_BYTES:
            self._close_chunk(chunk)

    def flush(self) -> None:
        """Pass all added records to the operating system: a process killed later loses none of them."""
        for chunk in self._chunks.values():
            if chunk.parts:
                self._close_chunk(chunk)
        self._stream.flush()

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Append a metadata record."""
        record = RecordBuilder()
        Metadata(name, values).write(record)
        MetadataIndex(self._offset, record.count, name).write(self._index(MetadataIndex))
        self._put(record.end())

    def finish(self) -> None:
        """Close the chunks and write the summary. Nothing may be added afterwards."""
        self.flush()
        end = RecordBuilder()
        DataEnd(0).write(end)
        self._put(end.end())
        summary_start = self._offset
        groups, offsets = RecordBuilder(), RecordBuilder()
        for opcode, body in self._summary_groups():
            if body:
                start = summary_start + groups.count
                SummaryOffset(group_opcode=opcode, group_start=start, group_length=len(body)).write(offsets)
                groups.write(body)
        offset_start = summary_start + groups.count
        summary = groups.end() + offsets.end()
        crc = zlib.crc32(_FOOTER_START.pack(Opcode.FOOTER, 20, summary_start, offset_start), zlib.crc32(summary))
        footer = RecordBuilder()
        Footer(summary_start=summary_start, summary_offset_start=offset_start, summary_crc=crc).write(footer)
        self._put(summary + footer.end() + MCAP0_MAGIC)
        self._stream.flush()

    def _summary_groups(self) -> list[tuple[Opcode, bytes]]:
        schemas, channels, statistics = RecordBuilder(), RecordBuilder(), RecordBuilder()
        for schema in self._schemas.values():
            schema.write(schemas)
        for channel, _ in self._channels.values():
            channel.write(channels)
        empty = not self._counts
        Statistics(
            attachment_count=self._index_counts[AttachmentIndex],
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=self._index_counts[ChunkIndex],
            message_count=sum(self._counts.values()),
            message_end_time=self._end_ns,
            message_start_time=0 if empty else self._start_ns,
            metadata_count=self._index_counts[MetadataIndex],
            schema_count=len(self._schemas),
        ).write(statistics)
        return [
            (Opcode.SCHEMA, schemas.end()),
            (Opcode.CHANNEL, channels.end()),
            (Opcode.STATISTICS, statistics.end()),
            *((opcode, self._indexes[kind].end()) for kind, opcode in _INDEX_OPCODES.items()),
        ]

    def _index(self, kind: type) -> RecordBuilder:
        self._index_counts[kind] += 1
        return self._indexes[kind]

    def _open_channel(self, name: str) -> tuple[Channel, _OpenChunk]:
        """Declare a topic's schema and channel outside the chunks, where a scan of an unfinished file finds them."""
        declared = topic(name)
        record = RecordBuilder()
        if declared.schema_name and declared.schema_name not in self._schemas:
            schema = Schema(len(self._schemas) + 1, declared.schema, declared.schema_encoding, declared.schema_name)
            self._schemas[declared.schema_name] = schema
            schema.write(record)
        channel = Channel(
            id=len(self._channels) + 1,
            topic=name,
            message_encoding=declared.encoding,
            metadata=self._channel_metadata.get(name, {}),
            schema_id=self._schemas[declared.schema_name].id if declared.schema_name else 0,
        )
        channel.write(record)
        self._put(record.end())
        self._counts[channel.id] = 0
        entry = self._channels[name] = (channel, self._chunks[declared.compress])
        return entry

    def _close_chunk(self, chunk: _OpenChunk) -> None:
        """Write a chunk and its message indexes in one piece, and clear it."""
        data = b"".join(chunk.parts)
        stored = self._compressor.compress(data) if chunk.compression else data
        record = RecordBuilder()
        Chunk(
            compression=chunk.compression,
            data=stored,
            message_end_time=chunk.end_ns,
            message_start_time=chunk.start_ns,
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        ).write(record)
        chunk_length = record.count
        offsets: dict[int, int] = {}
        for channel_id, index in chunk.indexes.items():
            offsets[channel_id] = self._offset + record.count
            record.write(_message_index(channel_id, index))
        ChunkIndex(
            chunk_length=chunk_length,
            chunk_start_offset=self._offset,
            compression=chunk.compression,
            compressed_size=len(stored),
            message_end_time=chunk.end_ns,
            message_index_length=record.count - chunk_length,
            message_index_offsets=offsets,
            message_start_time=chunk.start_ns,
            uncompressed_size=len(data),
        ).write(self._index(ChunkIndex))
        self._start_ns = min(self._start_ns, chunk.start_ns)
        self._end_ns = max(self._end_ns, chunk.end_ns)
        chunk.clear()
        self._put(record.end())

    def _add_attachment(self, name: str, text: str) -> None:
        data = text.encode()
        record = RecordBuilder()
        Attachment(create_time=0, log_time=0, name=name, media_type="application/yaml", data=data).write(record)
        AttachmentIndex(
            offset=self._offset,
            length=record.count,
            log_time=0,
            create_time=0,
            data_size=len(data),
            name=name,
            media_type="application/yaml",
        ).write(self._index(AttachmentIndex))
        self._put(record.end())

    def _put(self, data: bytes) -> None:
        self._stream.write(data)
        self._offset += len(data)


def _message_index(channel_id: int, index: list[int]) -> bytes:
    """The message index record of a channel, packed at once: the class of the mcap package packs number by number."""
    head = _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + 8 * len(index), channel_id, 8 * len(index))
    return head + struct.pack(f"<{len(index)}Q", *index)


_INDEX_OPCODES = {
    ChunkIndex: Opcode.CHUNK_INDEX,
    AttachmentIndex: Opcode.ATTACHMENT_INDEX,
    MetadataIndex: Opcode.METADATA_INDEX,
}
