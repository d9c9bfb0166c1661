"""An MX-28AR on a pty: the real SDK, or any other host, talks to it as to the servo; faults come when asked for.

    with DynamixelEmulator() as servo:
        Servo(port=servo.path) ...                      # links.dynamixel
        servo.output_rad(stamp_ns)                      # where the turntable truly stood, for a simulated LiDAR

The emulator has a thread of its own; alone in a process: `python -m links.simulated.sensors.dynamixel_emulator --help`,
where faults are lines on standard input. `path` is a link that leads to the pty and outlives an unplugged cable.

Source: ours; pty(7). What the servo does: links/simulated/sensors/mx28.py.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import sys
import tempfile
import termios
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from links.dynamixel import mx28
from links.simulated.sensors import protocol2
from links.simulated.sensors.mx28 import SimulatedMx28
from links.simulated.sensors.servo import ServoSettings
from stages.geometry import Array64

IDLE_S = 0.02  # how often the servo moves on without being asked
MOST_WAITING = 4096  # bytes of a packet that does not end


class DynamixelEmulator:
    """A servo on a pty, from `__enter__` to `__exit__`. Every method may be called from any thread."""

    def __init__(
        self,
        settings: ServoSettings | None = None,
        seed: int = 0,
        path: str | Path | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        firmware: int = 45,
    ) -> None:
        """`path`: where the link to the pty is made, by default in a folder of its own. `now_ns`: its clock."""
        self._now_ns = now_ns
        self._servo = SimulatedMx28(settings or ServoSettings(travel_deg=(0.0, 360.0)), seed, now_ns(), firmware)
        self._lock = threading.RLock()
        self._folder = None if path else tempfile.TemporaryDirectory(prefix="mx28-")
        self.path = Path(path) if path else Path(self._folder.name) / "servo"  # pyright: ignore[reportOptionalMemberAccess]
        self._ends: tuple[int, int] | None = None  # of the pty; None: unplugged
        self._wake, self._woken = os.pipe()
        self._thread = threading.Thread(target=self._serve, name="dynamixel emulator", daemon=True)
        self._running = False
        self._silent = False
        self._spoilt: list[Callable[[bytes], bytes]] = []  # what becomes of the next answers
        self._delays_s: list[float] = []
        self._held = b""  # an answer that is not said yet
        self.instructions = 0

    def __enter__(self) -> DynamixelEmulator:
        self.plug_in()
        self._running = True
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._running = False
        os.write(self._woken, b"x")
        self._thread.join()
        self.unplug()
        os.close(self._wake)
        os.close(self._woken)
        if self._folder is not None:
            self._folder.cleanup()

    # what a simulation wants to know

    def position_rad(self, stamp_ns: NDArray[np.int64]) -> Array64:
        """The encoder's true position at times (n,) of its clock, within the last 8 s and not in the future."""
        with self._lock:
            self._servo.advance(self._now_ns())
            return self._servo.position_rad(stamp_ns)

    def output_rad(self, stamp_ns: NDArray[np.int64]) -> Array64:
        """The turntable's true angle at such times: with the encoder's error and the play."""
        with self._lock:
            self._servo.advance(self._now_ns())
            return self._servo.output_rad(stamp_ns)

    def get(self, register: mx28.Register) -> int:
        """A register as it stands."""
        with self._lock:
            self._servo.advance(self._now_ns())
            return self._servo.get(register)

    def set(self, register: mx28.Register, value: int) -> None:
        """Change a register behind the host's back."""
        with self._lock:
            self._servo.set(register, value)

    # faults

    def late(self, delay_s: float, count: int = 1) -> None:
        """The next answers come so much later."""
        with self._lock:
            self._delays_s += [delay_s] * count

    def hold_back(self, count: int = 1) -> None:
        """The next answers come one instruction late: each just before the answer to the following one."""

        def hold(answer: bytes) -> bytes:
            said, self._held = self._held, answer
            return said

        self._spoil(hold, count)

    def garbage(self, data: bytes = b"\xff\xff\xfd\x55 garbage", count: int = 1) -> None:
        """Bytes before the next answers."""
        self._spoil(lambda answer: data + answer, count)

    def replace(self, data: bytes, count: int = 1) -> None:
        """Other bytes in place of the next answers."""
        self._spoil(lambda _: data, count)

    def bad_crc(self, count: int = 1) -> None:
        """The next answers have a bit flipped."""
        self._spoil(lambda answer: answer[:-1] + bytes([answer[-1] ^ 0x10]), count)

    def cut_off(self, kept_bytes: int, count: int = 1) -> None:
        """The next answers end early."""
        self._spoil(lambda answer: answer[:kept_bytes], count)

    def short_data(self, count: int = 1) -> None:
        """The next answers are whole, but their data is one byte short."""
        self._spoil(lambda answer: protocol2.status(answer[4], answer[8], answer[9:-3]), count)

    def false_position(self, position_ticks: int, count: int = 1) -> None:
        """The next position blocks (from 126 on) tell another position, with the right checksum."""

        def told(answer: bytes) -> bytes:
            data = bytearray(answer[9:-2])
            if not 10 <= len(data) <= 20:  # the answer to something else
                self._spoilt.insert(0, told)
                return answer
            data[6:10] = position_ticks.to_bytes(4, "little", signed=True)
            return protocol2.status(answer[4], answer[8], bytes(data))

        self._spoil(told, count)

    def silence(self, silent: bool = True) -> None:
        """It hears and says nothing: a broken wire."""
        with self._lock:
            self._silent = silent

    def stall(self, overload_s: float | None = None) -> None:
        """Something holds the shaft; after overload_s of wanting to move the servo shuts down."""
        with self._lock:
            self._servo.block(self._now_ns(), overload_s)

    def free(self) -> None:
        """The shaft is free again."""
        with self._lock:
            self._servo.unblock(self._now_ns())

    def overload(self, errors: int = mx28.OVERLOAD) -> None:
        """It has a hardware error now, and shuts down for most."""
        with self._lock:
            self._servo.shut_down(self._now_ns(), errors)

    def torque_off(self) -> None:
        """Somebody else switches its torque off."""
        self.set(mx28.TORQUE_ENABLE, 0)

    def power_off(self) -> None:
        """Its supply fails."""
        with self._lock:
            self._servo.power(self._now_ns(), False)

    def power_on(self) -> None:
        """Its supply is back: it boots."""
        with self._lock:
            self._servo.power(self._now_ns(), True)

    def power_cycle(self) -> None:
        """Its supply fails for a moment."""
        self.power_off()
        self.power_on()

    def unplug(self) -> None:
        """The serial adapter is pulled out: the pty ends, the path leads nowhere."""
        with self._lock:
            if self._ends is not None:
                self.path.unlink(missing_ok=True)
                for end in self._ends:
                    os.close(end)
                self._ends = None

    def plug_in(self) -> None:
        """It is back, on another pty, under the same path."""
        with self._lock:
            if self._ends is None:
                host, servo = os.openpty()
                tty.setraw(servo)
                os.set_blocking(host, False)
                self._ends = host, servo  # the servo's end stays open here, or the host's closing would end the pty
                fresh = self.path.with_name(self.path.name + ".new")
                fresh.unlink(missing_ok=True)
                fresh.symlink_to(os.ttyname(servo))
                fresh.replace(self.path)
        os.write(self._woken, b"x")

    def _spoil(self, how: Callable[[bytes], bytes], count: int) -> None:
        with self._lock:
            self._spoilt += [how] * count

    # its thread

    def _serve(self) -> None:
        stream = bytearray()
        while self._running:
            ends = self._ends
            watched = [self._wake] + ([ends[0]] if ends else [])
            try:
                ready, _, _ = select.select(watched, [], [], IDLE_S)
            except (OSError, ValueError):  # unplugged under the wait
                continue
            if self._wake in ready:
                os.read(self._wake, 64)
            with self._lock:
                now_ns = self._now_ns()
                self._servo.advance(now_ns)
                if self._ends is None or self._ends != ends:
                    stream.clear()
                    continue
                with contextlib.suppress(BlockingIOError):
                    stream += os.read(self._ends[0], MOST_WAITING)
                del stream[:-MOST_WAITING]
                answers = self._answers(stream, now_ns)
            for delay_s, answer in answers:
                if delay_s:
                    threading.Timer(delay_s, self._say, (answer,)).start()
                else:
                    self._say(answer)

    def _answers(self, stream: bytearray, now_ns: int) -> list[tuple[float, bytes]]:
        """What is said to the instructions in a stream, each with its delay."""
        found: list[tuple[float, bytes]] = []
        while (instruction := protocol2.take(stream)) is not None:
            if self._silent or not self._hears():
                continue
            self.instructions += 1
            answer = self._servo.answer(instruction, now_ns)
            if answer is not None:
                if self._spoilt:
                    answer = self._spoilt.pop(0)(answer)
                else:
                    answer, self._held = self._held + answer, b""
                found.append((self._delays_s.pop(0) if self._delays_s else 0.0, answer))
        return found

    def _hears(self) -> bool:
        """Whether the host talks at the servo's rate."""
        assert self._ends is not None
        return termios.tcgetattr(self._ends[1])[5] == getattr(termios, f"B{self._servo.baud()}", None)

    def _say(self, answer: bytes) -> None:
        with self._lock:
            if self._ends is not None:
                with contextlib.suppress(BlockingIOError, OSError):  # a host that does not read, or has gone
                    os.write(self._ends[0], answer)


FAULTS = (
    "late",
    "hold_back",
    "garbage",
    "bad_crc",
    "cut_off",
    "short_data",
    "false_position",
    "silence",
    "stall",
    "free",
    "overload",
    "torque_off",
    "power_off",
    "power_on",
    "power_cycle",
    "unplug",
    "plug_in",
)


def main() -> int:
    """A servo alone in its process, until standard input ends. Each line is a fault and its numbers."""
    parser = argparse.ArgumentParser(
        description=main.__doc__, epilog=f"faults: {', '.join(FAULTS)}; e.g. 'late 0.03 2'"
    )
    parser.add_argument("path", type=Path, help="where the link to the pty is made")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with DynamixelEmulator(seed=options.seed, path=options.path) as emulator:
        for line in sys.stdin:
            name, *numbers = line.split() or [""]
            if name not in FAULTS:
                sys.stderr.write(f"no such fault: {name!r}; there are {', '.join(FAULTS)}\n")
                continue
            try:
                getattr(emulator, name)(*(float(n) if "." in n else int(n) for n in numbers))
            except (TypeError, ValueError) as error:
                sys.stderr.write(f"{name}: {error}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
