"""Compiled functions that decode VLP-16 packets into one row per laser pulse.

Source: see `links/velodyne/decode.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.kernels.compiled import compiled

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

# VLP-16 User Manual 63-9243 Rev. E: table 9-1, laser id 0..15: elevation [deg] and vertical correction [mm], which is
# added to z; section 9.3.1.1 and 9.5: firing cycle, 16 pulses and a recharge pause; section 9.3.2: data packet.
LASERS = 16
ELEVATION_DEG = (-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15)
VERTICAL_OFFSET_MM = (11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2)
PULSE_NS = 2_304
SEQUENCE_NS = 55_296
BLOCKS = 12
BLOCK_BYTES = 100  # flag u16, azimuth u16, then 32 channels: two firing sequences of 16 lasers
BLOCK_HEAD_BYTES = 4
BLOCK_PULSES = 2 * LASERS
CHANNEL_BYTES = 3  # range u16, reflectivity u8
RETURN_MODE_AT = 1204
RANGE_UNIT_MM = 2
AZIMUTH_TURN = 36_000  # hundredths of a degree in a turn
MAX_SPIN_HZ = 20  # 300 to 1200 rpm
STRONGEST, LAST, DUAL = 0x37, 0x38, 0x39  # table 9-2: factory bytes of the return mode

PULSES = BLOCKS * BLOCK_PULSES  # 384 channel entries in a packet
KIND_STRONGEST, KIND_LAST = 0, 1  # every pulse has one row of the first kind: its strongest or its only return
# Pulse j of a block: laser, delay after the block's first pulse.
_PULSE = np.arange(BLOCK_PULSES)
_LASER = (_PULSE % LASERS).astype(np.uint8)
_DELAY_NS = (_PULSE // LASERS * SEQUENCE_NS + _PULSE % LASERS * PULSE_NS).astype(np.int64)
_BLOCK_NS = 2 * SEQUENCE_NS
LASER_ELEVATION_RAD = np.radians(np.array(ELEVATION_DEG, dtype=np.float64))
_ELEVATION_RAD = LASER_ELEVATION_RAD[_LASER]
_COS_ELEVATION, _SIN_ELEVATION = np.cos(_ELEVATION_RAD), np.sin(_ELEVATION_RAD)
_Z_OFFSET_M = 1e-3 * np.array(VERTICAL_OFFSET_MM, dtype=np.float64)[_LASER]
_RANGE_M = 1e-3 * RANGE_UNIT_MM
_AZIMUTH_RAD = math.tau / AZIMUTH_TURN
_TAU_F32 = np.float32(math.tau)
# The furthest the head turns in a block's time, with half as much to spare. [0.01 deg]
_MAX_STEP = int(1.5 * MAX_SPIN_HZ * AZIMUTH_TURN * _BLOCK_NS * 1e-9)


@compiled
def _rotation(data: bytes, dual: bool, block_azimuth: NDArray[np.int64]) -> float:
    """Fill the blocks' azimuths [0.01 deg]; return the mean rotation per block time; NaN if they are invalid."""
    half = AZIMUTH_TURN // 2
    turned = 0
    for block in range(BLOCKS):
        at = block * BLOCK_BYTES + 2
        azimuth = data[at] | (data[at + 1] << 8)
        if azimuth >= AZIMUTH_TURN:
            return np.nan
        block_azimuth[block] = azimuth
        if block > 0:
            step = (azimuth - block_azimuth[block - 1] + half) % AZIMUTH_TURN - half
            if abs(step) > _MAX_STEP or (dual and block % 2 == 1 and step != 0):
                return np.nan
            turned += step
    return turned / (BLOCKS // 2 - 1 if dual else BLOCKS - 1)


@compiled
def decode(
    data: bytes,
    stamp_ns: int,
    pulse_stamp_ns: NDArray[np.int64],
    laser: Bytes,
    azimuth_rad: Floats,
    range_m: Floats,
    reflectivity: Bytes,
    return_kind: Bytes,
    xyz_lidar_m: Floats,
) -> int:
    """Fill a row for each of the 384 channel entries; returns their number, 0 if the azimuths are invalid."""
    dual = data[RETURN_MODE_AT] == DUAL
    block_azimuth = np.empty(BLOCKS, np.int64)
    rate = _rotation(data, dual, block_azimuth)
    if np.isnan(rate):
        return 0

    turn_rad = np.empty(BLOCK_PULSES)
    cos_turn = np.empty(BLOCK_PULSES)
    sin_turn = np.empty(BLOCK_PULSES)
    for j in range(BLOCK_PULSES):
        turn_rad[j] = rate * _DELAY_NS[j] / _BLOCK_NS * _AZIMUTH_RAD
        cos_turn[j], sin_turn[j] = math.cos(turn_rad[j]), math.sin(turn_rad[j])

    for block in range(BLOCKS):
        block_rad = block_azimuth[block] * _AZIMUTH_RAD
        cos_block, sin_block = math.cos(block_rad), math.sin(block_rad)
        block_stamp_ns = stamp_ns + (block // 2 if dual else block) * _BLOCK_NS
        kind = KIND_LAST if dual and block % 2 == 0 else KIND_STRONGEST
        for j in range(BLOCK_PULSES):
            row = block * BLOCK_PULSES + j
            at = block * BLOCK_BYTES + BLOCK_HEAD_BYTES + j * CHANNEL_BYTES
            r = (data[at] | (data[at + 1] << 8)) * _RANGE_M
            range_m[row] = r
            reflectivity[row] = data[at + 2]
            xyz_lidar_m[row, 0] = r * _COS_ELEVATION[j] * (sin_block * cos_turn[j] + cos_block * sin_turn[j])
            xyz_lidar_m[row, 1] = r * _COS_ELEVATION[j] * (cos_block * cos_turn[j] - sin_block * sin_turn[j])
            xyz_lidar_m[row, 2] = r * _SIN_ELEVATION[j] + _Z_OFFSET_M[j] if r > 0.0 else 0.0
        for j in range(BLOCK_PULSES):
            row = block * BLOCK_PULSES + j
            angle_rad = block_rad + turn_rad[j]
            if angle_rad < 0.0:
                angle_rad += math.tau
            elif angle_rad >= math.tau:
                angle_rad -= math.tau
            rounded = np.float32(angle_rad)
            azimuth_rad[row] = rounded if rounded < _TAU_F32 else np.float32(0.0)
            pulse_stamp_ns[row] = block_stamp_ns + _DELAY_NS[j]
            laser[row] = _LASER[j]
            return_kind[row] = kind
    return PULSES


@compiled
def decode_dual(
    data: bytes,
    stamp_ns: int,
    pulse_stamp_ns: NDArray[np.int64],
    laser: Bytes,
    azimuth_rad: Floats,
    range_m: Floats,
    reflectivity: Bytes,
    return_kind: Bytes,
    xyz_lidar_m: Floats,
) -> int:
    """Dual return: as `decode`, then the two returns of each pulse as neighbours; returns the number of rows.

    Even blocks hold the last return, odd ones the strongest. A pulse gets a row for its strongest or only return, and a
    second one where its last return is another.
    """
    stamp_ = np.empty_like(pulse_stamp_ns)
    laser_ = np.empty_like(laser)
    azimuth_ = np.empty_like(azimuth_rad)
    range_ = np.empty_like(range_m)
    reflectivity_ = np.empty_like(reflectivity)
    kind_ = np.empty_like(return_kind)
    xyz_ = np.empty_like(xyz_lidar_m)
    if decode(data, stamp_ns, stamp_, laser_, azimuth_, range_, reflectivity_, kind_, xyz_) == 0:
        return 0
    entry = np.empty(PULSES + 1, np.int64)  # one spare: written before its validity is known
    rows = 0
    for pair in range(BLOCKS // 2):
        for j in range(BLOCK_PULSES):
            last = 2 * pair * BLOCK_PULSES + j
            strongest = last + BLOCK_PULSES
            if range_[strongest] == 0 and range_[last] != 0:
                kind_[last] = KIND_STRONGEST
            else:
                entry[rows] = strongest
                rows += 1
            entry[rows] = last
            rows += range_[last] != 0 and range_[last] != range_[strongest]
    for row in range(rows):
        pulse_stamp_ns[row] = stamp_[entry[row]]
        laser[row] = laser_[entry[row]]
        azimuth_rad[row] = azimuth_[entry[row]]
        range_m[row] = range_[entry[row]]
        reflectivity[row] = reflectivity_[entry[row]]
        return_kind[row] = kind_[entry[row]]
        for axis in range(3):
            xyz_lidar_m[row, axis] = xyz_[entry[row], axis]
    return rows
