"""Packets of the Velodyne Puck family and the HDL-32E: 12 blocks of 32 entries, little endian.

Source: VLP-16 User Manual 63-9243 Rev. E, chapter 9 (tables 9-1 to 9-4, figures 9-2 to 9-9); VLP-32C User Manual
63-9325 Rev. B, chapter 9; HDL-32E User's Manual, appendix B. The URLs are in `stages/geometry/lidar_models.py`.
"""

from __future__ import annotations

from links.lidar.packet_format import DUAL, LAST, MODE_NAMES, STRONGEST, PacketFormat, block_layout
from links.lidar.reject_reason import HOUR_US, PacketRejectReason
from stages.geometry.lidar_models import LidarProfile

# Section 9.3.2: data packet (UDP payload).
DATA_PORT = 2368
PACKET_BYTES = 1206
BLOCKS, BLOCK_PULSES, BLOCK_BYTES = 12, 32, 100
CHANNEL_BYTES = 3  # range u16, reflectivity u8
BLOCK_FLAG = b"\xff\xee"  # 0xEEFF
LOWER_BLOCK_FLAG = b"\xff\xdd"  # 0xDDFF: sensors with more than 32 lasers only
TIMESTAMP_AT = 1200  # u32: microseconds since the top of the hour, when the packet's first laser fired
RETURN_MODE_AT = 1204
PRODUCT_ID_AT = 1205
PRODUCTS = {
    0x21: "HDL-32E",
    0x22: "VLP-16",  # and Puck LITE
    0x23: "VLP-32A or VLP-32B",
    0x24: "Puck Hi-Res",
    0x28: "VLP-32C",
    0x31: "Velarray",
    0x63: "VLS-128",
    0xA1: "VLS-128 (Alpha Prime)",
}
"""Table 9-2: factory bytes."""

# Section 9.3.3: position packet (UDP payload).
POSITION_PORT = 8308
POSITION_BYTES = 512

_FLAG_LOW, _FLAG_HIGH = (BLOCK_FLAG[k : k + 1] * BLOCKS for k in (0, 1))


class VelodyneFormat(PacketFormat):
    """Data packets of one Velodyne model."""

    packet_bytes = PACKET_BYTES
    factory_port = DATA_PORT

    def __init__(self, profile: LidarProfile) -> None:
        self.sequences_per_block = BLOCK_PULSES // profile.lasers
        block_ns = self.sequences_per_block * profile.sequence_ns
        layout = block_layout(BLOCKS, 0, 2, CHANNEL_BYTES, BLOCK_PULSES, block_ns, profile.spin_hz[1])
        super().__init__(profile, None, self.sequences_per_block, layout)
        self._block_ns = block_ns

    def reject_reason(self, data: bytes) -> PacketRejectReason | None:
        """See PacketFormat."""
        if len(data) != PACKET_BYTES:
            return PacketRejectReason.POSITION if len(data) == POSITION_BYTES else PacketRejectReason.LENGTH
        if data[PRODUCT_ID_AT] != self.profile.product_id:
            return PacketRejectReason.MODEL
        if not STRONGEST <= data[RETURN_MODE_AT] <= DUAL:
            return PacketRejectReason.RETURN_MODE
        if data[0:TIMESTAMP_AT:BLOCK_BYTES] != _FLAG_LOW or data[1:TIMESTAMP_AT:BLOCK_BYTES] != _FLAG_HIGH:
            return PacketRejectReason.FLAG
        return PacketRejectReason.TIMESTAMP if self.timestamp_us(data) >= HOUR_US else None

    def timestamp_us(self, data: bytes) -> int:
        """See PacketFormat."""
        return int.from_bytes(data[TIMESTAMP_AT : TIMESTAMP_AT + 4], "little")

    def packet_ns(self, mode: str) -> int:
        """Duration of a packet's pulses [ns]: 12 blocks, or 6 when each is sent twice (dual return)."""
        return self._block_ns * (BLOCKS // 2 if mode == "dual" else BLOCKS)

    def duration_ns(self, data: bytes) -> int:
        """See PacketFormat."""
        return self._block_ns * (BLOCKS // 2 if data[RETURN_MODE_AT] == DUAL else BLOCKS)

    def return_mode(self, data: bytes) -> str:
        """See PacketFormat."""
        return MODE_NAMES[data[RETURN_MODE_AT]]

    def other_model(self, data: bytes) -> str | None:
        """See PacketFormat."""
        if len(data) != PACKET_BYTES:
            return None
        flags = {data[at : at + 2] for at in range(0, BLOCKS * BLOCK_BYTES, BLOCK_BYTES)}
        product_id = data[PRODUCT_ID_AT]
        if BLOCK_FLAG not in flags or product_id == self.profile.product_id:
            return None
        if product_id in PRODUCTS:
            return f"Velodyne {PRODUCTS[product_id]} (product id 0x{product_id:02X})"
        return "Velodyne HDL-64E" if flags == {BLOCK_FLAG, LOWER_BLOCK_FLAG} else None


__all__ = ["BLOCKS", "BLOCK_FLAG", "DUAL", "LAST", "STRONGEST", "VelodyneFormat"]
