"""Bus: block reads, writes, ping and reboot of one servo through dynamixel-sdk. Every failure is a BusError.

Behaviour of the SDK (4.1), and the workarounds here:

- It busy-waits. BlockingPort sleeps in select() until bytes arrive.
- It accepts any status packet with the right id as the reply, so a late reply becomes the next one. A reply must have
  the requested length (`Drive.measure` requests a different length each time), and after every failure the line is
  read until it is silent (`Bus.resync`).
- After a failed read or ping it returns 0 as data, even as a model number, and it raises IndexError on short data.
  Only complete packets of the requested length are used.
- A line that never stops sending keeps it in its loop. After the deadline the port returns no more bytes.
- It leaves `is_using` set when the cable is unplugged during an exchange. Each opening creates a new port.
- It reads time from the wall clock, which may step. The port uses the monotonic clock.

Source: dynamixel-sdk 4.1, port_handler.py and protocol2_packet_handler.py; the workarounds are ours.
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

QUIET_S = 0.004  # after this silence no late reply can follow
WRITE_S = 0.1  # timeout of a write to the port
RESYNC_S = 0.05  # limit of `resync`, for a line that never becomes silent
STATUS_OVERHEAD = 4  # in a status packet's length field: instruction, error, CRC
PARAMETERS_AT = 9  # in a status packet
PING_BYTES = 3  # model number, firmware
_GONE = (serial.SerialException, OSError, termios.error, TypeError)  # TypeError: pyserial with a closed file descriptor


class BusError(Exception):
    """A failed exchange. `kind` names its counter."""

    kind = "failed"


class NoReply(BusError):
    """No byte arrived before the deadline."""

    kind = "no reply"


class BadReply(BusError):
    """The reply is not a complete, undamaged status packet."""

    kind = "damaged"


class WrongReply(BusError):
    """A valid status packet to another request: a late reply."""

    kind = "late or foreign"


class Gone(BusError):
    """The serial port has disappeared, or cannot be opened."""

    kind = "unplugged"


class RequestRejected(BusError):
    """The servo replied with an error number."""

    kind = "rejected by the servo"

    def __init__(self, what: str, number: int) -> None:
        super().__init__(f"{what}: {mx28.ERRORS.get(number, f'error {number}')}")
        self.number = number


@dataclass(frozen=True, slots=True)
class BusReply:
    """One valid reply."""

    data: bytes
    alert: bool  # the servo has a hardware error
    request_ns: int  # before the request was sent, monotonic
    reply_ns: int  # when the reply was complete


class BlockingPort(PortHandler):
    """The SDK's port with blocking reads on the monotonic clock that never exceed the deadline."""

    def __init__(self, name: str, baud: int, reply_timeout_s: float) -> None:
        super().__init__(name)
        self.baudrate = baud
        self.low_latency = False
        self._reply_timeout_ms = 1e3 * reply_timeout_s

    def setupPort(self, cflag_baud: int) -> bool:
        """Open the port exclusively."""
        self.ser = serial.Serial(self.port_name, self.baudrate, timeout=0, write_timeout=WRITE_S, exclusive=True)
        self.is_open = True
        self.ser.reset_input_buffer()
        self.tx_time_per_byte = 10e3 / self.baudrate
        with contextlib.suppress(
            ValueError, OSError, NotImplementedError
        ):  # else FTDI waits 16 ms for more bytes; a pty has no such mode
            self.ser.set_low_latency_mode(True)
            self.low_latency = True
        return True

    def readPort(self, length: int) -> bytes:
        """Up to `length` bytes; blocks until the first one, at most until the packet's deadline."""
        left_s = 1e-3 * (self.packet_timeout - self.getTimeSinceStart())
        if length <= 0 or left_s <= 0:
            return b""
        ready, _, _ = select.select([self.ser.fileno()], [], [], left_s)
        return self.ser.read(length) if ready else b""

    def setPacketTimeout(self, packet_length: int) -> None:
        """Set the deadline of a reply of `packet_length` bytes, from now."""
        self.setPacketTimeoutMillis(self.tx_time_per_byte * packet_length + self._reply_timeout_ms)

    def getCurrentTime(self) -> float:
        """Monotonic time [ms]."""
        return 1e-6 * time.monotonic_ns()

    def drain(self, quiet_s: float, limit_s: float) -> int:
        """Discard bytes until the line is silent for quiet_s, for at most limit_s; returns the number of bytes."""
        dropped, deadline_s = 0, time.monotonic() + limit_s
        while time.monotonic() < deadline_s and select.select([self.ser.fileno()], [], [], quiet_s)[0]:
            dropped += len(self.ser.read(4096))
        return dropped


class Bus:
    """Requests to one servo over an open port. Every failure is a BusError."""

    def __init__(self, port: BlockingPort, servo_id: int) -> None:
        self._id, self._port = servo_id, port
        self._handler: Any = Protocol2PacketHandler()

    @classmethod
    def open(cls, port: str, baud: int, servo_id: int, reply_timeout_s: float) -> Bus:
        """Open a serial port. Raises Gone when it cannot be opened."""
        line = BlockingPort(port, baud, reply_timeout_s)
        try:
            opened = line.openPort()
        except (*_GONE, ValueError) as error:
            raise Gone(f"cannot open {port}: {error}") from error
        if not opened:
            raise Gone(f"cannot open {port} at {baud} baud: the SDK knows no such rate")
        bus = cls(line, servo_id)
        bus.resync()  # the previous user of the port may have left a reply unread
        return bus

    @property
    def low_latency(self) -> bool:
        """Whether the serial driver is in low latency mode (it delivers bytes immediately)."""
        return self._port.low_latency

    def close(self) -> None:
        """Close the port; no error when it is gone."""
        with contextlib.suppress(*_GONE):
            self._port.closePort()

    def read(self, address: int, length: int) -> BusReply:
        """Read a block of the control table."""
        parameters = address.to_bytes(2, "little") + length.to_bytes(2, "little")
        return self._exchange(f"read {address}..{address + length - 1}", INST_READ, parameters, length)

    def write(self, register: mx28.Register, *values: int) -> None:
        """Write values to this register and to the adjacent ones that follow it, all of the same size."""
        data = b"".join(register.bytes(value) for value in values)
        what = f"write {', '.join(map(str, values))} to {register.name} ({register.address})"
        self._exchange(what, INST_WRITE, register.address.to_bytes(2, "little") + data, 0)

    def write_unanswered(self, register: mx28.Register, value: int) -> None:
        """Write to a servo that may be configured not to reply."""
        self._call(self._handler.writeTxOnly, self._id, register.address, register.size, list(register.bytes(value)))
        self.resync()

    def ping(self) -> int:
        """Model number of the servo with the id."""
        data = self._exchange("ping", INST_PING, b"", PING_BYTES).data
        return int.from_bytes(data[:2], "little")

    def reboot(self) -> None:
        """Reboot the servo, the only exit from a shutdown. It does not reply for some time after."""
        self._exchange("reboot", INST_REBOOT, b"", 0)

    def resync(self) -> int:
        """Wait until the line is silent; returns the number of discarded bytes of late or damaged replies."""
        try:
            return self._port.drain(QUIET_S, RESYNC_S)
        except _GONE as error:
            raise Gone(f"the serial port is gone: {error}") from error

    def _exchange(self, what: str, instruction: int, parameters: bytes, reply_bytes: int) -> BusReply:
        packet = [0] * (10 + len(parameters))  # header, id, length, instruction, parameters, CRC; the SDK completes it
        packet[4:8] = self._id, len(parameters) + 3, 0, instruction
        packet[8 : 8 + len(parameters)] = parameters
        request_ns = time.monotonic_ns()
        reply, result, error = self._call(self._handler.txRxPacket, packet)
        reply_ns = time.monotonic_ns()
        self._check(what, result)
        length = reply[5] | reply[6] << 8
        if error & ~mx28.ALERT:
            raise RequestRejected(what, error & ~mx28.ALERT)
        if length != reply_bytes + STATUS_OVERHEAD or len(reply) < PARAMETERS_AT + reply_bytes:
            self.resync()
            raise WrongReply(f"{what}: a reply of {length - STATUS_OVERHEAD} bytes, not {reply_bytes}")
        data = bytes(reply[PARAMETERS_AT : PARAMETERS_AT + reply_bytes])
        return BusReply(data, bool(error & mx28.ALERT), request_ns, reply_ns)

    def _call(self, method: Any, *arguments: Any) -> Any:
        try:
            return method(self._port, *arguments)
        except IndexError as error:  # a packet that is too short for its instruction
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
