"""One chunk of a recording and its messages. All contents are checked before use.

Source: MCAP specification 0 (https://mcap.dev/spec), chunk and message records; RFC 8878 (zstd).
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import IO

import zstandard
from mcap.opcode import Opcode

from links.recording.format import MAX_CHUNK_BYTES, MAX_TIME_NS

HEAD = struct.Struct("<BQ")  # of any record: opcode, length of what follows
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, uncompressed size, CRC, length of the compression's name
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log_time, publish_time
_MAX_OFFSET = 2**63 - 1  # of any file
_ZSTD = b"\x04\x00\x00\x00zstd"
_ZSTD_AT = HEAD.size + 28  # from the start of a chunk record to its compression's name


class Damage(Exception):
    """A part of the file is damaged. The text describes the damage in one clause."""


@dataclass(frozen=True, slots=True)
class ChunkRef:
    """One chunk: offset and length of its record with the header, and its range of arrival times."""

    offset: int
    length: int
    start_ns: int
    end_ns: int
    uncompressed: int


def chunk_ref(stream: IO[bytes], offset: int, end: int) -> ChunkRef:
    """The chunk whose record is at these bytes, from its header. Raises Damage."""
    stream.seek(offset + HEAD.size)
    head = stream.read(_CHUNK_HEAD.size)
    if len(head) < _CHUNK_HEAD.size:
        raise Damage("its head is cut off")
    start_ns, end_ns, uncompressed, _, _ = _CHUNK_HEAD.unpack(head)
    if not start_ns <= end_ns <= MAX_TIME_NS or uncompressed > MAX_CHUNK_BYTES or end - offset > 2 * MAX_CHUNK_BYTES:
        raise Damage("its times or its size are impossible")
    return ChunkRef(offset, end - offset, start_ns, end_ns, uncompressed)


def read_chunk(stream: IO[bytes], chunk: ChunkRef) -> bytes:
    """The messages of a chunk, uncompressed and checked by its CRC. Raises Damage."""
    if not HEAD.size < chunk.length <= 2 * MAX_CHUNK_BYTES or chunk.offset > _MAX_OFFSET:
        raise Damage("its offset or its length is impossible")
    stream.seek(chunk.offset)
    record = stream.read(chunk.length)
    if len(record) < chunk.length or HEAD.unpack_from(record) != (Opcode.CHUNK, chunk.length - HEAD.size):
        raise Damage("there is no chunk at its offset")
    try:
        _, _, size, crc, name_length = _CHUNK_HEAD.unpack_from(record, HEAD.size)
        name_end = HEAD.size + _CHUNK_HEAD.size + name_length
        compression = record[HEAD.size + _CHUNK_HEAD.size : name_end]
        (stored_length,) = struct.unpack_from("<Q", record, name_end)
    except struct.error:
        raise Damage("its head is cut off") from None
    stored = memoryview(record)[name_end + 8 :]
    if stored_length != len(stored):
        raise Damage(f"its head claims {stored_length} stored bytes, it has {len(stored)}")
    if size > MAX_CHUNK_BYTES:
        raise Damage(f"it claims to unpack to {size} bytes, {MAX_CHUNK_BYTES} is the most")
    data = _unpack(compression, stored, size)
    if len(data) != size:
        raise Damage(f"it unpacks to {len(data)} bytes instead of {size}")
    if zlib.crc32(data) != crc:
        raise Damage("its CRC is wrong")
    return data


def chunk_messages(data: bytes) -> list[tuple[int, int, int, int, int, int]]:
    """(log_time, sequence, publish_time, channel id, start, end) of each message in a chunk's data. Raises Damage."""
    found: list[tuple[int, int, int, int, int, int]] = []
    offset = 0
    while offset < len(data):
        if offset + HEAD.size > len(data):
            raise Damage("a record in it is cut off")
        opcode, length = HEAD.unpack_from(data, offset)
        end = offset + HEAD.size + length
        if end > len(data) or (opcode == Opcode.MESSAGE and length < 22):
            raise Damage(f"a record in it has the length {length}")
        if opcode == Opcode.MESSAGE:
            _, _, channel, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(data, offset)
            found.append((log_time, sequence, publish_time, channel, offset + _MESSAGE_HEAD.size, end))
        offset = end
    return found


def _unpack(compression: bytes, stored: memoryview, size: int) -> bytes:
    if compression == b"":
        return bytes(stored)
    if compression != b"zstd":
        raise Damage(f"it is compressed with {compression[:16]!r}, and grd writes zstd only")
    try:  # the stream reader stops at the requested size, whatever size the frame claims
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
        with decompressor.stream_reader(stored) as unpacked:
            return unpacked.read(size + 1)
    except zstandard.ZstdError as error:
        raise Damage(f"zstd: {error}") from None


def next_chunk(stream: IO[bytes], offset: int, size: int) -> int | None:
    """Offset of the next zstd chunk whose lengths agree with each other, or None."""
    block_bytes = 2**20
    while offset < size:
        stream.seek(offset)
        block = stream.read(block_bytes + _ZSTD_AT + 16)
        at = block.find(_ZSTD)
        while at >= 0:
            start = at - _ZSTD_AT
            if start >= 0 and at + 16 <= len(block) and block[start] == Opcode.CHUNK:
                _, length = HEAD.unpack_from(block, start)
                (stored,) = struct.unpack_from("<Q", block, at + len(_ZSTD))
                if length == 44 + stored and offset + start + HEAD.size + length <= size:
                    return offset + start
            at = block.find(_ZSTD, at + 1)
        offset += block_bytes
    return None
