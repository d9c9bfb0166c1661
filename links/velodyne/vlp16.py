"""The VLP-16 (and Puck LITE) as its datasheet describes it: angles, timing and packet layout, in the datasheet's units.

Source: Velodyne VLP-16 User Manual 63-9243 Rev. E, chapter 9 (tables 9-1 to 9-4, figures 9-2 to 9-9).
https://velodynelidar.com/wp-content/uploads/2019/12/63-9243-Rev-E-VLP-16-User-Manual.pdf
"""

from __future__ import annotations

LASERS = 16

# Table 9-1, laser id 0..15: elevation [deg] and vertical correction [mm], which is added to z.
ELEVATION_DEG = (-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15)
VERTICAL_OFFSET_MM = (11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2)

# Section 9.3.1.1 and 9.5: firing cycle. A firing sequence is 16 pulses and a recharge pause.
PULSE_NS = 2_304
SEQUENCE_NS = 55_296

# Section 9.3.2: data packet (UDP payload), little endian.
DATA_PORT = 2368
PACKET_BYTES = 1206
BLOCKS = 12
BLOCK_BYTES = 100  # flag u16, azimuth u16, then 32 channels: two firing sequences of 16 lasers
BLOCK_HEAD_BYTES = 4
BLOCK_PULSES = 2 * LASERS
CHANNEL_BYTES = 3  # range u16, reflectivity u8
BLOCK_FLAG = b"\xff\xee"  # 0xEEFF
LOWER_BLOCK_FLAG = b"\xff\xdd"  # 0xDDFF: sensors with more than 32 lasers only
TIMESTAMP_AT = 1200  # u32: microseconds since the top of the hour, when the packet's first laser fired
RETURN_MODE_AT = 1204
PRODUCT_ID_AT = 1205

RANGE_UNIT_MM = 2
AZIMUTH_TURN = 36_000  # hundredths of a degree in a turn
HOUR_US = 3_600_000_000
MAX_SPIN_HZ = 20  # 300 to 1200 rpm

# Table 9-2: factory bytes.
STRONGEST, LAST, DUAL = 0x37, 0x38, 0x39
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
