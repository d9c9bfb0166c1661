"""One VLP-16 data packet -> every laser pulse with its time, azimuth, range and xyz in the lidar frame.

    azimuth = azimuth_block + rate * (time since the block's first pulse)
    x = r cos(el) sin(az)    y = r cos(el) cos(az)    z = r sin(el) + vertical offset of the laser

The rate is the packet's mean, (azimuth of its last block - first) / (time between them): a block's azimuth jitters by
0.01 to 0.02 deg, so a rate from two neighbours would put 0.4 mrad on the block's last pulses; the mean keeps 0.1 mrad.
sin and cos are computed for the 12 blocks and the 32 pulse delays alone and joined by the addition theorems.

Source: VLP-16 User Manual 63-9243 Rev. E, sections 9.3 to 9.5; the mean rate is ours.
"""

from __future__ import annotations

import numpy as np

from links.velodyne import vlp16
from links.velodyne.refusal import Refusal
from stages.kernels.velodyne import LASER_ELEVATION_RAD, PULSES, decode, decode_dual
from stages.messages import LidarFirings

_FLAG_LOW, _FLAG_HIGH = (vlp16.BLOCK_FLAG[k : k + 1] * vlp16.BLOCKS for k in (0, 1))


def timestamp_us(data: bytes) -> int:
    """Microseconds after the hour when the packet's first laser fired."""
    return int.from_bytes(data[vlp16.TIMESTAMP_AT : vlp16.TIMESTAMP_AT + 4], "little")


def refusal_of(data: bytes) -> Refusal | None:
    """Why these bytes cannot be a VLP-16 data packet, by length, factory bytes, flags and time. None: they can."""
    if len(data) != vlp16.PACKET_BYTES:
        return Refusal.POSITION if len(data) == vlp16.POSITION_BYTES else Refusal.LENGTH
    if data[vlp16.PRODUCT_ID_AT] != vlp16.PRODUCT_ID:
        return Refusal.MODEL
    if not vlp16.STRONGEST <= data[vlp16.RETURN_MODE_AT] <= vlp16.DUAL:
        return Refusal.RETURN_MODE
    blocks_end, block_bytes = vlp16.TIMESTAMP_AT, vlp16.BLOCK_BYTES
    if data[0:blocks_end:block_bytes] != _FLAG_LOW or data[1:blocks_end:block_bytes] != _FLAG_HIGH:
        return Refusal.FLAG
    return Refusal.TIMESTAMP if timestamp_us(data) >= vlp16.HOUR_US else None


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
        """Every pulse of a packet that passed `refusal_of` and whose first laser fired at stamp_ns.

        384 rows in single return, 192 to 384 in dual return, in firing order: one row of kind 0 for each pulse, with
        range 0 and xyz (0, 0, 0) where nothing returned. In dual return it is followed by one of kind 1 and the same
        time where the last return differs from the strongest (or second strongest, which the sensor sends when the
        strongest came last). False, and nothing is taken, when the azimuths cannot be right.
        """
        free = slice(self._rows, self._rows + PULSES)
        kernel = decode_dual if data[vlp16.RETURN_MODE_AT] == vlp16.DUAL else decode
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
            laser_elevation_rad=LASER_ELEVATION_RAD,
        )
        self._start()
        return firings


def compile_kernels() -> None:
    """Compile the kernels, or load them from numba's cache, before packets wait for it."""
    for mode in (vlp16.STRONGEST, vlp16.DUAL):
        FiringRows(1).add(bytes(vlp16.RETURN_MODE_AT) + bytes([mode, vlp16.PRODUCT_ID]), 0, 0)
