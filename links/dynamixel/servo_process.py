"""Parent side of the servo process: starts and ends it, sends goals, receives readings."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

from flow.link import LinkError
from links.dynamixel import wire
from links.dynamixel.drive import DriveSettings

ROOT = Path(__file__).resolve().parents[2]  # the folder of `links`, also when grd is not installed
ALIVE_S = 0.05  # minimum interval of Alive packets to the process
BURST = 16  # packets received at a time
END_S = 1.0  # timeout of ending the process, which takes some milliseconds


class ProcessEnded(Exception):
    """The process ended without a Fatal packet: it was killed or it crashed. The text holds the exit code."""


class ServoProcess:
    """One running process, from construction to `close`; closing it stops the servo."""

    def __init__(self, settings: DriveSettings) -> None:
        self._alive_s = 0.0  # time of the newest Alive packet, monotonic
        self._socket, process_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
        with process_end:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "links.dynamixel.worker", str(process_end.fileno()), settings.text()],
                pass_fds=[process_end.fileno()],
                stdin=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": path},
            )

    def __enter__(self) -> ServoProcess:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def send(self, packet: wire.Goal | wire.Stop | wire.Alive) -> bool:
        """Send a packet without waiting; False: it could not be sent."""
        try:
            self._socket.send(wire.pack(packet), socket.MSG_DONTWAIT)
        except OSError:
            return False
        return True

    def fileno(self) -> int:
        """Readable when packets have arrived."""
        return self._socket.fileno()

    def received(self) -> Iterator[wire.Packet]:
        """Packets that have arrived. Raises LinkError with the text of a Fatal packet, or ProcessEnded.

        To be called continuously: the process stops the servo when its parent does not receive.
        """
        now_s = time.monotonic()
        if now_s >= self._alive_s + ALIVE_S:
            self._alive_s = now_s
            self.send(wire.Alive())
        for _ in range(BURST):
            try:
                data = self._received()
            except BlockingIOError:
                return
            except ConnectionError:
                data = b""
            if not data:
                raise ProcessEnded(f"code {self._process.wait(END_S)}")
            packet = wire.unpack(data)
            if isinstance(packet, wire.Fatal):
                raise LinkError(wire.text_of(packet))
            yield packet

    def _received(self) -> bytes:
        """The next packet's bytes. The reset by a process that left packets unread precedes its Fatal packet."""
        try:
            return self._socket.recv(wire.MAX_BYTES, socket.MSG_DONTWAIT)
        except ConnectionResetError:
            return self._socket.recv(wire.MAX_BYTES, socket.MSG_DONTWAIT)

    def close(self) -> None:
        """Close the socket: the process stops the servo and ends. A process that does not end is killed."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
