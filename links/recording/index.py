"""Index of a recording: read from the summary of a finished file, else built by a scan of the record headers.

Both read record headers only, so that a recording of two hours opens quickly. All values of the file are checked before
use: lengths against the file's size, sizes against MAX_CHUNK_BYTES, contents against their CRC.

Source: MCAP specification 0 (https://mcap.dev/spec).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO, Any

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC

from links.recording.chunk import HEAD, ChunkRef, Damage, chunk_messages, chunk_ref, next_chunk, read_chunk

_MAX_ASIDE_BYTES = 4 * 2**20  # a record outside the chunks: channels, attachments, metadata
_FOOTER_BYTES = 9 + 20 + 8  # record head, footer, magic


@dataclass(slots=True)
class FileIndex:
    """What a file holds, and what was found wrong with it."""

    profile: str = ""
    finished: bool = False
    chunks: list[ChunkRef] = field(default_factory=list)
    topics: dict[int, Channel] = field(default_factory=dict)  # by channel id
    counts: dict[int, int] = field(default_factory=dict)  # messages by channel id
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    cut_off: bool = False  # it was never finished
    readable_bytes: int = 0  # where the last whole record ends
    ending: str = ""  # what is wrong with the record there


def read_index(stream: IO[bytes], size: int) -> FileIndex:
    """Index of an MCAP file whose magic was checked. Damage goes to `warnings`, except to the header: Damage."""
    index = FileIndex()
    index.profile = _read_profile(stream, size)
    try:
        _read_summary(stream, size, index)
    except Damage as damage:
        index = FileIndex(profile=index.profile)
        _scan(stream, size, index)
        index.cut_off = not _ends_with_magic(stream, size)
        if not index.cut_off:
            index.warnings.append(f"the summary at the end is damaged ({damage}): read without it")
    return index


def _parse(read: Callable[[ReadDataStream], Any], body: bytes) -> Any:
    """A record of the mcap package from its bytes."""
    try:
        return read(ReadDataStream(BytesIO(body)))
    except (McapError, struct.error, UnicodeDecodeError, OverflowError) as error:
        raise Damage(f"its fields do not fit into it ({type(error).__name__})") from None


def _read_head(stream: IO[bytes], offset: int, size: int) -> tuple[int, int]:
    """(opcode, end offset) of the record at `offset`. Damage when it cannot be one."""
    if offset + HEAD.size > size:
        raise Damage("it is cut off")
    stream.seek(offset)
    opcode, length = HEAD.unpack(stream.read(HEAD.size))
    end = offset + HEAD.size + length
    if opcode == 0:
        raise Damage("no record begins so")
    if end > size:
        raise Damage(f"it claims {length} bytes, {size - offset - HEAD.size} are left")
    return opcode, end


def _read_body(stream: IO[bytes], offset: int, end: int) -> bytes:
    length = end - offset - HEAD.size
    if length > _MAX_ASIDE_BYTES:
        raise Damage(f"it claims {length} bytes, {_MAX_ASIDE_BYTES} is the most")
    stream.seek(offset + HEAD.size)
    return stream.read(length)


def _ends_with_magic(stream: IO[bytes], size: int) -> bool:
    """A finished file has the magic at its end, too."""
    stream.seek(max(0, size - len(MCAP0_MAGIC)))
    return size > 2 * len(MCAP0_MAGIC) and stream.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC


def _read_profile(stream: IO[bytes], size: int) -> str:
    opcode, end = _read_head(stream, len(MCAP0_MAGIC), size)
    if opcode != Opcode.HEADER:
        raise Damage("it is no header")
    return _parse(Header.read, _read_body(stream, len(MCAP0_MAGIC), end)).profile


def _read_summary(stream: IO[bytes], size: int, index: FileIndex) -> None:
    """Fill the index from the summary section, which one CRC covers. Raises Damage."""
    footer_at = size - _FOOTER_BYTES
    if footer_at < 0 or not _ends_with_magic(stream, size):
        raise Damage("there is none")
    stream.seek(footer_at)
    tail = stream.read(9 + 20)
    if HEAD.unpack_from(tail) != (Opcode.FOOTER, 20):
        raise Damage("there is no footer at the end")
    footer: Footer = _parse(Footer.read, tail[9:])
    if not len(MCAP0_MAGIC) < footer.summary_start < footer_at or footer_at - footer.summary_start > 2**30:
        raise Damage("the footer points to a wrong offset")
    stream.seek(footer.summary_start)
    body = stream.read(footer_at - footer.summary_start)
    if zlib.crc32(tail[:-4], zlib.crc32(body)) != footer.summary_crc:
        raise Damage("its CRC is wrong")
    statistics = False
    offset = 0
    while offset + HEAD.size <= len(body):
        opcode, length = HEAD.unpack_from(body, offset)
        record = body[offset + HEAD.size : offset + HEAD.size + length]
        offset += HEAD.size + length
        if opcode == Opcode.CHANNEL:
            channel: Channel = _parse(Channel.read, record)
            index.topics[channel.id] = channel
        elif opcode == Opcode.STATISTICS:
            index.counts = dict(_parse(Statistics.read, record).channel_message_counts)
            statistics = True
        elif opcode == Opcode.CHUNK_INDEX:
            chunk: ChunkIndex = _parse(ChunkIndex.read, record)
            index.chunks.append(
                ChunkRef(
                    chunk.chunk_start_offset,
                    chunk.chunk_length,
                    chunk.message_start_time,
                    chunk.message_end_time,
                    chunk.uncompressed_size,
                )
            )
        elif opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
            kind = AttachmentIndex if opcode == Opcode.ATTACHMENT_INDEX else MetadataIndex
            _read_aside(stream, _parse(kind.read, record).offset, size, index)
    if not statistics:
        raise Damage("it has no statistics")
    index.finished = True
    index.readable_bytes = size


def _read_aside(stream: IO[bytes], offset: int, size: int, index: FileIndex) -> None:
    """An attachment or metadata record; a damaged one is a warning."""
    try:
        opcode, end = _read_head(stream, offset, size)
        body = _read_body(stream, offset, end)
        if opcode == Opcode.METADATA:
            metadata: Metadata = _parse(Metadata.read, body)
            index.metadata[metadata.name] = metadata.metadata
        elif opcode == Opcode.ATTACHMENT:
            if len(body) < 4 or zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
                raise Damage("its CRC is wrong")
            attachment: Attachment = _parse(Attachment.read, body)
            index.attachments[attachment.name] = attachment.data
        else:
            raise Damage("there is neither an attachment nor metadata at its offset")
    except Damage as damage:
        index.warnings.append(f"attachment or metadata at byte {offset} cannot be read: {damage}")


def _scan(stream: IO[bytes], size: int, index: FileIndex) -> None:
    """Fill the index by going from record to record, over damage to the next compressed chunk."""
    offset = len(MCAP0_MAGIC)
    last_counts: dict[int, int] = {}  # of the last chunk, from the message indexes after it
    while offset < size:
        try:
            opcode, end = _read_head(stream, offset, size)
            if opcode == Opcode.CHANNEL:
                channel: Channel = _parse(Channel.read, _read_body(stream, offset, end))
                index.topics[channel.id] = channel
            elif opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
                _read_aside(stream, offset, size, index)
            elif opcode == Opcode.CHUNK:
                index.chunks.append(chunk_ref(stream, offset, end))
                _add_counts(index, last_counts)
            elif opcode == Opcode.MESSAGE_INDEX:
                channel_id, length = struct.unpack("<HI", _read_body(stream, offset, min(end, offset + 15)))
                last_counts[channel_id] = last_counts.get(channel_id, 0) + length // 16
            elif opcode == Opcode.DATA_END:
                index.readable_bytes = end
                break
        except (Damage, struct.error) as damage:
            following = next_chunk(stream, offset + 1, size)
            if following is None:
                index.ending = f"the record there: {damage}"
                break
            index.warnings.append(
                f"bytes {offset} to {following - 1} cannot be read ({damage}): went on at the next chunk"
            )
            offset = following
        else:
            offset = index.readable_bytes = end
    if index.chunks:
        last_counts = _counted(stream, index.chunks[-1])  # its message indexes may be cut off
    _add_counts(index, last_counts)


def _add_counts(index: FileIndex, counts: dict[int, int]) -> None:
    for channel_id, count in counts.items():
        index.counts[channel_id] = index.counts.get(channel_id, 0) + count
    counts.clear()


def _counted(stream: IO[bytes], chunk: ChunkRef) -> dict[int, int]:
    counts: dict[int, int] = {}
    try:
        for message in chunk_messages(read_chunk(stream, chunk)):
            counts[message[3]] = counts.get(message[3], 0) + 1
    except Damage:
        pass  # reported when the chunk is read
    return counts
