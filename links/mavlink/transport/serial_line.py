"""Serial line. Closing it discards the bytes that were not transmitted.

Source: tty_ioctl(4), TIOCOUTQ; pyserial configures the device.
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
SERIAL_BACKLOG_BYTES = 512  # limit before a new frame: two poses, 6 ms at 921600 baud


class SerialLine:
    """A serial device, 8N1, raw."""

    backlog_bytes = SERIAL_BACKLOG_BYTES

    def __init__(self, endpoint: Endpoint) -> None:
        self.name = endpoint.host
        self._baud = endpoint.port
        self._port: Any = None  # serial.Serial

    def open(self) -> None:
        """Open the device exclusively. Raises LinkError."""
        import serial  # imported here: not needed for UDP

        try:
            self._port = serial.Serial(self.name, self._baud, timeout=0.0, write_timeout=0.0, exclusive=True)
        except (OSError, ValueError) as error:  # serial.SerialException is an OSError
            raise LinkError(
                f"cannot open {self.name} at {self._baud} baud: {error}. Is it plugged in, not used by another "
                "program, and are you in the group dialout? Check `connection`."
            ) from None

    def read(self, timeout_s: float) -> bytes:
        """Received bytes. Raises OSError when the line is lost."""
        port = self._opened()
        if not select.select([port], [], [], timeout_s)[0]:
            return b""
        data = os.read(port.fileno(), CHUNK_BYTES)
        if not data:  # readable but empty: unplugged
            raise ConnectionResetError("unplugged")
        return data

    def write(self, data: bytes) -> int:
        """Write without blocking; returns the number of accepted bytes."""
        try:
            return os.write(self._opened().fileno(), data)  # pyserial's own write busy-waits while the buffer is full
        except BlockingIOError:
            return 0

    def buffered_bytes(self) -> int:
        """Bytes that were not transmitted yet."""
        return self._opened().out_waiting

    def close(self) -> None:
        """Close the device and discard its send buffer."""
        if self._port is not None:
            with contextlib.suppress(OSError, termios.error):
                self._port.reset_output_buffer()
            with contextlib.suppress(OSError):
                self._port.close()
            self._port = None

    def _opened(self) -> Any:
        if self._port is None:
            raise ConnectionResetError("not open")
        return self._port
