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
from pathlib import Path
from types import TracebackType

from flow.link import LinkError
from links.dynamixel import wire
from links.dynamixel.drive import DriveSettings

ROOT = Path(__file__).resolve().parents[2]  # where `links` lies, also when it is not installed
END_S = 1.0  # the process needs some milliseconds to stop the servo


class ProcessEnded(Exception):
    """The process is gone without last words: it was killed, or it crashed. The text says with what code."""


class ServoProcess:
    """One running process, from construction to `close`; closing it stops the servo where it is."""

    def __init__(self, settings: DriveSettings) -> None:
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

    def send(self, packet: wire.Goal | wire.Stop) -> bool:
        """Hand a goal over, or that it shall stop; False when that could not be."""
        try:
            self._line.send(wire.pack(packet), socket.MSG_DONTWAIT)
        except OSError:
            return False
        return True

    def receive(self, timeout_s: float) -> wire.Packet | None:
        """The next packet, None when none came in time. LinkError with its last words, or ProcessEnded."""
        try:
            if not select.select([self._line], [], [], timeout_s)[0]:
                return None
            data = self._line.recv(wire.MAX_BYTES)
        except ConnectionError:
            data = b""
        if not data:
            raise ProcessEnded(f"code {self._process.wait(END_S)}")
        packet = wire.unpack(data)
        if isinstance(packet, wire.Fatal):
            raise LinkError(wire.text_of(packet))
        return packet

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
