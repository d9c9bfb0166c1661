"""MAVLink 2 signing: sent frames are signed, and received frames without a valid signature are ignored.

The key file holds 32 bytes, or 64 hexadecimal digits, with mode 0600. A signature contains a time stamp that must
increase, also over restarts and regardless of the host's clock. Therefore `<key>.timestamp`, next to the key, holds an
unused time stamp, written one minute ahead so that a crash cannot cause a repetition. When the disk cannot be written,
signing continues, and the status reports that time stamps may repeat after a restart. An autopilot without a clock
continues from its last stored time: its frames are rejected until it has received ours, which the session sends to it.

Source: https://mavlink.io/en/guide/message_signing.html. Verification is ours: pymavlink 2.4 stores the time of a frame
before it verifies the signature, so that one forged frame blocks the true sender.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import stat
import threading
import time
from pathlib import Path
from typing import Any

from flow.link import LinkError
from links.mavlink.transport.framing import SIGNATURE_BYTES, header, is_signed

KEY_BYTES = 32
EPOCH_S = 1_420_070_400  # 2015-01-01, in seconds since 1970
TICK_NS = 10_000
AHEAD_TICKS = 60 * 100_000  # one minute: how far ahead the file is written, and the maximum age of a new stream
RETRY_S = 10.0  # pause after a failed write
LINK_AT, TIME_AT, HASH_AT = 13, 12, 6  # offsets from the frame's end


def ticks_of(now_ns: int) -> int:
    """A time [ns since 1970] in a signature's unit."""
    return (now_ns - EPOCH_S * 1_000_000_000) // TICK_NS


def read_key(path: Path) -> bytes:
    """The secret in a key file. Raises LinkError, whose text never contains file content."""
    try:
        mode = path.stat()
        data = path.read_bytes() if mode.st_size <= 4096 else b""
    except OSError as error:
        raise LinkError(f"signing key {path}: {error.strerror}. Check `signing_key`.") from None
    if stat.S_IMODE(mode.st_mode) & 0o077 or mode.st_uid != os.geteuid():
        raise LinkError(f"signing key {path}: other users can read it. Restrict it: chmod 600 {path}")
    if len(data) == KEY_BYTES:
        return data
    try:
        secret = bytes.fromhex(data.decode("ascii").strip())
    except ValueError:
        secret = b""
    if len(secret) != KEY_BYTES:
        raise LinkError(f"signing key {path}: must hold {KEY_BYTES} bytes, or {2 * KEY_BYTES} hexadecimal digits")
    return secret


class Signer:
    """Signs sent frames and verifies received ones; one per run, so that no time stamp repeats."""

    def __init__(self, key_file: Path, now_ns: int, link_id: int = 0) -> None:
        self.unwritten = 0  # failed writes of the time stamp file
        self.status: str | None = None  # error text while it cannot be written
        self._secret = read_key(key_file)
        self._file = key_file.with_name(key_file.name + ".timestamp")
        self._newest: dict[tuple[int, tuple[int, int]], int] = {}  # (link, sender) -> newest time stamp
        self._link_id = link_id
        self._used = max(self._read_file(), ticks_of(now_ns))
        self._writing = threading.Lock()
        self._reserved = 0  # time stamp in the file
        self._retry_at_s = 0.0
        self.write_timestamp()

    def sign_for(self, sender: Any, now_ns: int) -> None:
        """Make pymavlink's MAVLink `sender` sign its next frame. Never waits for the disk: see `write_timestamp`."""
        self._used = max(self._used + 1, ticks_of(now_ns))
        sender.signing.secret_key = self._secret
        sender.signing.sign_outgoing = True
        sender.signing.link_id = self._link_id
        sender.signing.timestamp = self._used

    def write_timestamp(self) -> None:
        """Write the time stamp file if it is due. To be called when a link is opened, and several times per minute.

        A slow disk blocks only the calling thread, not signing. A failed write is repeated after RETRY_S.
        """
        with self._writing:
            if self._used + AHEAD_TICKS // 2 >= self._reserved and time.monotonic() >= self._retry_at_s:
                self._write(self._used + AHEAD_TICKS)

    def genuine(self, frame: bytes) -> bool:
        """Whether a frame is signed with our key, regardless of its time stamp."""
        if not is_signed(frame) or len(frame) <= SIGNATURE_BYTES:
            return False
        expected = hashlib.sha256(self._secret + frame[:-HASH_AT]).digest()[:HASH_AT]
        return hmac.compare_digest(expected, frame[-HASH_AT:])

    def verify(self, frame: bytes) -> bool:
        """Whether a frame is signed with our key and newer than all previous frames of its sender."""
        if not self.genuine(frame):
            return False
        ticks = int.from_bytes(frame[-TIME_AT:-HASH_AT], "little")
        stream = frame[-LINK_AT], header(frame)[0]
        last = self._newest.get(stream)
        if ticks <= (self._used - AHEAD_TICKS if last is None else last):
            return False
        self._newest[stream] = ticks
        self._used = max(self._used, ticks)
        return True

    def close(self) -> None:
        """Write the exact last time stamp."""
        with self._writing:
            self._write(self._used + 1)

    def _read_file(self) -> int:
        try:
            return int(self._file.read_text("ascii"))
        except FileNotFoundError:
            return 0
        except (OSError, ValueError):
            raise LinkError(
                f"{self._file}: cannot be read. It holds the last time stamp of signing; delete it only when "
                "the host's clock is correct, otherwise the autopilot rejects our frames"
            ) from None

    def _write(self, ticks: int) -> None:
        """Write the file atomically; a failure is reported by `status`."""
        new_file = self._file.with_name(self._file.name + ".new")
        try:
            descriptor = os.open(new_file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
            with os.fdopen(descriptor, "w") as file:
                file.write(str(ticks))
                file.flush()
                os.fsync(file.fileno())
            new_file.replace(self._file)
        except OSError as error:
            self.unwritten += 1
            self._retry_at_s = time.monotonic() + RETRY_S
            self.status = (
                f"{self._file}: the signing time cannot be written: {error.strerror}. Signing continues; after a "
                "restart with a wrong clock the autopilot may reject it. Is the disk full, or the folder of "
                "signing_key not writable?"
            )
        else:
            self._reserved, self.status = ticks, None
