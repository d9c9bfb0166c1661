"""Envelope of messages between hosts, and the layout of a receiver's records. All little-endian.

A message is its `flow.remote.codec` bytes; its Zenoh attachment is an envelope:

| envelope | |
| --- | --- |
| u64 | the sender's run: a random number of its process; clock and numbering restart with it |
| u64 | number of the message in its output queue, from 0; a gap means lost messages |
| i64 | time of sending [ns], sender's timeline |
| i64 | stamp_ns of the message, sender's timeline |

A record is i64 clock offset (local - peer) [ns], i64 bound of its error [ns], then the message's bytes, so that a
replay decodes it as the live run did. A time reply is the peer's run (u64) and its time (i64).
"""

from __future__ import annotations

import os
import struct
from typing import NamedTuple

RUN = int.from_bytes(os.urandom(8), "little")
"""The run of this process."""

ENVELOPE = struct.Struct("<QQqq")
RECORD_HEAD = struct.Struct("<qq")
TIME_REPLY = struct.Struct("<Qq")


class Envelope(NamedTuple):
    """Metadata of one message, see the module's docstring."""

    run: int
    number: int
    sent_ns: int
    stamp_ns: int

    def pack(self) -> bytes:
        """As bytes."""
        return ENVELOPE.pack(*self)


def read_envelope(data: bytes | None) -> Envelope | None:
    """The envelope in an attachment; None: the attachment is not an envelope."""
    return Envelope(*ENVELOPE.unpack(data)) if data is not None and len(data) == ENVELOPE.size else None
