"""Packets of the Ouster OS0 and OS1: columns of 32 to 128 entries, little endian, legacy and the profiles after it.

The frame is Ouster's lidar frame: x against the cable, where column 0 points. A column has its own time; all its lasers
fire at once, 16 or 28 mm from the axis.

Source: Ouster firmware user manual, lidar data (https://ouster.com/sensor-docs/fw-user-manual/docs/sensor-data/lidar-data)
and lidar data legacy; "Lidar Range to XYZ" for beams and origins.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from links.lidar.packet_format import PacketFormat
from links.lidar.reject_reason import HOUR_US, PacketRejectReason
from stages.geometry.lidar_models import LidarProfile
from stages.geometry.rig_lidar import LidarBeams
from stages.kernels.lidar import packets as columns

DATA_PORT = 7502
TIME_IN_COLUMN, COLUMN_IN_COLUMN, STATUS_IN_COLUMN = 0, 8, 10
SERIAL_AT = 7  # of the packet: 5 bytes; the legacy packet has no header


class Entries(NamedTuple):
    """Entries of one `udp_profile_lidar`."""

    packet_head_bytes: int  # before the first column, and as many after the last one
    column_head_bytes: int
    status_in_column: int | None  # None: in the 4 bytes after the entries
    entry_bytes: int
    range_bytes: int
    range_mask: int
    range_unit_mm: int
    reflectivity_after_range: int
    second_range: int | None = None  # position of the second return's range; its reflectivity follows likewise


ENTRIES = {
    "LEGACY": Entries(0, 16, None, 12, 4, 0xFFFFF, 1, 4),
    "RNG19_RFL8_SIG16_NIR16": Entries(32, 12, STATUS_IN_COLUMN, 12, 4, 0x7FFFF, 1, 4),
    "RNG15_RFL8_NIR8": Entries(32, 12, STATUS_IN_COLUMN, 4, 2, 0x7FFF, 8, 2),
    "RNG19_RFL8_SIG16_NIR16_DUAL": Entries(32, 12, STATUS_IN_COLUMN, 16, 4, 0x7FFFF, 1, 3, 4),
}


class OusterFormat(PacketFormat):
    """Data packets of one Ouster unit."""

    factory_port = DATA_PORT
    bit_ns = 1.0

    def __init__(self, profile: LidarProfile, beams: LidarBeams) -> None:
        self.beams = beams
        self.entries = entries = ENTRIES[beams.packets]
        self.column_ns = 1e9 / (beams.columns * beams.spin_hz)
        status = entries.status_in_column
        tail_bytes = 4 if status is None else 0
        layout = np.full(columns.LAYOUT, -1, dtype=np.int64)
        layout[columns.BLOCKS] = beams.columns_per_packet
        layout[columns.FIRST_BLOCK_AT] = entries.packet_head_bytes
        entries_bytes = entries.entry_bytes * profile.lasers
        layout[columns.BLOCK_BYTES] = entries.column_head_bytes + entries_bytes + tail_bytes
        layout[columns.AZIMUTH_IN_BLOCK] = COLUMN_IN_COLUMN
        layout[columns.AZIMUTH_TURN] = beams.columns
        layout[columns.MAX_STEP] = beams.columns  # columns outside the azimuth window are left out
        layout[columns.BLOCK_NS] = round(self.column_ns)
        layout[columns.TIME_IN_BLOCK] = TIME_IN_COLUMN
        layout[columns.STATUS_IN_BLOCK] = entries.column_head_bytes + entries_bytes if status is None else status
        layout[columns.FIRST_ENTRY_IN_BLOCK] = entries.column_head_bytes
        layout[columns.ENTRY_BYTES] = entries.entry_bytes
        layout[columns.RANGE_BYTES] = entries.range_bytes
        layout[columns.RANGE_MASK] = entries.range_mask
        layout[columns.REFLECTIVITY_AFTER_RANGE] = entries.reflectivity_after_range
        if entries.second_range is not None:
            layout[columns.SECOND_RANGE_IN_ENTRY] = entries.second_range
        super().__init__(profile, beams, 1, layout)
        self.scales = np.array([1e-3 * entries.range_unit_mm, 1e-3 * beams.origin_mm, math.pi / 2])
        self.packet_bytes = 2 * entries.packet_head_bytes + beams.columns_per_packet * int(layout[columns.BLOCK_BYTES])

    def reject_reason(self, data: bytes) -> PacketRejectReason | None:
        """See PacketFormat."""
        if len(data) != self.packet_bytes:
            return PacketRejectReason.LENGTH
        if self.entries.packet_head_bytes:
            if data[0] != 1:
                return PacketRejectReason.MODEL
            serial = int.from_bytes(data[SERIAL_AT : SERIAL_AT + 5], "little")
            if self.beams.serial is not None and serial not in (0, self.beams.serial):
                return PacketRejectReason.UNIT
        return PacketRejectReason.EMPTY if self._first_column_at(data) is None else None

    def _first_column_at(self, data: bytes) -> int | None:
        """Position of the first valid column."""
        bytes_, status_at = int(self.layout[columns.BLOCK_BYTES]), int(self.layout[columns.STATUS_IN_BLOCK])
        first = self.entries.packet_head_bytes
        last = first + bytes_ * self.beams.columns_per_packet
        return next((at for at in range(first, last, bytes_) if data[at + status_at] & 1), None)

    def timestamp_us(self, data: bytes) -> int:
        """See PacketFormat."""
        at = self._first_column_at(data)
        assert at is not None
        return int.from_bytes(data[at : at + 8], "little") // 1_000 % HOUR_US

    def first_pulse_ns(self, arrival_ns: int, data: bytes) -> int:
        """See PacketFormat: of the first valid column, as `timestamp_us`. Those before it lie outside the window."""
        start_ns = super().first_pulse_ns(arrival_ns, data)
        if not self.is_data(data):
            return start_ns
        at = self._first_column_at(data)
        assert at is not None
        column = (at - self.entries.packet_head_bytes) // int(self.layout[columns.BLOCK_BYTES])
        return start_ns + round(column * self.column_ns)

    def duration_ns(self, data: bytes) -> int:
        """See PacketFormat."""
        del data
        return self.packet_ns("")

    def packet_ns(self, mode: str) -> int:
        """Duration of a packet's columns [ns]."""
        del mode
        return round(self.beams.columns_per_packet * self.column_ns)

    def return_mode(self, data: bytes) -> str:
        """See PacketFormat."""
        del data
        return "strongest" if self.entries.second_range is None else "dual"

    def other_model(self, data: bytes) -> str | None:
        """See PacketFormat."""
        if len(data) == self.packet_bytes:
            serial = int.from_bytes(data[SERIAL_AT : SERIAL_AT + 5], "little")
            return f"Ouster with serial number {serial}, while the rig's beams are those of {self.beams.serial}"
        return None
