"""Compiled functions that decode the packets of a spinning LiDAR into one row per laser pulse.

A packet is a row of blocks, each with an azimuth and one entry (range, reflectivity) per pulse. Where its fields are is
described by three arrays, made by `links/lidar/packet_format.py`: LAYOUT, SCALES, and a row of PULSE_COLUMNS per pulse
of a block. Source: see `links/lidar/decode.py`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
Integers = NDArray[np.int64]

# LAYOUT: integers. Positions count from the packet's start (FIRST_BLOCK_AT), the block's (…_IN_BLOCK) or the entry's.
(
    BLOCKS,
    FIRST_BLOCK_AT,
    BLOCK_BYTES,
    AZIMUTH_IN_BLOCK,  # u16
    AZIMUTH_TURN,  # counts in a turn
    MAX_STEP,  # largest change of the azimuth from block to block [counts]
    BLOCK_NS,  # from one block to the next
    TIME_IN_BLOCK,  # u64 [ns]; -1: blocks are BLOCK_NS apart
    STATUS_IN_BLOCK,  # bit 0 set: the block is valid; -1: every block is
    FIRST_ENTRY_IN_BLOCK,
    ENTRY_BYTES,
    RANGE_BYTES,  # 2 or 4, little endian
    RANGE_MASK,
    REFLECTIVITY_AFTER_RANGE,  # from the range, with which an entry begins
    SECOND_RANGE_IN_ENTRY,  # dual return; -1: pairs of blocks hold the last and the strongest return
    LAYOUT,
) = range(16)
RANGE_UNIT_M, ORIGIN_M, AZIMUTH_ZERO_RAD, SCALES = range(4)
"""SCALES: floats. Unit of a range, distance of the lasers' origins from the axis, azimuth at count 0."""
COS_ELEVATION, SIN_ELEVATION, Z_OFFSET_M, AZIMUTH_OFFSET_RAD, TURN_NS, DELAY_NS, LASER, PULSE_COLUMNS = range(8)
"""Columns of a pulse: TURN_NS is the time by which the rotor has turned on since the block's azimuth was read."""


class Rows(NamedTuple):
    """Columns of a LidarFirings message: one row per pulse and return."""

    pulse_stamp_ns: Integers
    laser: Bytes
    azimuth_rad: Floats
    range_m: Floats
    reflectivity: Bytes
    return_kind: Bytes
    xyz_lidar_m: Floats


KIND_STRONGEST, KIND_LAST = 0, 1  # every pulse has one row of the first kind: its strongest or its only return
_TAU_F32 = np.float32(math.tau)


@compiled
def _u16(data: bytes, at: int) -> int:
    return data[at] | (data[at + 1] << 8)


@compiled
def _valid(data: bytes, at: int, status_at: int) -> bool:
    return status_at < 0 or data[at + status_at] & 1 == 1


@compiled
def _u64(data: bytes, at: int) -> int:
    value = 0
    for k in range(8):
        value |= data[at + k] << (8 * k)
    return value


@compiled
def _rotation(data: bytes, dual: bool, layout: Integers) -> float:
    """Mean rotation per block time [counts]; NaN if the azimuths are invalid."""
    turn, blocks = layout[AZIMUTH_TURN], layout[BLOCKS]
    half, turned, before = turn // 2, 0, 0
    for block in range(blocks):
        at = layout[FIRST_BLOCK_AT] + block * layout[BLOCK_BYTES]
        if not _valid(data, at, layout[STATUS_IN_BLOCK]):
            continue
        azimuth = _u16(data, at + layout[AZIMUTH_IN_BLOCK])
        if azimuth >= turn:
            return np.nan
        if block > 0:
            step = (azimuth - before + half) % turn - half
            if abs(step) > layout[MAX_STEP] or (dual and block % 2 == 1 and step != 0):
                return np.nan
            turned += step
        before = azimuth
    return turned / (blocks // 2 - 1 if dual else blocks - 1)


@compiled
def _decode_blocks(
    data: bytes,
    stamp_ns: int,
    layout: Integers,
    scales: Array64,
    pulses: Array64,
    rate: float,
    first_block: int,
    block_step: int,
    range_in_entry: int,
    kind: int,
    rows: Rows,
    row: int,
) -> int:
    """Fill a row for each entry of every `block_step`th block, from `row` on; returns the row after the last."""
    count, block_ns, unit_m, origin_m = len(pulses), layout[BLOCK_NS], scales[RANGE_UNIT_M], scales[ORIGIN_M]
    azimuth_unit_rad, time_at, wide, mask = (
        math.tau / layout[AZIMUTH_TURN],
        layout[TIME_IN_BLOCK],
        layout[RANGE_BYTES] == 4,
        layout[RANGE_MASK],
    )
    first_ns = -1
    turn_rad = np.empty(count)
    cos_turn = np.empty(count)
    sin_turn = np.empty(count)
    for j in range(count):
        turn_rad[j] = rate * pulses[j, TURN_NS] / block_ns * azimuth_unit_rad + pulses[j, AZIMUTH_OFFSET_RAD]
        cos_turn[j], sin_turn[j] = math.cos(turn_rad[j]), math.sin(turn_rad[j])

    shade_at = layout[REFLECTIVITY_AFTER_RANGE]
    for number, block in enumerate(range(first_block, layout[BLOCKS], block_step)):
        block_at = layout[FIRST_BLOCK_AT] + block * layout[BLOCK_BYTES]
        if not _valid(data, block_at, layout[STATUS_IN_BLOCK]):
            continue
        block_rad = _u16(data, block_at + layout[AZIMUTH_IN_BLOCK]) * azimuth_unit_rad + scales[AZIMUTH_ZERO_RAD]
        cos_block, sin_block = math.cos(block_rad), math.sin(block_rad)
        block_stamp_ns = stamp_ns + number * block_ns
        if time_at >= 0:
            time_ns = _u64(data, block_at + time_at)
            if first_ns < 0:
                first_ns = time_ns
            block_stamp_ns = stamp_ns + (time_ns - first_ns)
        entries_at = block_at + layout[FIRST_ENTRY_IN_BLOCK]
        for j in range(count):
            range_at = entries_at + j * layout[ENTRY_BYTES] + range_in_entry
            counts = _u16(data, range_at)
            if wide:
                counts |= _u16(data, range_at + 2) << 16
            r: float = (counts & mask) * unit_m
            rows.range_m[row + j] = r
            rows.reflectivity[row + j] = data[range_at + shade_at]
            level = r - origin_m if r > 0.0 else 0.0
            x = level * pulses[j, COS_ELEVATION] * (sin_block * cos_turn[j] + cos_block * sin_turn[j])
            y = level * pulses[j, COS_ELEVATION] * (cos_block * cos_turn[j] - sin_block * sin_turn[j])
            if origin_m > 0.0 and r > 0.0:  # the beams start beside the axis
                x += origin_m * sin_block
                y += origin_m * cos_block
            rows.xyz_lidar_m[row + j, 0] = x
            rows.xyz_lidar_m[row + j, 1] = y
            rows.xyz_lidar_m[row + j, 2] = level * pulses[j, SIN_ELEVATION] + pulses[j, Z_OFFSET_M] if r > 0.0 else 0.0
        for j in range(count):
            angle_rad = block_rad + turn_rad[j]
            if angle_rad < 0.0:
                angle_rad += math.tau
            elif angle_rad >= math.tau:
                angle_rad -= math.tau
            rounded = np.float32(angle_rad)
            rows.azimuth_rad[row + j] = rounded if rounded < _TAU_F32 else np.float32(0.0)
            rows.pulse_stamp_ns[row + j] = block_stamp_ns + np.int64(pulses[j, DELAY_NS])
            rows.laser[row + j] = np.uint8(pulses[j, LASER])
            rows.return_kind[row + j] = kind
        row += count
    return row


@compiled
def decode(
    data: bytes,
    stamp_ns: int,
    dual: bool,
    layout: Integers,
    scales: Array64,
    pulses: Array64,
    first_row: int,
    pulse_stamp_ns: Integers,
    laser: Bytes,
    azimuth_rad: Floats,
    range_m: Floats,
    reflectivity: Bytes,
    return_kind: Bytes,
    xyz_lidar_m: Floats,
) -> int:
    """Fill the rows of a packet's returns, from first_row on; returns their number, 0 if the azimuths are invalid.

    Dual return: even blocks hold the last return and odd ones the strongest, or an entry holds both. A pulse gets a row
    for its strongest or only return, and a second one after it where its last return is another.
    """
    rows = Rows(pulse_stamp_ns, laser, azimuth_rad, range_m, reflectivity, return_kind, xyz_lidar_m)
    second = layout[SECOND_RANGE_IN_ENTRY]
    in_pairs = dual and second < 0
    rate = _rotation(data, in_pairs, layout)
    if np.isnan(rate):
        return 0
    if not dual:
        end = _decode_blocks(data, stamp_ns, layout, scales, pulses, rate, 0, 1, 0, KIND_STRONGEST, rows, first_row)
        return end - first_row
    size = layout[BLOCKS] * len(pulses)
    both = Rows(
        np.empty(2 * size, np.int64),
        np.empty(2 * size, np.uint8),
        np.empty(2 * size, np.float32),
        np.empty(2 * size, np.float32),
        np.empty(2 * size, np.uint8),
        np.empty(2 * size, np.uint8),
        np.empty((2 * size, 3), np.float32),
    )
    count = 0
    for kind in (KIND_STRONGEST, KIND_LAST):
        first_block, step = (1 - kind, 2) if in_pairs else (0, 1)
        range_at = second if kind == KIND_LAST and not in_pairs else 0
        end = _decode_blocks(
            data, stamp_ns, layout, scales, pulses, rate, first_block, step, range_at, kind, both, kind * size
        )
        count = end - kind * size
    row = first_row
    for pulse in range(count):
        strongest, last = both.range_m[pulse], both.range_m[size + pulse]
        for kind in range(2 if 0 != last != strongest != 0 else 1):
            source = pulse + size * (kind == KIND_LAST or (strongest == 0 and last != 0))
            rows.pulse_stamp_ns[row] = both.pulse_stamp_ns[source]
            rows.laser[row] = both.laser[source]
            rows.azimuth_rad[row] = both.azimuth_rad[source]
            rows.range_m[row] = both.range_m[source]
            rows.reflectivity[row] = both.reflectivity[source]
            rows.return_kind[row] = kind
            for axis in range(3):
                rows.xyz_lidar_m[row, axis] = both.xyz_lidar_m[source, axis]
            row += 1
    return row - first_row
