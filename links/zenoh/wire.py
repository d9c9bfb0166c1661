"""What goes with each message over a host's line, and what a receiver's record holds.

A message is its `flow.remote.codec` bytes; beside it (Zenoh's attachment) stands an envelope. All little-endian.

| envelope | |
| --- | --- |
| u64 | the sender's run: a number drawn when its process started; its clock and its counting begin anew with it |
| u64 | number of the message on this lane, from 0: a gap is what was lost |
| i64 | when it was sent [ns], sender's timeline |
| i64 | stamp_ns of the message, sender's timeline |

A record is i64 (our time - theirs) [ns], i64 (wrong by at most this) [ns], then the message's bytes: a replay decodes
it as the flight did. An answer about the time is the asked host's run (u64) and its time (i64).

Source: ours.
"""

from __future__ import annotations

import os
import struct
from typing import NamedTuple

RUN = int.from_bytes(os.urandom(8), "little")
"""This process's own."""

ENVELOPE = struct.Struct("<QQqq")
RECORD_HEAD = struct.Struct("<qq")
TIME_ANSWER = struct.Struct("<Qq")


class Envelope(NamedTuple):
    """See above."""

    run: int
    number: int
    sent_ns: int
    stamp_ns: int

    def pack(self) -> bytes:
        """As bytes."""
        return ENVELOPE.pack(*self)


def read_envelope(data: bytes | None) -> Envelope | None:
    """The envelope in an attachment; None when it is none."""
    return Envelope(*ENVELOPE.unpack(data)) if data is not None and len(data) == ENVELOPE.size else None
