"""DYNAMIXEL Protocol 2.0 on the servo's side: instructions from a byte stream, status packets to bytes.

Written from the specification and not from the code of the SDK, so that tests against the SDK are independent.

Source: ROBOTIS e-manual, Protocol 2.0, https://emanual.robotis.com/docs/en/dxl/protocol2/ (packet, byte stuffing);
https://emanual.robotis.com/docs/en/dxl/crc/ (CRC-16, polynomial 0x8005, initial 0, not reflected).
"""

from __future__ import annotations

from typing import NamedTuple

HEADER = b"\xff\xff\xfd\x00"
PING, READ, WRITE, REBOOT, STATUS = 0x01, 0x02, 0x03, 0x08, 0x55
BROADCAST = 0xFE
LENGTH_AT, INSTRUCTION_AT = 5, 7
MOST_BYTES = 1024  # of a packet after its length field


class Instruction(NamedTuple):
    """One valid packet from the host."""

    servo_id: int
    code: int
    parameters: bytes


def _crc_of_byte(byte: int) -> int:
    crc = byte << 8
    for _ in range(8):
        crc = (crc << 1) ^ (0x8005 if crc & 0x8000 else 0)
    return crc & 0xFFFF


_CRC = tuple(_crc_of_byte(byte) for byte in range(256))


def crc16(data: bytes) -> int:
    """Checksum of a packet, from its header on."""
    crc = 0
    for byte in data:
        crc = ((crc << 8) & 0xFF00) ^ _CRC[(crc >> 8) ^ byte]
    return crc


def packet(servo_id: int, code: int, body: bytes) -> bytes:
    """A complete packet: header, id, length, code, body with byte stuffing, CRC."""
    stuffed = (bytes([code]) + body).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    data = HEADER + bytes([servo_id]) + (len(stuffed) + 2).to_bytes(2, "little") + stuffed
    return data + crc16(data).to_bytes(2, "little")


def status(servo_id: int, error: int, parameters: bytes = b"") -> bytes:
    """A status packet: the servo's reply."""
    return packet(servo_id, STATUS, bytes([error]) + parameters)


def take(stream: bytearray) -> Instruction | None:
    """Remove and return the next valid packet of a stream; None when more bytes are needed."""
    while True:
        start = stream.find(HEADER)
        del stream[: start if start >= 0 else max(len(stream) - len(HEADER) + 1, 0)]
        if len(stream) < INSTRUCTION_AT:
            return None
        length = int.from_bytes(stream[LENGTH_AT:INSTRUCTION_AT], "little")
        if not 3 <= length <= MOST_BYTES:
            del stream[: len(HEADER)]
            continue
        end = INSTRUCTION_AT + length
        if len(stream) < end:
            return None
        whole = bytes(stream[:end])
        if crc16(whole[:-2]) != int.from_bytes(whole[-2:], "little"):
            del stream[: len(HEADER)]  # the damaged packet may contain the next one
            continue
        del stream[:end]
        body = whole[INSTRUCTION_AT:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
        return Instruction(whole[4], body[0], body[1:])
