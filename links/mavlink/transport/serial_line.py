"""A serial device as a line. Closing it throws away what it has not sent.

Source: ours; tty_ioctl(4) TIOCOUTQ for what that is; pyserial sets up the device.
"""

from __future__ import annotations

import contextlib
import os
import select
import termios
from typing import Any

from flow.link import LinkError
from links.mavlink.transport.connection import Endpoint

CHUNK_BYTES = 4096
SERIAL_BACKLOG_BYTES = 512  # not through yet: two poses more, 6 ms at 921600 baud


class SerialLine:
    """A serial device, 8N1, raw."""

    backlog_bytes = SERIAL_BACKLOG_BYTES

    def __init__(self, endpoint: Endpoint) -> None:
        self.name = endpoint.host
        self._baud = endpoint.port
        self._port: Any = None  # serial.Serial

    def open(self) -> None:
        """Open the device for us alone. LinkError."""
        import serial  # here: a UDP link needs none of it

        try:
            self._port = serial.Serial(self.name, self._baud, timeout=0.0, write_timeout=0.0, exclusive=True)
        except (OSError, ValueError) as error:  # serial.SerialException is an OSError
            raise LinkError(
                f"cannot open {self.name} at {self._baud} baud: {error}. Is it plugged in, is no other program using "
                "it, and may you use it (group dialout)? Check `connection`."
            ) from None

    def read(self, timeout_s: float) -> bytes:
        """What has arrived. OSError: it is gone."""
        port = self._there()
        if not select.select([port], [], [], timeout_s)[0]:
            return b""
        data = os.read(port.fileno(), CHUNK_BYTES)
        if not data:  # readable, and nothing to read: unplugged
            raise ConnectionResetError("unplugged")
        return data

    def write(self, data: bytes) -> int:
        """Bytes taken."""
        try:
            return os.write(self._there().fileno(), data)  # pyserial's own write spins while the line is full
        except BlockingIOError:
            return 0

    def waiting_bytes(self) -> int:
        """Bytes that the line has not sent."""
        return self._there().out_waiting

    def close(self) -> None:
        """Let go of the device. What it has not sent is thrown away."""
        if self._port is not None:
            with contextlib.suppress(OSError, termios.error):
                self._port.reset_output_buffer()
            with contextlib.suppress(OSError):
                self._port.close()
            self._port = None

    def _there(self) -> Any:
        if self._port is None:
            raise ConnectionResetError("not open")
        return self._port
