"""What goes over the socket between a live run and a stage that works in another process of this host.

One socket a stage; the run asks, the process answers, one at a time. All little-endian, messages as in `flow.codec`.

    question: u8 index of the input port (of `input_ports`), or FINISH, or START (first; class and settings as JSON);
              u32 length; the message
    answer:   u8 GAVE or RAISED; u32 length; the stage's counters as JSON, then each message, or what was raised as
              UTF-8: u32 length and its bytes

Source: ours.
"""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Iterator, Mapping, Sequence

START, FINISH = 254, 255
GAVE, RAISED = 0, 1
_HEAD, _LENGTH = struct.Struct("<BI"), struct.Struct("<I")


class Gone(ConnectionError):
    """The other side is there no more."""


def send(line: socket.socket, what: int, body: bytes) -> None:
    """One question or answer. Gone: nobody reads it."""
    try:
        line.sendall(_HEAD.pack(what, len(body)))
        line.sendall(body)
    except OSError as error:
        raise Gone(str(error)) from None


def receive(line: socket.socket) -> tuple[int, bytes]:
    """The next question or answer, waited for. Gone: none comes any more."""
    what, length = _HEAD.unpack(_exactly(line, _HEAD.size))
    return what, _exactly(line, length)


def packed(counters: Mapping[str, int], parts: Sequence[bytes]) -> bytes:
    """The body of an answer."""
    told = (json.dumps(dict(counters)).encode(), *parts)
    return b"".join(piece for part in told for piece in (_LENGTH.pack(len(part)), part))


def unpacked(body: bytes) -> tuple[dict[str, int], list[bytes]]:
    """What `packed` was told."""
    counters, *parts = _parts(body)
    return json.loads(counters), parts


def _parts(body: bytes) -> Iterator[bytes]:
    at = 0
    while at < len(body):
        begin = at + _LENGTH.size
        at = begin + _LENGTH.unpack_from(body, begin - _LENGTH.size)[0]
        yield body[begin:at]


def _exactly(line: socket.socket, length: int) -> bytes:
    data = bytearray(length)
    view, read = memoryview(data), 0
    while read < length:
        try:
            count = line.recv_into(view[read:])
        except OSError as error:
            raise Gone(str(error)) from None
        if not count:
            raise Gone("the line is closed")
        read += count
    return bytes(data)
