"""MAVLink framing: split datagrams and byte streams into frames, parse and pack frames.

Each datagram is split on its own, so that damage does not affect the next one. On a byte stream (TCP, serial) the
splitter resynchronises at the next frame with a correct checksum. Bytes outside frames are counted. Each byte of
garbage may look like the start of a frame, whose checksum takes 20 us: after MAX_DAMAGED of them the rest of the
received bytes is discarded, so that a sender of garbage cannot occupy the reader.

Source: https://mavlink.io/en/guide/serialization.html (frames, checksum); pymavlink's dialect for the messages.
"""

from __future__ import annotations

import functools
from typing import Any

V1, V2 = 0xFE, 0xFD
SIGNED = 0x01  # the only defined incompatibility flag
SIGNATURE_BYTES = 13
V1_EXTRA_BYTES, V2_EXTRA_BYTES = 8, 12  # header and checksum
MIN_FRAME_BYTES, MAX_FRAME_BYTES = 8, 280
SEQUENCE = 256
MAX_DAMAGED = 32  # candidate frames with a wrong checksum in one datagram or read


@functools.cache
def dialect() -> Any:
    """pymavlink's ArduPilot dialect: `common` and ArduPilot's messages."""
    from pymavlink.dialects.v20 import ardupilotmega  # imported here: it takes 0.2 s, and most commands do not need it

    return ardupilotmega


@functools.cache
def _parser() -> tuple[Any, type[Exception]]:
    """pymavlink's parser and its exception. Used per frame, it has no relevant state."""
    return dialect().MAVLink(None), dialect().MAVError


def header(data: bytes) -> tuple[tuple[int, int], int]:
    """(system id, component id) and sequence number of a frame."""
    at = 3 if data[0] == V1 else 5
    return (data[at], data[at + 1]), data[at - 1]


def timesync_target(data: bytes) -> tuple[int, int]:
    """(system id, component id) of a TIMESYNC reply's target; 0: none, as from older autopilots.

    A MAVLink 2 extension that is missing in pymavlink's ArduPilot dialect; trailing zeros are not sent.
    """
    payload = data[10 : 10 + data[1]] if data[0] == V2 else b""
    system, component = payload[16:18].ljust(2, b"\0")
    return system, component


def is_signed(data: bytes) -> bool:
    """Whether a frame's header announces a signature."""
    return data[0] == V2 and bool(data[2] & SIGNED)


def parse_frame(data: bytes) -> Any:
    """pymavlink's message of one frame, "UNKNOWN_..." outside its dialect. Raises ValueError for an invalid frame."""
    if not MIN_FRAME_BYTES <= len(data) <= MAX_FRAME_BYTES or data[0] not in (V1, V2):
        raise ValueError("not a MAVLink frame")
    if data[0] == V2 and data[2] & ~SIGNED:
        raise ValueError("unknown incompatibility flags")
    parser, parser_error = _parser()
    try:
        return parser.decode(bytearray(data))
    except parser_error as error:
        raise ValueError(str(error)) from None


def packed(message: Any, sender: Any) -> bytes:
    """The frame of a message with the next sequence number of `sender` (pymavlink's MAVLink)."""
    frame = bytes(message.pack(sender))
    sender.seq = (sender.seq + 1) % SEQUENCE
    return frame


def frame_bytes(data: bytes | bytearray, at: int = 0) -> int | None:
    """Length of the frame that begins at `at`, by its header; None: incomplete header. 0: no frame begins here."""
    if at >= len(data):
        return None
    if data[at] == V1:
        return None if at + 2 > len(data) else data[at + 1] + V1_EXTRA_BYTES
    if data[at] != V2:
        return 0
    if at + 3 > len(data):
        return None
    if data[at + 2] & ~SIGNED:
        return 0
    return data[at + 1] + V2_EXTRA_BYTES + (SIGNATURE_BYTES if data[at + 2] & SIGNED else 0)


def known(message: Any) -> bool:
    """Whether the dialect contains the message, so that its checksum was verified."""
    return not message.get_type().startswith("UNKNOWN")


def _begins(data: bytes | bytearray, at: int) -> bool:
    """Whether a frame may begin at `at`, or the data ends there: the check of a frame with unknown checksum."""
    return at == len(data) or data[at] in (V1, V2)


class FrameSplitter:
    """Extracts complete frames from received bytes. `stray_bytes` counts bytes outside frames."""

    def __init__(self) -> None:
        self.stray_bytes = 0
        self._rest = bytearray()

    def datagram(self, data: bytes) -> list[tuple[bytes, Any]]:
        """(bytes, message) of each frame in one datagram."""
        return self._frames(data, whole=True)

    def stream(self, data: bytes) -> list[tuple[bytes, Any]]:
        """(bytes, message) of each frame that these bytes complete; an incomplete frame is kept."""
        self._rest += data
        return self._frames(self._rest, whole=False)

    def reset(self) -> None:
        """Discard the kept bytes, after the stream was reopened."""
        self.stray_bytes += len(self._rest)
        self._rest.clear()

    def _frames(self, data: bytes | bytearray, whole: bool) -> list[tuple[bytes, Any]]:
        found: list[tuple[bytes, Any]] = []
        at = damaged = 0
        while at < len(data):
            if damaged > MAX_DAMAGED:
                self.stray_bytes += len(data) - at
                at = len(data)
                break
            length = frame_bytes(data, at)
            if length is None or (length and at + length > len(data)):
                if not whole:
                    break  # the rest of the frame has not arrived
                length = 0
            frame = bytes(data[at : at + length])
            message = self._message(frame) if length else None
            if message is None or not (known(message) or _begins(data, at + length)):
                self.stray_bytes += 1
                damaged += length > 0
                at += 1
            else:
                found.append((frame, message))
                at += len(frame)
        if not whole:
            del self._rest[:at]
        return found

    @staticmethod
    def _message(frame: bytes) -> Any:
        try:
            return parse_frame(frame)
        except ValueError:
            return None
