"""One servo on its serial line through dynamixel-sdk: block reads, writes, ping and reboot that fail loudly.

What the SDK (4.1) does, and what is done about it here:

- it busy-waits: the port here sleeps in select() until bytes come;
- it takes any status packet of the right id for the answer, so a late reply becomes the next answer: the length of a
  reply must be the one asked for (`Bus.read` of the position asks for a different length each time), and after every
  failure the line is read until it has been silent (`resync`);
- it gives 0 for data when a read or ping fails, even for a model number out of a packet without one, and raises
  IndexError on short data: nothing is used but whole packets of the length asked for;
- a babbling line keeps it in its loop for ever: past the deadline the port gives it no more bytes;
- it leaves `is_using` set when an exchange was cut off by an unplugged cable: a new port is made at every opening;
- it reads time from the wall clock, which may step: the port uses the monotonic clock.

Source: dynamixel-sdk 4.1, port_handler.py and protocol2_packet_handler.py; the remedies are ours.
"""

from __future__ import annotations

import contextlib
import select
import termios
import time
from dataclasses import dataclass
from typing import Any

import serial
from dynamixel_sdk import PortHandler, Protocol2PacketHandler
from dynamixel_sdk.robotis_def import (
    COMM_RX_CORRUPT,
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    INST_PING,
    INST_READ,
    INST_REBOOT,
    INST_WRITE,
)

from links.dynamixel import mx28

QUIET_S = 0.004  # a line this long silent holds no late reply any more
WRITE_S = 0.1  # a port that takes no bytes for so long is dead
RESYNC_S = 0.05  # a line that talks on for longer is not ours to wait for
STATUS_OVERHEAD = 4  # of a status packet's length field: instruction, error, CRC
PARAMETERS_AT = 9  # in a status packet
PING_BYTES = 3  # model number, firmware
_GONE = (serial.SerialException, OSError, termios.error, TypeError)  # TypeError: pyserial's closed file descriptor


class BusError(Exception):
    """An exchange that did not succeed. `kind` is the counter it belongs to."""

    kind = "failed"


class NoReply(BusError):
    """Nothing came in time."""

    kind = "no reply"


class BadReply(BusError):
    """Something came that is no whole, undamaged status packet."""

    kind = "damaged"


class WrongReply(BusError):
    """A good status packet that answers something else: a late one."""

    kind = "late or foreign"


class Gone(BusError):
    """The serial port is no longer there, or cannot be opened."""

    kind = "unplugged"


class Refused(BusError):
    """The servo answered with an error number."""

    kind = "refused by the servo"

    def __init__(self, what: str, number: int) -> None:
        super().__init__(f"{what}: {mx28.REFUSALS.get(number, f'error {number}')}")
        self.number = number


@dataclass(frozen=True, slots=True)
class Reply:
    """One good answer."""

    data: bytes
    alert: bool  # the servo has a hardware error
    request_ns: int  # before the request went out, monotonic
    reply_ns: int  # when the answer was whole


class BlockingPort(PortHandler):
    """The SDK's port, which waits instead of spinning, on the monotonic clock, never beyond its deadline."""

    def __init__(self, name: str, baud: int, reply_timeout_s: float) -> None:
        super().__init__(name)
        self.baudrate = baud
        self.low_latency = False
        self._reply_timeout_ms = 1e3 * reply_timeout_s

    def setupPort(self, cflag_baud: int) -> bool:
        """Open it, for one process alone."""
        self.ser = serial.Serial(self.port_name, self.baudrate, timeout=0, write_timeout=WRITE_S, exclusive=True)
        self.is_open = True
        self.ser.reset_input_buffer()
        self.tx_time_per_byte = 10e3 / self.baudrate
        with contextlib.suppress(
            ValueError, OSError, NotImplementedError
        ):  # FTDI waits 16 ms for more bytes otherwise; a pty cannot
            self.ser.set_low_latency_mode(True)
            self.low_latency = True
        return True

    def readPort(self, length: int) -> bytes:
        """Up to `length` bytes: waits for the first one, at most until the packet's deadline."""
        left_s = 1e-3 * (self.packet_timeout - self.getTimeSinceStart())
        if length <= 0 or left_s <= 0:
            return b""
        ready, _, _ = select.select([self.ser.fileno()], [], [], left_s)
        return self.ser.read(length) if ready else b""

    def setPacketTimeout(self, packet_length: int) -> None:
        """The deadline of a reply of so many bytes, from now."""
        self.setPacketTimeoutMillis(self.tx_time_per_byte * packet_length + self._reply_timeout_ms)

    def getCurrentTime(self) -> float:
        """Milliseconds of the monotonic clock."""
        return 1e-6 * time.monotonic_ns()

    def drain(self, quiet_s: float, limit_s: float) -> int:
        """Throw away what comes until the line was silent for quiet_s, at most limit_s: how many bytes came."""
        dropped, deadline_s = 0, time.monotonic() + limit_s
        while time.monotonic() < deadline_s and select.select([self.ser.fileno()], [], [], quiet_s)[0]:
            dropped += len(self.ser.read(4096))
        return dropped


class Bus:
    """The line to one servo, over an open port. Every failure is a BusError."""

    def __init__(self, port: BlockingPort, servo_id: int) -> None:
        self._id, self._port = servo_id, port
        self._handler: Any = Protocol2PacketHandler()

    @classmethod
    def open(cls, port: str, baud: int, servo_id: int, reply_timeout_s: float) -> Bus:
        """The line over a serial port. Gone when it cannot be opened."""
        line = BlockingPort(port, baud, reply_timeout_s)
        try:
            opened = line.openPort()
        except (*_GONE, ValueError) as error:
            raise Gone(f"cannot open {port}: {error}") from error
        if not opened:
            raise Gone(f"cannot open {port} at {baud} baud: the SDK knows no such rate")
        bus = cls(line, servo_id)
        bus.resync()  # who used the port before may not have waited for its last answer
        return bus

    @property
    def low_latency(self) -> bool:
        """Whether the serial driver was told not to wait for more bytes."""
        return self._port.low_latency

    def close(self) -> None:
        """Give the port back; harmless when it is gone."""
        with contextlib.suppress(*_GONE):
            self._port.closePort()

    def read(self, address: int, length: int) -> Reply:
        """A block of the control table."""
        parameters = address.to_bytes(2, "little") + length.to_bytes(2, "little")
        return self._exchange(f"read {address}..{address + length - 1}", INST_READ, parameters, length)

    def write(self, register: mx28.Register, *values: int) -> None:
        """Values of this register and those that follow it without a gap, each of the same size."""
        data = b"".join(register.bytes(value) for value in values)
        what = f"write {', '.join(map(str, values))} to {register.name} ({register.address})"
        self._exchange(what, INST_WRITE, register.address.to_bytes(2, "little") + data, 0)

    def write_unanswered(self, register: mx28.Register, value: int) -> None:
        """Write to a servo that may be set to answer nothing."""
        self._call(self._handler.writeTxOnly, self._id, register.address, register.size, list(register.bytes(value)))
        self.resync()

    def ping(self) -> int:
        """The model number of the servo that answers to the id."""
        data = self._exchange("ping", INST_PING, b"", PING_BYTES).data
        return int.from_bytes(data[:2], "little")

    def reboot(self) -> None:
        """Restart the servo: the only way out of a shutdown. It answers nothing for a while after."""
        self._exchange("reboot", INST_REBOOT, b"", 0)

    def resync(self) -> int:
        """Wait until the line is silent: how many bytes of late or damaged replies were thrown away."""
        try:
            return self._port.drain(QUIET_S, RESYNC_S)
        except _GONE as error:
            raise Gone(f"the serial port is gone: {error}") from error

    def _exchange(self, what: str, instruction: int, parameters: bytes, answer_bytes: int) -> Reply:
        packet = [0] * (10 + len(parameters))  # header, id, length, instruction, parameters, CRC: the SDK fills it in
        packet[4:8] = self._id, len(parameters) + 3, 0, instruction
        packet[8 : 8 + len(parameters)] = parameters
        request_ns = time.monotonic_ns()
        answer, result, error = self._call(self._handler.txRxPacket, packet)
        reply_ns = time.monotonic_ns()
        self._check(what, result)
        length = answer[5] | answer[6] << 8
        if error & ~mx28.ALERT:
            raise Refused(what, error & ~mx28.ALERT)
        if length != answer_bytes + STATUS_OVERHEAD or len(answer) < PARAMETERS_AT + answer_bytes:
            self.resync()
            raise WrongReply(f"{what}: an answer of {length - STATUS_OVERHEAD} bytes, not {answer_bytes}")
        data = bytes(answer[PARAMETERS_AT : PARAMETERS_AT + answer_bytes])
        return Reply(data, bool(error & mx28.ALERT), request_ns, reply_ns)

    def _call(self, method: Any, *arguments: Any) -> Any:
        try:
            return method(self._port, *arguments)
        except IndexError as error:  # a packet shorter than its kind
            self._port.is_using = False
            self.resync()
            raise BadReply("a status packet that is too short") from error
        except _GONE as error:
            raise Gone(f"the serial port is gone: {error}") from error

    def _check(self, what: str, result: int) -> None:
        if result == COMM_SUCCESS:
            return
        dropped = self.resync()
        if result == COMM_RX_TIMEOUT and not dropped:
            raise NoReply(f"{what}: no reply")
        if result in (COMM_RX_CORRUPT, COMM_RX_TIMEOUT):
            raise BadReply(f"{what}: a damaged or late reply")
        raise BusError(f"{what}: {self._handler.getTxRxResult(result)}")
