"""Compiled functions that decode the packets of a spinning LiDAR into one row per laser pulse.

A packet is a row of blocks, each with an azimuth and one entry (range, reflectivity) per pulse. Where its fields are is
described by three arrays, made by `links/lidar/packet_format.py`: LAYOUT, SCALES, and a row of PULSE_COLUMNS per pulse
of a block. Positions are unsigned: for signed ones numba also compiles counting from the end.

Source: see `links/lidar/decode.py`.
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


class Firings(NamedTuple):
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
def _u16(data: Bytes, at: np.uint64) -> np.int64:
    return np.int64(data[at]) | (np.int64(data[at + np.uint64(1)]) << 8)


@compiled
def _valid(data: Bytes, at: np.uint64, status_at: int) -> bool:
    return status_at < 0 or data[at + np.uint64(status_at)] & 1 == 1


@compiled
def _u64(data: Bytes, at: np.uint64) -> np.int64:
    value = np.int64(0)
    for k in range(8):
        value |= np.int64(data[at + np.uint64(k)]) << (8 * k)
    return value


@compiled
def _rotation(data: Bytes, dual: bool, layout: Integers) -> float:
    """Mean rotation per block time [counts]; NaN if the azimuths are invalid."""
    turn, blocks = layout[AZIMUTH_TURN], layout[BLOCKS]
    half, turned, before = turn // 2, 0, 0
    for block in range(blocks):
        at = np.uint64(layout[FIRST_BLOCK_AT] + block * layout[BLOCK_BYTES])
        if not _valid(data, at, layout[STATUS_IN_BLOCK]):
            continue
        azimuth = _u16(data, at + np.uint64(layout[AZIMUTH_IN_BLOCK]))
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
def _range_m(data: Bytes, at: np.uint64, wide: bool, mask: int, unit_m: float) -> float:
    counts = _u16(data, at)
    if wide:
        counts |= _u16(data, at + np.uint64(2)) << 16
    return (counts & mask) * unit_m


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
    packet = np.frombuffer(data, np.uint8)
    second = layout[SECOND_RANGE_IN_ENTRY]
    in_pairs = dual and second < 0
    rate = _rotation(packet, in_pairs, layout)
    if np.isnan(rate):
        return 0
    count, block_ns, block_bytes = len(pulses), layout[BLOCK_NS], layout[BLOCK_BYTES]
    unit_m, origin_m = scales[RANGE_UNIT_M], scales[ORIGIN_M]
    azimuth_unit_rad, time_at = math.tau / layout[AZIMUTH_TURN], layout[TIME_IN_BLOCK]
    wide, mask, entry_bytes = layout[RANGE_BYTES] == 4, layout[RANGE_MASK], np.uint64(layout[ENTRY_BYTES])
    shade_at = np.uint64(layout[REFLECTIVITY_AFTER_RANGE])
    to_last = -block_bytes if in_pairs else second
    first_ns = -1
    turn_rad, cos_turn, sin_turn = np.empty(count), np.empty(count), np.empty(count)
    cos_elevation, sin_elevation, z_offset_m = np.empty(count), np.empty(count), np.empty(count)
    delay_ns, lasers = np.empty(count, np.int64), np.empty(count, np.uint8)
    for j in range(count):
        turn_rad[j] = rate * pulses[j, TURN_NS] / block_ns * azimuth_unit_rad + pulses[j, AZIMUTH_OFFSET_RAD]
        cos_turn[j], sin_turn[j] = math.cos(turn_rad[j]), math.sin(turn_rad[j])
        cos_elevation[j], sin_elevation[j] = pulses[j, COS_ELEVATION], pulses[j, SIN_ELEVATION]
        z_offset_m[j], delay_ns[j] = pulses[j, Z_OFFSET_M], np.int64(pulses[j, DELAY_NS])
        lasers[j] = np.uint8(pulses[j, LASER])

    row, step = np.uint64(first_row), 2 if in_pairs else 1
    for number, block in enumerate(range(step - 1, layout[BLOCKS], step)):
        block_at = np.uint64(layout[FIRST_BLOCK_AT] + block * block_bytes)
        if not _valid(packet, block_at, layout[STATUS_IN_BLOCK]):
            continue
        block_rad = (
            _u16(packet, block_at + np.uint64(layout[AZIMUTH_IN_BLOCK])) * azimuth_unit_rad + scales[AZIMUTH_ZERO_RAD]
        )
        cos_block, sin_block = math.cos(block_rad), math.sin(block_rad)
        block_stamp_ns = stamp_ns + number * block_ns
        if time_at >= 0:
            time_ns = _u64(packet, block_at + np.uint64(time_at))
            if first_ns < 0:
                first_ns = time_ns
            block_stamp_ns = stamp_ns + (time_ns - first_ns)
        entries_at = block_at + np.uint64(layout[FIRST_ENTRY_IN_BLOCK])
        for pulse in range(count):
            j = np.uint64(pulse)
            range_at = entries_at + j * entry_bytes
            r = _range_m(packet, range_at, wide, mask, unit_m)
            returns, last_m, last_at = 1, 0.0, range_at
            if dual:
                last_at = np.uint64(np.int64(range_at) + to_last)
                last_m = _range_m(packet, last_at, wide, mask, unit_m)
                if last_m != 0.0 and r == 0.0:
                    r, range_at = last_m, last_at
                elif last_m != 0.0 and last_m != r:
                    returns = 2
            angle_rad = block_rad + turn_rad[j]
            if angle_rad < 0.0:
                angle_rad += math.tau
            elif angle_rad >= math.tau:
                angle_rad -= math.tau
            rounded = np.float32(angle_rad)
            azimuth = rounded if rounded < _TAU_F32 else np.float32(0.0)
            across = sin_block * cos_turn[j] + cos_block * sin_turn[j]
            along = cos_block * cos_turn[j] - sin_block * sin_turn[j]
            for kind in range(returns):
                if kind == KIND_LAST:
                    r, range_at = last_m, last_at
                level = r - origin_m if r > 0.0 else 0.0
                x = level * cos_elevation[j] * across
                y = level * cos_elevation[j] * along
                if origin_m > 0.0 and r > 0.0:  # the beams start at a distance from the axis
                    x += origin_m * sin_block
                    y += origin_m * cos_block
                xyz_lidar_m[row, np.uint64(0)] = x
                xyz_lidar_m[row, np.uint64(1)] = y
                xyz_lidar_m[row, np.uint64(2)] = level * sin_elevation[j] + z_offset_m[j] if r > 0.0 else 0.0
                range_m[row] = r
                reflectivity[row] = packet[range_at + shade_at]
                azimuth_rad[row] = azimuth
                pulse_stamp_ns[row] = block_stamp_ns + delay_ns[j]
                laser[row] = lasers[j]
                return_kind[row] = kind
                row += np.uint64(1)
    return np.int64(row) - first_row  # pyright: ignore[reportReturnType]
