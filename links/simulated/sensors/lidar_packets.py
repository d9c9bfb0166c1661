"""Encodes packets as the sensors send them: data packets of each LiDAR model, position packets of a Velodyne.

The sensor's clock is locked to GPS.

Source: the manuals in `stages/geometry/lidar_models.py` and in the formats of links/lidar; position packets: VLP-16
User Manual 63-9243 Rev. E, section 9.3.3, tables 9-3 and 9-4 (offsets into the payload are the manual's minus 42);
NMEA 0183 for GPRMC and its checksum. Written from the manuals, independently of the decoder under test.
"""

from __future__ import annotations

import datetime

import numpy as np
from numpy.typing import NDArray

from links.lidar.velodyne import POSITION_BYTES
from stages.geometry.lidar_models import lidar_profile
from stages.geometry.rig_lidar import RigLidar

TIMESTAMP_AT, PPS_AT, NMEA_AT = 198, 202, 206  # offsets into the payload of a position packet
LOCKED = 2  # PPS status
RETURN_MODE_BYTE = {"strongest": 0x37, "last": 0x38, "dual": 0x39}
HOUR_US = 3_600_000_000
OUSTER_MASKS = {"RNG15_RFL8_NIR8": (0x7FFF, 8)}  # range mask, unit [mm]; of the others 20 or 19 bits and 1 mm

_CHANNEL = [("range", "<u2"), ("reflectivity", "u1")]
_BLOCK = [("flag", "<u2"), ("azimuth", "<u2"), ("channels", _CHANNEL, 32)]
_VELODYNE = np.dtype([("blocks", _BLOCK, 12), ("timestamp_us", "<u4"), ("mode", "u1"), ("product", "u1")])
_XT_CHANNEL = [*_CHANNEL, ("reserved", "u1")]
_ENTRY = {
    "LEGACY": [("range", "<u4"), ("reflectivity", "u1"), ("x", "u1"), ("signal", "<u2"), ("nir", "<u2"), ("y", "<u2")],
    "RNG19_RFL8_SIG16_NIR16": [
        *(("range", "<u4"), ("reflectivity", "u1"), ("x", "u1"), ("signal", "<u2"), ("nir", "<u2"), ("y", "<u2"))
    ],
    "RNG15_RFL8_NIR8": [("range", "<u2"), ("reflectivity", "u1"), ("nir", "u1")],
    "RNG19_RFL8_SIG16_NIR16_DUAL": [
        *(("range", "<u4"), ("range2", "<u4"), ("signal", "<u2"), ("signal2", "<u2"), ("nir", "<u2"), ("x", "<u2"))
    ],
}
_TAIL = [("reserved", "u1", 10), ("mode", "u1"), ("speed", "<u2"), ("date", "u1", 6), ("us", "<u4"), ("factory", "u1")]


class PacketEncoder:
    """Packets of one LiDAR. Their firing sequences are `sequence_ns` apart and start together with a packet.

    `encode` takes the time of the first pulse [ns], rotor angles (sequences,), and ranges [m] and reflectivities
    (returns, sequences, lasers); range 0 m is no return. Dual mode has returns = 2: strongest (or second strongest),
    then last.
    """

    def __init__(self, unit: RigLidar, mode: str) -> None:
        self.unit, self.mode = unit, mode
        self.profile = profile = lidar_profile(unit.model)
        self.returns = 2 if mode == "dual" else 1
        self.sequence_ns = float(profile.sequence_ns)
        if unit.beams is not None and unit.model.startswith("OS"):
            self.sequences = unit.beams.columns_per_packet
            self.sequence_ns = 1e9 / (unit.beams.columns * unit.beams.spin_hz)
            self.encode = self._ouster
            if mode != unit.beams.return_mode:
                raise ValueError(f"packets {unit.beams.packets} do not hold return mode {mode}")
        elif unit.model.startswith("XT"):
            self.sequences = 8 // self.returns
            self.encode = self._hesai
        else:
            self.sequences = 12 * 32 // profile.lasers // self.returns
            self.encode = self._velodyne
        self.packet_ns = round(self.sequences * self.sequence_ns)

    def sequence_offsets_ns(self, packets: int) -> NDArray[np.int64]:
        """Starts (packets * sequences,) of the firing sequences after the first packet's."""
        within = np.rint(self.sequence_ns * np.arange(self.sequences)).astype(np.int64)
        return (self.packet_ns * np.arange(packets)[:, None] + within).ravel()

    def _counts(self, range_m: NDArray[np.float64], unit_mm: int) -> NDArray[np.int64]:
        shape = (self.returns, self.sequences, self.profile.lasers)
        if range_m.shape != shape:
            raise ValueError(f"{self.mode} packets take ranges {shape}, got {range_m.shape}")
        return np.rint(1000 * range_m / unit_mm).astype(np.int64)

    def _fill_blocks(
        self,
        blocks: NDArray[np.void],
        azimuth_rad: NDArray[np.float64],
        counts: NDArray[np.int64],
        reflectivity: NDArray[np.uint8],
    ) -> None:
        """Azimuths and entries of blocks; in dual mode the last return is in blocks 0, 2, ..."""
        channels = blocks["channels"]
        for kind in range(self.returns):
            rows = slice(self.returns - 1 - kind, None, self.returns)
            shape = channels["range"][rows].shape
            blocks["azimuth"][rows] = _hundredths(azimuth_rad)
            channels["range"][rows] = counts[kind].reshape(shape)
            channels["reflectivity"][rows] = np.where(counts > 0, reflectivity, 0)[kind].reshape(shape)

    def _velodyne(
        self,
        first_pulse_ns: int,
        azimuth_rad: NDArray[np.float64],
        range_m: NDArray[np.float64],
        reflectivity: NDArray[np.uint8],
    ) -> bytes:
        """Manual, section 9.3. The packet holds its microsecond past the hour, rounded down."""
        counts = self._counts(range_m, self.profile.range_unit_mm)
        packet = np.zeros((), dtype=_VELODYNE)
        packet["blocks"]["flag"] = 0xEEFF
        self._fill_blocks(packet["blocks"], azimuth_rad[:: 32 // self.profile.lasers], counts, reflectivity)
        packet["timestamp_us"] = first_pulse_ns // 1000 % HOUR_US
        packet["mode"] = RETURN_MODE_BYTE[self.mode]
        packet["product"] = self.profile.product_id
        return packet.tobytes()

    def _hesai(
        self,
        first_pulse_ns: int,
        azimuth_rad: NDArray[np.float64],
        range_m: NDArray[np.float64],
        reflectivity: NDArray[np.uint8],
    ) -> bytes:
        """Manual, section 3.1. The packet holds its date and the time of its end."""
        lasers = self.profile.lasers
        counts = self._counts(range_m, self.profile.range_unit_mm)
        blocks = np.zeros(8, dtype=[("azimuth", "<u2"), ("channels", _XT_CHANNEL, lasers)])
        self._fill_blocks(blocks, azimuth_rad, counts, reflectivity)
        end_ns = first_pulse_ns + 50_000 * (self.sequences - 1) - 5_632 - 368
        at = datetime.datetime.fromtimestamp(end_ns // 1_000_000_000, datetime.UTC)
        tail = np.zeros((), dtype=_TAIL)
        tail["mode"], tail["speed"], tail["factory"] = RETURN_MODE_BYTE[self.mode], 600, 0x42
        tail["date"] = (at.year - 1900, at.month, at.day, at.hour, at.minute, at.second)
        tail["us"] = end_ns // 1000 % 1_000_000
        header = bytes([0xEE, 0xFF, 6, 1, 0, 0, lasers, 8, 1, self.profile.range_unit_mm, self.returns, 1])
        return header + blocks.tobytes() + tail.tobytes() + (end_ns // 400_000 % (1 << 32)).to_bytes(4, "little")

    def _ouster(
        self,
        first_pulse_ns: int,
        azimuth_rad: NDArray[np.float64],
        range_m: NDArray[np.float64],
        reflectivity: NDArray[np.uint8],
    ) -> bytes:
        """Firmware manual, lidar data. Column 0 is at azimuth 90 deg of the lidar frame."""
        beams = self.unit.beams
        assert beams is not None
        mask, unit_mm = OUSTER_MASKS.get(beams.packets, (0x7FFFF, 1))
        counts = np.minimum(self._counts(range_m, unit_mm), mask)
        entries = np.zeros((self.sequences, self.profile.lasers), dtype=_ENTRY[beams.packets])
        shade = np.where(counts > 0, reflectivity, 0)
        if self.returns == 2:
            only_one = counts[1] == counts[0]
            entries["range"] = counts[0] | shade[0].astype(np.int64) << 24
            entries["range2"] = np.where(only_one, 0, counts[1] | shade[1].astype(np.int64) << 24)
        else:
            entries["range"], entries["reflectivity"] = counts[0], shade[0]
        columns = np.rint((azimuth_rad - np.pi / 2) / (2 * np.pi) * beams.columns).astype(np.int64) % beams.columns
        stamps = first_pulse_ns + np.rint(self.sequence_ns * np.arange(self.sequences)).astype(np.int64)
        frame = round(first_pulse_ns * 1e-9 * beams.spin_hz) % 65_536
        body = b""
        for column in range(self.sequences):
            head = int(stamps[column]).to_bytes(8, "little") + int(columns[column]).to_bytes(2, "little")
            if beams.packets == "LEGACY":
                encoder = int(columns[column]) * 90_112 // beams.columns
                head += frame.to_bytes(2, "little") + encoder.to_bytes(4, "little")
                body += head + entries[column].tobytes() + b"\xff\xff\xff\xff"
            else:
                body += head + b"\x01\x00" + entries[column].tobytes()
        if beams.packets == "LEGACY":
            return body
        head = (
            (1).to_bytes(2, "little")
            + frame.to_bytes(2, "little")
            + bytes(3)
            + (beams.serial or 0).to_bytes(5, "little")
        )
        return head.ljust(32, b"\0") + body + bytes(32)


def _hundredths(azimuth_rad: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.rint(np.degrees(azimuth_rad) * 100).astype(np.int64) % 36_000


def encode_position(at_ns: int) -> bytes:
    """The position packet of a UTC [ns since 1970]: microsecond past the hour, PPS locked, GPRMC of the second."""
    second = datetime.datetime.fromtimestamp(at_ns // 1_000_000_000, datetime.UTC)
    body = f"GPRMC,{second:%H%M%S},A,3542.1234,N,13946.1234,E,000.0,000.0,{second:%d%m%y},,,A"
    parity = 0
    for character in body:
        parity ^= ord(character)
    packet = bytearray(POSITION_BYTES)
    packet[TIMESTAMP_AT : TIMESTAMP_AT + 4] = (at_ns // 1000 % HOUR_US).to_bytes(4, "little")
    packet[PPS_AT] = LOCKED
    sentence = f"${body}*{parity:02X}\r\n".encode("ascii")
    packet[NMEA_AT : NMEA_AT + len(sentence)] = sentence
    return bytes(packet)
