"""Writes VLP-16 position packets of a sensor whose clock a GPS keeps: the 512-byte UDP payload.

Source: VLP-16 User Manual 63-9243 Rev. E, section 9.3.3, tables 9-3 and 9-4 (offsets into the payload are the manual's
less 42); NMEA 0183 for GPRMC and its checksum.
"""

from __future__ import annotations

import datetime

from links.velodyne import vlp16

TIMESTAMP_AT, PPS_AT, NMEA_AT = 198, 202, 206
LOCKED = 2


def encode_position(at_ns: int) -> bytes:
    """What the sensor sends at a UTC [ns since 1970]: its microsecond past the hour, PPS locked, the second's GPRMC."""
    second = datetime.datetime.fromtimestamp(at_ns // 1_000_000_000, datetime.UTC)
    body = f"GPRMC,{second:%H%M%S},A,3542.1234,N,13946.1234,E,000.0,000.0,{second:%d%m%y},,,A"
    parity = 0
    for character in body:
        parity ^= ord(character)
    packet = bytearray(vlp16.POSITION_BYTES)
    packet[TIMESTAMP_AT : TIMESTAMP_AT + 4] = (at_ns // 1000 % vlp16.HOUR_US).to_bytes(4, "little")
    packet[PPS_AT] = LOCKED
    sentence = f"${body}*{parity:02X}\r\n".encode("ascii")
    packet[NMEA_AT : NMEA_AT + len(sentence)] = sentence
    return bytes(packet)
