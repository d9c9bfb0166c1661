"""Encodes VLP-16 packets as the sensor sends them: data packets of 1206 bytes, position packets of 512.

The sensor's clock is locked to GPS.

Source: VLP-16 User Manual 63-9243 Rev. E, section 9.3 (packet structure, return modes, factory bytes) and 9.3.3, tables
9-3 and 9-4 (position packets; offsets into the payload are the manual's minus 42); table in links/velodyne/vlp16.py;
NMEA 0183 for GPRMC and its checksum. Written from the manual, independently of the decoder under test.
"""

from __future__ import annotations

import datetime

import numpy as np
from numpy.typing import NDArray

from links.velodyne import vlp16

FIRINGS_PER_BLOCK = 2
TIMESTAMP_AT, PPS_AT, NMEA_AT = 198, 202, 206  # offsets into the payload of a position packet
LOCKED = 2  # PPS status
RETURN_MODE_BYTE = {"strongest": vlp16.STRONGEST, "last": vlp16.LAST, "dual": vlp16.DUAL}

_CHANNEL = [("range", "<u2"), ("reflectivity", "u1")]
_BLOCK = [("flag", "S2"), ("azimuth", "<u2"), ("channels", _CHANNEL, (FIRINGS_PER_BLOCK, vlp16.LASERS))]
_PACKET = np.dtype([("blocks", _BLOCK, vlp16.BLOCKS), ("timestamp_us", "<u4"), ("mode", "u1"), ("product", "u1")])


def firings_per_packet(mode: str) -> int:
    """Firing sequences in one packet: 24, or 12 when each is sent twice (dual)."""
    return vlp16.BLOCKS * FIRINGS_PER_BLOCK // (2 if mode == "dual" else 1)


def encode_packet(
    first_pulse_ns: int,
    azimuth_rad: NDArray[np.float64],
    range_m: NDArray[np.float64],
    reflectivity: NDArray[np.uint8],
    mode: str,
) -> bytes:
    """One data packet from a row of firing sequences.

    first_pulse_ns: UTC of the first pulse; the packet holds its microsecond past the hour, rounded down.
    azimuth_rad (blocks,): rotor angle at the first pulse of each block, 12 blocks, or 6 in dual mode.
    range_m, reflectivity (returns, firings, 16): 0 m is no return. Dual mode has returns = 2: strongest (or second
    strongest), then last; they go into odd and even blocks.
    """
    returns, firings = 2 if mode == "dual" else 1, firings_per_packet(mode)
    if range_m.shape != (returns, firings, vlp16.LASERS):
        raise ValueError(f"{mode} packets take ranges {(returns, firings, vlp16.LASERS)}, got {range_m.shape}")
    packet = np.zeros((), dtype=_PACKET)
    blocks = packet["blocks"]
    blocks["flag"] = vlp16.BLOCK_FLAG
    hundredths = np.rint(np.degrees(azimuth_rad) * 100).astype(np.int64) % vlp16.AZIMUTH_TURN
    ticks = np.rint(1000 * range_m / vlp16.RANGE_UNIT_MM).astype(np.uint16)
    shades = np.where(ticks > 0, reflectivity, 0)
    by_block = (returns, firings // FIRINGS_PER_BLOCK, FIRINGS_PER_BLOCK, vlp16.LASERS)
    for kind in range(returns):
        rows = slice(returns - 1 - kind, None, returns)  # dual: last in blocks 0, 2, ..; strongest in 1, 3, ..
        blocks["azimuth"][rows] = hundredths
        blocks["channels"]["range"][rows] = ticks.reshape(by_block)[kind]
        blocks["channels"]["reflectivity"][rows] = shades.reshape(by_block)[kind]
    packet["timestamp_us"] = first_pulse_ns // 1000 % vlp16.HOUR_US
    packet["mode"] = RETURN_MODE_BYTE[mode]
    packet["product"] = vlp16.PRODUCT_ID
    return packet.tobytes()


def encode_position(at_ns: int) -> bytes:
    """The position packet of a UTC [ns since 1970]: microsecond past the hour, PPS locked, GPRMC of the second."""
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
