"""One VLP-16 data packet -> every laser pulse with its time, azimuth, range and xyz in the lidar frame.

    azimuth = azimuth_block + rate * (time since the block's first pulse)
    x = r cos(el) sin(az)    y = r cos(el) cos(az)    z = r sin(el) + vertical offset of the laser

The rate is the packet's mean, (azimuth of its last block - first) / (time between them): a block's azimuth jitters by
0.01 to 0.02 deg, so a rate from two neighbours would put 0.4 mrad on the block's last pulses; the mean keeps 0.1 mrad.
sin and cos are computed for the 12 blocks and the 32 pulse delays alone and joined by the addition theorems.

Source: VLP-16 User Manual 63-9243 Rev. E, sections 9.3 to 9.5; the mean rate is ours.
"""

from __future__ import annotations

import math

import numpy as np

from links.velodyne import vlp16
from links.velodyne.reject_reason import RejectReason
from stages.compiled import compiled
from stages.messages import LidarFirings

PULSES = vlp16.BLOCKS * vlp16.BLOCK_PULSES  # 384 channel entries in a packet
KIND_STRONGEST, KIND_LAST = 0, 1  # every pulse has one row of the first kind: its strongest or its only return

# Pulse j of a block: laser, delay after the block's first pulse. Numba caches the kernels with these numbers inside and
# looks for changes in this file only: after a change in vlp16.py, touch this one.
_PULSE = np.arange(vlp16.BLOCK_PULSES)
_LASER = (_PULSE % vlp16.LASERS).astype(np.uint8)
_DELAY_NS = (_PULSE // vlp16.LASERS * vlp16.SEQUENCE_NS + _PULSE % vlp16.LASERS * vlp16.PULSE_NS).astype(np.int64)
_BLOCK_NS = 2 * vlp16.SEQUENCE_NS
_LASER_ELEVATION_RAD = np.radians(np.array(vlp16.ELEVATION_DEG, dtype=np.float64))
_ELEVATION_RAD = _LASER_ELEVATION_RAD[_LASER]
_COS_ELEVATION, _SIN_ELEVATION = np.cos(_ELEVATION_RAD), np.sin(_ELEVATION_RAD)
_Z_OFFSET_M = 1e-3 * np.array(vlp16.VERTICAL_OFFSET_MM, dtype=np.float64)[_LASER]

_RANGE_M = 1e-3 * vlp16.RANGE_UNIT_MM
_AZIMUTH_RAD = math.tau / vlp16.AZIMUTH_TURN
_TAU_F32 = np.float32(math.tau)
# The furthest the head turns in a block's time, with half as much to spare. [0.01 deg]
_MAX_STEP = int(1.5 * vlp16.MAX_SPIN_HZ * vlp16.AZIMUTH_TURN * _BLOCK_NS * 1e-9)


@compiled
def _rotation(data, dual, block_azimuth):
    """Fill the blocks' azimuths [0.01 deg]; return the mean turn per block time, NaN when they cannot be right."""
    half = vlp16.AZIMUTH_TURN // 2
    turned = 0
    for block in range(vlp16.BLOCKS):
        at = block * vlp16.BLOCK_BYTES + 2
        azimuth = data[at] | (data[at + 1] << 8)
        if azimuth >= vlp16.AZIMUTH_TURN:
            return np.nan
        block_azimuth[block] = azimuth
        if block > 0:
            step = (azimuth - block_azimuth[block - 1] + half) % vlp16.AZIMUTH_TURN - half
            if abs(step) > _MAX_STEP or (dual and block % 2 == 1 and step != 0):
                return np.nan
            turned += step
    return turned / (vlp16.BLOCKS // 2 - 1 if dual else vlp16.BLOCKS - 1)


@compiled
def _decode(data, stamp_ns, pulse_stamp_ns, laser, azimuth_rad, range_m, reflectivity, return_kind, xyz_lidar_m):
    """Fill a row for each of the 384 channel entries; returns their number, 0 when the azimuths cannot be right."""
    dual = data[vlp16.RETURN_MODE_AT] == vlp16.DUAL
    block_azimuth = np.empty(vlp16.BLOCKS, np.int64)
    rate = _rotation(data, dual, block_azimuth)
    if np.isnan(rate):
        return 0

    turn_rad = np.empty(vlp16.BLOCK_PULSES)
    cos_turn = np.empty(vlp16.BLOCK_PULSES)
    sin_turn = np.empty(vlp16.BLOCK_PULSES)
    for j in range(vlp16.BLOCK_PULSES):
        turn_rad[j] = rate * _DELAY_NS[j] / _BLOCK_NS * _AZIMUTH_RAD
        cos_turn[j], sin_turn[j] = math.cos(turn_rad[j]), math.sin(turn_rad[j])

    for block in range(vlp16.BLOCKS):
        block_rad = block_azimuth[block] * _AZIMUTH_RAD
        cos_block, sin_block = math.cos(block_rad), math.sin(block_rad)
        block_stamp_ns = stamp_ns + (block // 2 if dual else block) * _BLOCK_NS
        kind = KIND_LAST if dual and block % 2 == 0 else KIND_STRONGEST
        for j in range(vlp16.BLOCK_PULSES):
            row = block * vlp16.BLOCK_PULSES + j
            at = block * vlp16.BLOCK_BYTES + vlp16.BLOCK_HEAD_BYTES + j * vlp16.CHANNEL_BYTES
            r = (data[at] | (data[at + 1] << 8)) * _RANGE_M
            range_m[row] = r
            reflectivity[row] = data[at + 2]
            xyz_lidar_m[row, 0] = r * _COS_ELEVATION[j] * (sin_block * cos_turn[j] + cos_block * sin_turn[j])
            xyz_lidar_m[row, 1] = r * _COS_ELEVATION[j] * (cos_block * cos_turn[j] - sin_block * sin_turn[j])
            xyz_lidar_m[row, 2] = r * _SIN_ELEVATION[j] + _Z_OFFSET_M[j] if r > 0.0 else 0.0
        for j in range(vlp16.BLOCK_PULSES):
            row = block * vlp16.BLOCK_PULSES + j
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
def _decode_dual(data, stamp_ns, pulse_stamp_ns, laser, azimuth_rad, range_m, reflectivity, return_kind, xyz_lidar_m):
    """Dual return: as `_decode`, then each pulse's two returns side by side; returns how many rows are filled.

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
    if _decode(data, stamp_ns, stamp_, laser_, azimuth_, range_, reflectivity_, kind_, xyz_) == 0:
        return 0
    entry = np.empty(PULSES + 1, np.int64)  # one to spare: written before it is known to stay
    rows = 0
    for pair in range(vlp16.BLOCKS // 2):
        for j in range(vlp16.BLOCK_PULSES):
            last = 2 * pair * vlp16.BLOCK_PULSES + j
            strongest = last + vlp16.BLOCK_PULSES
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


_FLAG_LOW, _FLAG_HIGH = (vlp16.BLOCK_FLAG[k : k + 1] * vlp16.BLOCKS for k in (0, 1))


def timestamp_us(data: bytes) -> int:
    """Microseconds after the hour when the packet's first laser fired."""
    return int.from_bytes(data[vlp16.TIMESTAMP_AT : vlp16.TIMESTAMP_AT + 4], "little")


def reject_reason(data: bytes) -> RejectReason | None:
    """Why these bytes cannot be a VLP-16 data packet, by length, factory bytes, flags and time. None: they can."""
    if len(data) != vlp16.PACKET_BYTES:
        return RejectReason.POSITION if len(data) == vlp16.POSITION_BYTES else RejectReason.LENGTH
    if data[vlp16.PRODUCT_ID_AT] != vlp16.PRODUCT_ID:
        return RejectReason.MODEL
    if not vlp16.STRONGEST <= data[vlp16.RETURN_MODE_AT] <= vlp16.DUAL:
        return RejectReason.RETURN_MODE
    blocks_end, block_bytes = vlp16.TIMESTAMP_AT, vlp16.BLOCK_BYTES
    if data[0:blocks_end:block_bytes] != _FLAG_LOW or data[1:blocks_end:block_bytes] != _FLAG_HIGH:
        return RejectReason.FLAG
    return RejectReason.TIMESTAMP if timestamp_us(data) >= vlp16.HOUR_US else None


class FiringRows:
    """The pulses of up to so many data packets in a row, as one message."""

    def __init__(self, most: int) -> None:
        """`most`: packets in a message."""
        self._most = most
        self._start()

    def _start(self) -> None:
        rows = self._most * PULSES
        self.packets = self._rows = self._stamp_ns = self._lost_packets = 0
        self._pulse_stamp_ns = np.empty(rows, np.int64)
        self._laser = np.empty(rows, np.uint8)
        self._azimuth_rad = np.empty(rows, np.float32)
        self._range_m = np.empty(rows, np.float32)
        self._reflectivity = np.empty(rows, np.uint8)
        self._return_kind = np.empty(rows, np.uint8)
        self._xyz_lidar_m = np.empty((rows, 3), np.float32)

    @property
    def full(self) -> bool:
        """Whether it takes no more."""
        return self.packets == self._most

    def add(self, data: bytes, stamp_ns: int, lost_packets: int) -> bool:
        """Every pulse of a packet that passed `reject_reason` and whose first laser fired at stamp_ns.

        384 rows in single return, 192 to 384 in dual return, in firing order: one row of kind 0 for each pulse, with
        range 0 and xyz (0, 0, 0) where nothing returned. In dual return it is followed by one of kind 1 and the same
        time where the last return differs from the strongest (or second strongest, which the sensor sends when the
        strongest came last). False, and nothing is taken, when the azimuths cannot be right.
        """
        free = slice(self._rows, self._rows + PULSES)
        kernel = _decode_dual if data[vlp16.RETURN_MODE_AT] == vlp16.DUAL else _decode
        rows = kernel(
            data,
            stamp_ns,
            self._pulse_stamp_ns[free],
            self._laser[free],
            self._azimuth_rad[free],
            self._range_m[free],
            self._reflectivity[free],
            self._return_kind[free],
            self._xyz_lidar_m[free],
        )
        if rows == 0:
            return False
        if self.packets == 0:
            self._stamp_ns, self._lost_packets = stamp_ns, lost_packets
        self.packets += 1
        self._rows += rows
        return True

    def take(self) -> LidarFirings:
        """What was added since the call before."""
        filled = slice(0, self._rows)
        firings = LidarFirings(
            stamp_ns=self._stamp_ns,
            pulse_stamp_ns=self._pulse_stamp_ns[filled],
            laser=self._laser[filled],
            azimuth_rad=self._azimuth_rad[filled],
            range_m=self._range_m[filled],
            reflectivity=self._reflectivity[filled],
            return_kind=self._return_kind[filled],
            xyz_lidar_m=self._xyz_lidar_m[filled],
            lost_packets=self._lost_packets,
            laser_elevation_rad=_LASER_ELEVATION_RAD,
        )
        self._start()
        return firings


def compile_kernels() -> None:
    """Compile the kernels, or load them from numba's cache, before packets wait for it."""
    for mode in (vlp16.STRONGEST, vlp16.DUAL):
        FiringRows(1).add(bytes(vlp16.RETURN_MODE_AT) + bytes([mode, vlp16.PRODUCT_ID]), 0, 0)
