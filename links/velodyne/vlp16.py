"""The VLP-16 (and Puck LITE) as its datasheet describes it: angles, timing and packet layout, in the datasheet's units.

Source: Velodyne VLP-16 User Manual 63-9243 Rev. E, chapter 9 (tables 9-1 to 9-4, figures 9-2 to 9-9).
https://velodynelidar.com/wp-content/uploads/2019/12/63-9243-Rev-E-VLP-16-User-Manual.pdf
"""

from __future__ import annotations

from stages.kernels.velodyne import AZIMUTH_TURN as AZIMUTH_TURN
from stages.kernels.velodyne import BLOCK_BYTES as BLOCK_BYTES
from stages.kernels.velodyne import BLOCK_HEAD_BYTES as BLOCK_HEAD_BYTES
from stages.kernels.velodyne import BLOCK_PULSES as BLOCK_PULSES
from stages.kernels.velodyne import BLOCKS as BLOCKS
from stages.kernels.velodyne import CHANNEL_BYTES as CHANNEL_BYTES
from stages.kernels.velodyne import DUAL as DUAL
from stages.kernels.velodyne import ELEVATION_DEG as ELEVATION_DEG
from stages.kernels.velodyne import LASERS as LASERS
from stages.kernels.velodyne import LAST as LAST
from stages.kernels.velodyne import MAX_SPIN_HZ as MAX_SPIN_HZ
from stages.kernels.velodyne import PULSE_NS as PULSE_NS
from stages.kernels.velodyne import RANGE_UNIT_MM as RANGE_UNIT_MM
from stages.kernels.velodyne import RETURN_MODE_AT as RETURN_MODE_AT
from stages.kernels.velodyne import SEQUENCE_NS as SEQUENCE_NS
from stages.kernels.velodyne import STRONGEST as STRONGEST
from stages.kernels.velodyne import VERTICAL_OFFSET_MM as VERTICAL_OFFSET_MM

# Section 9.3.2: data packet (UDP payload), little endian.
DATA_PORT = 2368
PACKET_BYTES = 1206
BLOCK_FLAG = b"\xff\xee"  # 0xEEFF
LOWER_BLOCK_FLAG = b"\xff\xdd"  # 0xDDFF: sensors with more than 32 lasers only
TIMESTAMP_AT = 1200  # u32: microseconds since the top of the hour, when the packet's first laser fired
PRODUCT_ID_AT = 1205

HOUR_US = 3_600_000_000

# Table 9-2: factory bytes.
PRODUCT_ID = 0x22  # VLP-16 and Puck LITE have the same angles, hence the same id
OTHER_PRODUCTS = {
    0x21: "HDL-32E",
    0x23: "VLP-32A or VLP-32B",
    0x24: "Puck Hi-Res",
    0x28: "VLP-32C",
    0x31: "Velarray",
    0x63: "VLS-128",
    0xA1: "VLS-128 (Alpha Prime)",
}

# Section 9.3.3: position packet (UDP payload).
POSITION_PORT = 8308
POSITION_BYTES = 512

# A packet leaves when its last firing sequence is over, and takes this long on the sensor's 100 Mbit/s Ethernet
# (1206 bytes; with UDP, IP and Ethernet headers, preamble and gap: 1272).
WIRE_NS = 101_760


def packet_ns(return_mode: int) -> int:
    """How long one packet's pulses take [ns]: 24 firing sequences, or 12 when each is sent twice (dual return)."""
    return SEQUENCE_NS * (BLOCKS if return_mode == DUAL else 2 * BLOCKS)


def first_pulse_ns(arrival_ns: int, data: bytes) -> int:
    """When the first laser of a packet fired, from when the packet arrived: arrival - firing time - wire time [ns].

    Late by what the sensor and the host's network stack add (tens to hundreds of microseconds). Data that is not a
    VLP-16 packet keeps its arrival time.
    """
    if len(data) != PACKET_BYTES:
        return arrival_ns
    return arrival_ns - packet_ns(data[RETURN_MODE_AT]) - WIRE_NS


def other_model(data: bytes) -> str | None:
    """Name of the Velodyne model that is not a VLP-16 but sent this packet; None when the packet does not tell."""
    flags = {data[at : at + 2] for at in range(0, BLOCKS * BLOCK_BYTES, BLOCK_BYTES)}
    product_id = data[PRODUCT_ID_AT]
    if BLOCK_FLAG not in flags or product_id == PRODUCT_ID:
        return None
    if product_id in OTHER_PRODUCTS:
        return f"{OTHER_PRODUCTS[product_id]} (product id 0x{product_id:02X})"
    return "HDL-64E" if flags == {BLOCK_FLAG, LOWER_BLOCK_FLAG} else None
