"""Why a LiDAR packet is rejected, and the check of a packet's fixed bytes."""

from __future__ import annotations

import enum

from links.velodyne import vlp16

_FLAG_LOW, _FLAG_HIGH = (vlp16.BLOCK_FLAG[k : k + 1] * vlp16.BLOCKS for k in (0, 1))


class PacketRejectReason(enum.Enum):
    """Reason to ignore a packet; the value is the text in counters and errors."""

    LENGTH = "not 1206 bytes long"
    POSITION = "a position packet (512 bytes, expected on UDP 8308)"
    MODEL = "not the VLP-16's product id"
    RETURN_MODE = "unknown return mode"
    FLAG = "a data block without the flag 0xEEFF"
    AZIMUTH = "azimuths beyond 360 deg or jumping (is the field of view limited in the sensor's settings?)"
    TIMESTAMP = "time of one hour or more after the hour"
    ORDER = "duplicate or out of order"
    CLOCK = "sensor time far from the host's (clock: utc needs both locked to UTC; otherwise set clock: free)"


def timestamp_us(data: bytes) -> int:
    """Microseconds after the hour when the packet's first laser fired."""
    return int.from_bytes(data[vlp16.TIMESTAMP_AT : vlp16.TIMESTAMP_AT + 4], "little")


def reject_reason(data: bytes) -> PacketRejectReason | None:
    """Why a payload is not a VLP-16 data packet, by length, factory bytes, flags and time; None: it is one."""
    if len(data) != vlp16.PACKET_BYTES:
        return PacketRejectReason.POSITION if len(data) == vlp16.POSITION_BYTES else PacketRejectReason.LENGTH
    if data[vlp16.PRODUCT_ID_AT] != vlp16.PRODUCT_ID:
        return PacketRejectReason.MODEL
    if not vlp16.STRONGEST <= data[vlp16.RETURN_MODE_AT] <= vlp16.DUAL:
        return PacketRejectReason.RETURN_MODE
    blocks_end, block_bytes = vlp16.TIMESTAMP_AT, vlp16.BLOCK_BYTES
    if data[0:blocks_end:block_bytes] != _FLAG_LOW or data[1:blocks_end:block_bytes] != _FLAG_HIGH:
        return PacketRejectReason.FLAG
    return PacketRejectReason.TIMESTAMP if timestamp_us(data) >= vlp16.HOUR_US else None
