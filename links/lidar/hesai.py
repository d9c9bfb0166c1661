"""Packets of the Hesai XT16 and XT32: 8 blocks of 16 or 32 entries, little endian.

The time in the packet is that of its end: block n of 8 begins 50 us * (8 - n) before it, less 5.632 us; channel i
fires 0.368 us + 1.512 us * i after that (every second channel of the XT32 is one of the XT16). All channels of a block
have its azimuth: the factory's azimuth offsets include the rotation between their firings.

Source: Hesai PandarXT and PandarXT-16 user manuals, section 3.1 (packet) and appendix II (absolute time).
"""

from __future__ import annotations

from links.lidar.packet_format import MODE_NAMES, MODES, PacketFormat, block_layout
from links.lidar.reject_reason import PacketRejectReason
from stages.geometry.lidar_models import LidarProfile
from stages.geometry.rig_lidar import LidarBeams

DATA_PORT = 2368
HEADER_BYTES, TAIL_BYTES, SEQUENCE_BYTES = 12, 24, 4  # the UDP sequence number can be switched off
START = b"\xee\xff\x06\x01"  # start of packet, protocol version 6.1
LASERS_AT, BLOCKS_AT, UNIT_AT = 6, 7, 9
BLOCKS, ENTRY_BYTES = 8, 4  # range u16, reflectivity u8, reserved
RETURN_MODE_IN_TAIL, DATE_IN_TAIL, MICROSECONDS_IN_TAIL = 10, 13, 19  # date: year, month, day, hour, minute, second
END_NS, FIRST_NS = 5_632, 368


class HesaiFormat(PacketFormat):
    """Data packets of one XT model."""

    factory_port = DATA_PORT

    def __init__(self, profile: LidarProfile, beams: LidarBeams | None) -> None:
        layout = block_layout(
            BLOCKS, HEADER_BYTES, 0, ENTRY_BYTES, profile.lasers, profile.sequence_ns, profile.spin_hz[1]
        )
        super().__init__(profile, beams, 1, layout)
        self._tail_at = HEADER_BYTES + BLOCKS * (2 + ENTRY_BYTES * profile.lasers)
        self.packet_bytes = self._tail_at + TAIL_BYTES + SEQUENCE_BYTES

    def is_data(self, data: bytes) -> bool:
        """See PacketFormat."""
        return len(data) in (self.packet_bytes, self.packet_bytes - SEQUENCE_BYTES)

    def reject_reason(self, data: bytes) -> PacketRejectReason | None:
        """See PacketFormat."""
        if not data.startswith(START):
            return PacketRejectReason.FLAG if self.is_data(data) else PacketRejectReason.LENGTH
        if data[LASERS_AT : BLOCKS_AT + 1] != bytes([self.profile.lasers, BLOCKS]):
            return PacketRejectReason.MODEL
        if not self.is_data(data):
            return PacketRejectReason.LENGTH
        if data[UNIT_AT] != self.profile.range_unit_mm:
            return PacketRejectReason.MODEL
        return None if data[self._tail_at + RETURN_MODE_IN_TAIL] in MODES else PacketRejectReason.RETURN_MODE

    def timestamp_us(self, data: bytes) -> int:
        """See PacketFormat."""
        at = self._tail_at + DATE_IN_TAIL + 4
        seconds = 60 * data[at] + data[at + 1]
        at = self._tail_at + MICROSECONDS_IN_TAIL
        end_us = 1_000_000 * seconds + int.from_bytes(data[at : at + 4], "little")
        before_us = (self.duration_ns(data) - self.profile.sequence_ns - END_NS - FIRST_NS) // 1_000
        return (end_us - before_us) % 3_600_000_000

    def duration_ns(self, data: bytes) -> int:
        """See PacketFormat."""
        return self.packet_ns(self.return_mode(data))

    def packet_ns(self, mode: str) -> int:
        """Duration of a packet's pulses [ns]: 8 blocks, or 4 when each is sent twice (dual return)."""
        return self.profile.sequence_ns * (BLOCKS // 2 if mode == "dual" else BLOCKS)

    def return_mode(self, data: bytes) -> str:
        """See PacketFormat."""
        mode = data[self._tail_at + RETURN_MODE_IN_TAIL] if len(data) > self._tail_at + RETURN_MODE_IN_TAIL else 0
        return MODE_NAMES[mode]

    def other_model(self, data: bytes) -> str | None:
        """See PacketFormat."""
        if not data.startswith(START[:2]) or len(data) <= UNIT_AT:
            return None
        version = f"{data[2]}.{data[3]}"
        return f"Hesai with {data[LASERS_AT]} lasers (protocol {version}, unit {data[UNIT_AT]} mm)"
