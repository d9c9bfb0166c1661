"""MAVLink 2 signatures: what we send is signed, what is not signed with our key is not heard.

The key file holds 32 bytes, or 64 hexadecimal digits, and belongs to us alone (mode 0600). A signature carries a time
that must grow for ever, over restarts and whatever the host's clock says: beside the key, in `<key>.timestamp`, stands
one that has not been used yet, written a minute ahead so that a crash cannot repeat one. A disk that takes no more ends
no flight: the times go on growing, and it is said that after a restart they may not. An autopilot without a clock goes
on from the time it noted last: it is not heard until it has heard ours, which the session sends it all the same.

Source: https://mavlink.io/en/guide/message_signing.html. Verifying is ours: pymavlink 2.4 notes the time of a frame
before it has looked at the signature, so that one forged frame silences the true sender.
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
from links.mavlink.wire import SIGNATURE_BYTES, header, is_signed

KEY_BYTES = 32
EPOCH_S = 1_420_070_400  # 2015-01-01, in seconds since 1970
TICK_NS = 10_000
AHEAD_TICKS = 60 * 100_000  # a minute: how far ahead of use the file is written, and how old a new stream may be
RETRY_S = 10.0  # a disk that took nothing
LINK_AT, TIME_AT, HASH_AT = 13, 12, 6  # from the frame's end


def ticks_of(now_ns: int) -> int:
    """A time [ns since 1970] in a signature's unit."""
    return (now_ns - EPOCH_S * 1_000_000_000) // TICK_NS


def read_key(path: Path) -> bytes:
    """The secret of a key file. LinkError says what is wrong with the file, never what is in it."""
    try:
        mode = path.stat()
        data = path.read_bytes() if mode.st_size <= 4096 else b""
    except OSError as error:
        raise LinkError(f"signing key {path}: {error.strerror}. Check `signing_key`.") from None
    if stat.S_IMODE(mode.st_mode) & 0o077 or mode.st_uid != os.geteuid():
        raise LinkError(f"signing key {path}: others may read it. Make it yours alone: chmod 600 {path}")
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
    """Signs what a pymavlink sender packs and verifies what comes in; one for a run, so that no time comes again."""

    def __init__(self, key_file: Path, now_ns: int, link_id: int = 0) -> None:
        self.unwritten = 0  # times that the file could not be written
        self.status: str | None = None  # in words, while it cannot
        self._secret = read_key(key_file)
        self._file = key_file.with_name(key_file.name + ".timestamp")
        self._heard: dict[tuple[int, tuple[int, int]], int] = {}  # (link, sender) -> newest time
        self._link_id = link_id
        self._used = max(self._read_file(), ticks_of(now_ns))
        self._writing = threading.Lock()
        self._reserved = 0  # stands in the file
        self._retry_at_s = 0.0
        self.keep()

    def sign_for(self, sender: Any, now_ns: int) -> None:
        """Make pymavlink's MAVLink `sender` sign what it packs next. It never waits for the disk: see `keep`."""
        self._used = max(self._used + 1, ticks_of(now_ns))
        sender.signing.secret_key = self._secret
        sender.signing.sign_outgoing = True
        sender.signing.link_id = self._link_id
        sender.signing.timestamp = self._used

    def keep(self) -> None:
        """Write the file ahead where it is time; to be called when a link is opened and many times a minute from then.

        From any thread: one that waits for a slow disk holds up none that signs. What fails is tried again later.
        """
        with self._writing:
            if self._used + AHEAD_TICKS // 2 >= self._reserved and time.monotonic() >= self._retry_at_s:
                self._write(self._used + AHEAD_TICKS)

    def genuine(self, frame: bytes) -> bool:
        """Whether a frame is signed with our key, whatever its time."""
        if not is_signed(frame) or len(frame) <= SIGNATURE_BYTES:
            return False
        wanted = hashlib.sha256(self._secret + frame[:-HASH_AT]).digest()[:HASH_AT]
        return hmac.compare_digest(wanted, frame[-HASH_AT:])

    def verify(self, frame: bytes) -> bool:
        """Whether a frame is signed with our key and newer than those before it from the same sender."""
        if not self.genuine(frame):
            return False
        ticks = int.from_bytes(frame[-TIME_AT:-HASH_AT], "little")
        stream = frame[-LINK_AT], header(frame)[0]
        last = self._heard.get(stream)
        if ticks <= (self._used - AHEAD_TICKS if last is None else last):
            return False
        self._heard[stream] = ticks
        self._used = max(self._used, ticks)
        return True

    def close(self) -> None:
        """Note the time used last, exactly."""
        with self._writing:
            self._write(self._used + 1)

    def _read_file(self) -> int:
        try:
            return int(self._file.read_text("ascii"))
        except FileNotFoundError:
            return 0
        except (OSError, ValueError):
            raise LinkError(
                f"{self._file}: cannot be read. It holds the time of the last signature; delete it only when the "
                "host's clock is right, or the autopilot refuses what we sign"
            ) from None

    def _write(self, ticks: int) -> None:
        """Write the file, or say that it cannot be: who signs need not know."""
        fresh = self._file.with_name(self._file.name + ".new")
        try:
            descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
            with os.fdopen(descriptor, "w") as file:
                file.write(str(ticks))
                file.flush()
                os.fsync(file.fileno())
            fresh.replace(self._file)
        except OSError as error:
            self.unwritten += 1
            self._retry_at_s = time.monotonic() + RETRY_S
            self.status = (
                f"{self._file}: the signing time cannot be written: {error.strerror}. Signing goes on; after a restart "
                "with a wrong clock the autopilot may refuse it. Is the disk full, or signing_key's folder not ours?"
            )
        else:
            self._reserved, self.status = ticks, None
