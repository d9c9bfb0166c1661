"""MAVLink frames of a telemetry log: an 8-byte big-endian time [us since 1970] before each frame, nothing else.

A frame is accepted when its checksum is correct, or when a time and a frame follow its end (a message that is unknown
or different in our dialect). All other bytes are skipped and counted. A log is read block by block: it may be larger
than the memory.

Source: https://mavlink.io/en/guide/serialization.html (frames, CRC); pymavlink's mavlogfile (the log's layout).
"""

from __future__ import annotations

import binascii
import functools
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

BLOCK_BYTES = 1 << 20
_STAMP_BYTES = 8
_V1, _V2 = 0xFE, 0xFD
_MARKER = re.compile(b"[\xfd\xfe]")
_V1_EXTRA_BYTES, _V2_EXTRA_BYTES, _SIGNATURE_BYTES = 8, 12, 13
_SIGNED = 0x01  # v2 incompatibility flag
_MAX_STAMP_US = 4_102_444_800_000_000  # the year 2100
_MAX_STEP_US = 3 * 24 * 3600 * 1_000_000  # between neighbours without a correct checksum
_MAX_FRAME_BYTES = 255 + _V2_EXTRA_BYTES + _SIGNATURE_BYTES
_AHEAD_BYTES = 2 * _STAMP_BYTES + _MAX_FRAME_BYTES + 3  # what is needed to accept a frame: its own, and the next start
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


@dataclass(slots=True)
class TlogReport:
    """What was skipped in a log."""

    unknown_checksum: int = 0  # frames kept though their checksum does not fit our dialect
    bad_bytes: int = 0
    bad_runs: list[tuple[int, int]] = field(default_factory=list)  # (offset, length), the first few
    warnings: list[str] = field(default_factory=list)
    done_bytes: int = 0


def looks_like_tlog(data: bytes) -> bool:
    """Whether a file with this start is a telemetry log."""
    return _frame_end(data, 0) is not None


def read_frames(stream: IO[bytes], path: Path, report: TlogReport) -> Iterator[tuple[int, bytes]]:
    """(time in ns, frame) in file order; `report` counts what is not a frame."""
    data, start, offset = b"", 0, 0  # a window of the file, its first byte, and the position in it
    bad_from: int | None = None
    while True:
        while len(data) - offset < _AHEAD_BYTES and (block := stream.read(BLOCK_BYTES)):
            data, start, offset = data[offset:] + block, start + offset, 0
        if offset == len(data):
            break
        end = _frame_end(data, offset)
        known = end is not None and _checksum_fits(data[offset + _STAMP_BYTES : end])
        if end is None or not (known or _follows(data, offset, end)):
            bad_from = start + offset if bad_from is None else bad_from
            offset = _next_possible(data, offset + 1)
            report.done_bytes = start + offset
            continue
        if bad_from is not None:
            _note_bad(report, bad_from, start + offset)
            bad_from = None
        report.unknown_checksum += not known
        report.done_bytes = start + end
        yield _stamp_us(data, offset) * 1000, data[offset + _STAMP_BYTES : end]
        offset = end
    if bad_from is not None:
        _note_bad(report, bad_from, start + len(data))
    if report.bad_bytes:
        runs = ", ".join(f"{start} to {start + length - 1}" for start, length in report.bad_runs)
        report.warnings.append(f"{path}: {report.bad_bytes} bytes are no MAVLink frame (bytes {runs}, ...): left out")
    if report.unknown_checksum:
        report.warnings.append(
            f"{path}: {report.unknown_checksum} frames have a checksum that our MAVLink dialect does not expect: kept"
        )


def _note_bad(report: TlogReport, start: int, end: int) -> None:
    report.bad_bytes += end - start
    if len(report.bad_runs) < 5:
        report.bad_runs.append((start, end - start))


def _stamp_us(data: bytes, offset: int) -> int:
    return int.from_bytes(data[offset : offset + _STAMP_BYTES], "big")


def _frame_end(data: bytes, offset: int) -> int | None:
    """Where the frame after the time at `offset` ends, by its length byte; None when no whole frame can be there."""
    start = offset + _STAMP_BYTES
    if start + 3 > len(data) or _stamp_us(data, offset) > _MAX_STAMP_US:
        return None
    if data[start] == _V1:
        end = start + data[start + 1] + _V1_EXTRA_BYTES
    elif data[start] == _V2:
        end = start + data[start + 1] + _V2_EXTRA_BYTES + (_SIGNATURE_BYTES if data[start + 2] & _SIGNED else 0)
    else:
        return None
    return end if end <= len(data) else None


def _next_possible(data: bytes, offset: int) -> int:
    """The next position from `offset` on where a frame can be: its marker follows the time, or is not read yet."""
    marker = _MARKER.search(data, offset + _STAMP_BYTES)
    return marker.start() - _STAMP_BYTES if marker else max(offset, len(data) - _STAMP_BYTES)


def _follows(data: bytes, offset: int, end: int) -> bool:
    """Whether the next frame starts where this one ends, at about the same time."""
    if end == len(data):
        return True
    if end + _STAMP_BYTES >= len(data):
        return False
    step_us = abs(_stamp_us(data, end) - _stamp_us(data, offset))
    return data[end + _STAMP_BYTES] in (_V1, _V2) and step_us <= _MAX_STEP_US


def _checksum_fits(frame: bytes) -> bool:
    if frame[0] == _V1:
        message_id, crc_at = frame[5], 6 + frame[1]
    else:
        message_id, crc_at = int.from_bytes(frame[7:10], "little"), 10 + frame[1]
    extra = _crc_extra().get(message_id)
    if extra is None:
        return False
    return x25(frame[1:crc_at] + bytes([extra])) == int.from_bytes(frame[crc_at : crc_at + 2], "little")


def x25(data: bytes) -> int:
    """MAVLink's checksum CRC-16/MCRF4XX: the standard library's CRC-CCITT with bits reversed in and out."""
    crc = binascii.crc_hqx(data.translate(_REVERSED), 0xFFFF)
    return _REVERSED[crc & 0xFF] << 8 | _REVERSED[crc >> 8]


@functools.cache
def _crc_extra() -> dict[int, int]:
    """Message id -> the seed of its checksum."""
    from pymavlink.dialects.v20 import ardupilotmega  # here: it takes 0.2 s, and most commands need none of it

    return {message_id: kind.crc_extra for message_id, kind in ardupilotmega.mavlink_map.items()}
