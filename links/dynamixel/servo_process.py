"""The parent's side of the servo's process: starts it, hands it goals, takes its readings, ends it.

Source: ours.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType

from flow.link import LinkError
from links.dynamixel import wire
from links.dynamixel.drive import DriveSettings

ROOT = Path(__file__).resolve().parents[2]  # where `links` lies, also when it is not installed
ALIVE_S = 0.05  # so often it is told that its readings are taken, at most
END_S = 1.0  # the process needs some milliseconds to stop the servo


class ProcessEnded(Exception):
    """The process is gone without last words: it was killed, or it crashed. The text says with what code."""


class ServoProcess:
    """One running process, from construction to `close`; closing it stops the servo where it is."""

    def __init__(self, settings: DriveSettings) -> None:
        self._alive_s = 0.0  # when it was told last
        self._line, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "links.dynamixel.worker", str(theirs.fileno()), settings.text()],
                pass_fds=[theirs.fileno()],
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
        """The process's id."""
        return self._process.pid

    def send(self, packet: wire.Goal | wire.Stop | wire.Alive) -> bool:
        """Hand a goal over, that it shall stop, or that all is well; False when that could not be."""
        try:
            self._line.send(wire.pack(packet), socket.MSG_DONTWAIT)
        except OSError:
            return False
        return True

    def receive(self, timeout_s: float) -> wire.Packet | None:
        """The next packet, None when none came in time. LinkError with its last words, or ProcessEnded.

        Call it again and again: the process stops the servo for a parent that takes nothing any more.
        """
        now_s = time.monotonic()
        if now_s >= self._alive_s + ALIVE_S:
            self._alive_s = now_s
            self.send(wire.Alive())
        try:
            if not select.select([self._line], [], [], timeout_s)[0]:
                return None
            data = self._received()
        except ConnectionError:
            data = b""
        if not data:
            raise ProcessEnded(f"code {self._process.wait(END_S)}")
        packet = wire.unpack(data)
        if isinstance(packet, wire.Fatal):
            raise LinkError(wire.text_of(packet))
        return packet

    def _received(self) -> bytes:
        """The next bytes. One that ended without reading all is told first, and its last words wait behind that."""
        try:
            return self._line.recv(wire.MAX_BYTES)
        except ConnectionResetError:
            return self._line.recv(wire.MAX_BYTES)

    def close(self) -> None:
        """End of the line: the process stops the servo and ends; one that hangs is killed."""
        with contextlib.suppress(OSError):
            self._line.shutdown(socket.SHUT_RDWR)
        self._line.close()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
