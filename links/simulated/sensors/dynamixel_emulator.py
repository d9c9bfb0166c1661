"""An MX-28AR on a pty: the DYNAMIXEL SDK, or any other host, talks to it as to the servo. Faults on demand.

    with DynamixelEmulator() as servo:
        Servo(port=servo.path) ...                      # links.dynamixel
        servo.output_rad(stamp_ns)                      # true angle of the turntable, for a simulated LiDAR

The emulator runs in a thread of its own, or in a process (`python -m links.simulated.sensors.dynamixel_emulator
--help`) where each line on standard input is a fault. `path` is a link to the pty; it outlives an unplugged cable.

Source: ours; pty(7). Behaviour of the servo: links/simulated/sensors/mx28.py.
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
from links.simulated.sensors.servo import Servo, ServoSettings
from stages.geometry.frames import Array64

IDLE_S = 0.02  # period at which the servo moves without requests
MOST_WAITING = 4096  # limit for the bytes of an incomplete packet


class DynamixelEmulator:
    """A servo on a pty, from `__enter__` to `__exit__`. All methods are thread safe."""

    def __init__(
        self,
        settings: ServoSettings | None = None,
        seed: int = 0,
        path: str | Path | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        firmware: int = 45,
        motor: Servo | None = None,
    ) -> None:
        """`path`: the link to the pty, by default in a temporary folder. `now_ns`: clock of the servo.

        `motor`: another one than that of the settings.
        """
        self._now_ns = now_ns
        settings = settings or ServoSettings(travel_deg=(0.0, 360.0))
        self._servo = SimulatedMx28(settings, seed, now_ns(), firmware, motor)
        self._lock = threading.RLock()
        self._folder = None if path else tempfile.TemporaryDirectory(prefix="mx28-")
        self.path = Path(path) if path else Path(self._folder.name) / "servo"  # pyright: ignore[reportOptionalMemberAccess]
        self._ends: tuple[int, int] | None = None  # of the pty; None: unplugged
        self._wake, self._woken = os.pipe()
        self._thread = threading.Thread(target=self._serve, name="dynamixel emulator", daemon=True)
        self._running = False
        self._silent = False
        self._corruptions: list[Callable[[bytes], bytes]] = []  # applied to the next replies
        self._delays_s: list[float] = []
        self._held = b""  # a reply that is not sent yet
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

    # state, for a simulation

    def position_rad(self, stamp_ns: NDArray[np.int64]) -> Array64:
        """The encoder's true position at times (n,) of its clock: in the last 8 s, not in the future."""
        with self._lock:
            self._servo.advance(self._now_ns())
            return self._servo.position_rad(stamp_ns)

    def output_rad(self, stamp_ns: NDArray[np.int64]) -> Array64:
        """The true angle of the turntable at such times, with encoder error and backlash."""
        with self._lock:
            self._servo.advance(self._now_ns())
            return self._servo.output_rad(stamp_ns)

    def get(self, register: mx28.Register) -> int:
        """Current value of a register."""
        with self._lock:
            self._servo.advance(self._now_ns())
            return self._servo.get(register)

    def set(self, register: mx28.Register, value: int) -> None:
        """Write a register without the host."""
        with self._lock:
            self._servo.set(register, value)

    # faults

    def late(self, delay_s: float, count: int = 1) -> None:
        """Delay the next replies."""
        with self._lock:
            self._delays_s += [delay_s] * count

    def hold_back(self, count: int = 1) -> None:
        """The next replies are one instruction late: each is sent just before the reply to the following one."""

        def hold(reply: bytes) -> bytes:
            held, self._held = self._held, reply
            return held

        self._corrupt_replies(hold, count)

    def garbage(self, data: bytes = b"\xff\xff\xfd\x55 garbage", count: int = 1) -> None:
        """Send bytes before the next replies."""
        self._corrupt_replies(lambda reply: data + reply, count)

    def replace(self, data: bytes, count: int = 1) -> None:
        """Send other bytes instead of the next replies."""
        self._corrupt_replies(lambda _: data, count)

    def bad_crc(self, count: int = 1) -> None:
        """Flip a bit in the next replies."""
        self._corrupt_replies(lambda reply: reply[:-1] + bytes([reply[-1] ^ 0x10]), count)

    def cut_off(self, kept_bytes: int, count: int = 1) -> None:
        """Truncate the next replies."""
        self._corrupt_replies(lambda reply: reply[:kept_bytes], count)

    def short_data(self, count: int = 1) -> None:
        """The next replies are complete packets, but their data is one byte short."""
        self._corrupt_replies(lambda reply: protocol2.status(reply[4], reply[8], reply[9:-3]), count)

    def false_position(self, position_ticks: int, count: int = 1) -> None:
        """The next position blocks (from address 126) report another position, with a valid checksum."""

        def replaced(reply: bytes) -> bytes:
            data = bytearray(reply[9:-2])
            if not 10 <= len(data) <= 20:  # the reply to another request
                self._corruptions.insert(0, replaced)
                return reply
            data[6:10] = position_ticks.to_bytes(4, "little", signed=True)
            return protocol2.status(reply[4], reply[8], bytes(data))

        self._corrupt_replies(replaced, count)

    def silence(self, silent: bool = True) -> None:
        """Receive and send nothing: a broken wire."""
        with self._lock:
            self._silent = silent

    def stall(self, overload_s: float | None = None) -> None:
        """Block the shaft; after overload_s of trying to move, the servo shuts down."""
        with self._lock:
            self._servo.block(self._now_ns(), overload_s)

    def free(self) -> None:
        """Release the shaft."""
        with self._lock:
            self._servo.unblock(self._now_ns())

    def overload(self, errors: int = mx28.OVERLOAD) -> None:
        """Set a hardware error; the servo shuts down for most of them."""
        with self._lock:
            self._servo.shut_down(self._now_ns(), errors)

    def torque_off(self) -> None:
        """Torque off, as by another host."""
        self.set(mx28.TORQUE_ENABLE, 0)

    def power_off(self) -> None:
        """The supply fails."""
        with self._lock:
            self._servo.power(self._now_ns(), False)

    def power_on(self) -> None:
        """The supply is back: the servo boots."""
        with self._lock:
            self._servo.power(self._now_ns(), True)

    def power_cycle(self) -> None:
        """The supply fails briefly."""
        self.power_off()
        self.power_on()

    def unplug(self) -> None:
        """The serial adapter is unplugged: the pty closes and the path is a dead link."""
        with self._lock:
            if self._ends is not None:
                self.path.unlink(missing_ok=True)
                for end in self._ends:
                    os.close(end)
                self._ends = None

    def plug_in(self) -> None:
        """The adapter is plugged in again, on another pty, under the same path."""
        with self._lock:
            if self._ends is None:
                host, servo = os.openpty()
                tty.setraw(servo)
                os.set_blocking(host, False)
                self._ends = host, servo  # the servo's end stays open; otherwise a closing host would close the pty
                fresh = self.path.with_name(self.path.name + ".new")
                fresh.unlink(missing_ok=True)
                fresh.symlink_to(os.ttyname(servo))
                fresh.replace(self.path)
        os.write(self._woken, b"x")

    def _corrupt_replies(self, how: Callable[[bytes], bytes], count: int) -> None:
        with self._lock:
            self._corruptions += [how] * count

    # the servo's thread

    def _serve(self) -> None:
        stream = bytearray()
        while self._running:
            ends = self._ends
            watched = [self._wake] + ([ends[0]] if ends else [])
            try:
                ready, _, _ = select.select(watched, [], [], IDLE_S)
            except (OSError, ValueError):  # unplugged during the wait
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
                replies = self._answers(stream, now_ns)
            for delay_s, reply in replies:
                if delay_s:
                    threading.Timer(delay_s, self._reply, (reply,)).start()
                else:
                    self._reply(reply)

    def _answers(self, stream: bytearray, now_ns: int) -> list[tuple[float, bytes]]:
        """Replies to the instructions in a stream, each with its delay."""
        found: list[tuple[float, bytes]] = []
        while (instruction := protocol2.take(stream)) is not None:
            if self._silent or not self._baud_matches():
                continue
            self.instructions += 1
            reply = self._servo.reply(instruction, now_ns)
            if reply is not None:
                if self._corruptions:
                    reply = self._corruptions.pop(0)(reply)
                else:
                    reply, self._held = self._held + reply, b""
                found.append((self._delays_s.pop(0) if self._delays_s else 0.0, reply))
        return found

    def _baud_matches(self) -> bool:
        """Whether the host uses the servo's baud rate."""
        assert self._ends is not None
        return termios.tcgetattr(self._ends[1])[5] == getattr(termios, f"B{self._servo.baud()}", None)

    def _reply(self, reply: bytes) -> None:
        with self._lock:
            if self._ends is not None:
                with contextlib.suppress(BlockingIOError, OSError):  # a host that does not read or is closed
                    os.write(self._ends[0], reply)


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
    """Run a servo in this process until standard input ends. Each line is a fault with its numbers."""
    parser = argparse.ArgumentParser(
        description=main.__doc__, epilog=f"faults: {', '.join(FAULTS)}; e.g. 'late 0.03 2'"
    )
    parser.add_argument("path", type=Path, help="link to the pty that is created")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with DynamixelEmulator(seed=options.seed, path=options.path) as emulator:
        for line in sys.stdin:
            name, *numbers = line.split() or [""]
            if name not in FAULTS:
                sys.stderr.write(f"no such fault: {name!r}; available: {', '.join(FAULTS)}\n")
                continue
            try:
                getattr(emulator, name)(*(float(n) if "." in n else int(n) for n in numbers))
            except (TypeError, ValueError) as error:
                sys.stderr.write(f"{name}: {error}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
