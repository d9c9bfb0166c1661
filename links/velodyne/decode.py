"""Decoder of VLP-16 data packets: every laser pulse with its time, azimuth, range and xyz in the lidar frame.

    azimuth = azimuth_block + rate * (time since the block's first pulse)
    x = r cos(el) sin(az)    y = r cos(el) cos(az)    z = r sin(el) + vertical offset of the laser

`rate` is the packet's mean rate, (azimuth of the last block - azimuth of the first) / (time between them). A block's
azimuth jitters by 0.01 to 0.02 deg: a rate from two neighbouring blocks gives an error of 0.4 mrad at the block's last
pulses, the mean rate 0.1 mrad. sin and cos are computed only for the 12 blocks and the 32 pulse delays, and combined by
the addition theorems. The compiled functions are in `stages/kernels/velodyne.py`.

Source: VLP-16 User Manual 63-9243 Rev. E, sections 9.3 to 9.5; the mean rate is ours.
"""

from __future__ import annotations

import numpy as np

from links.velodyne import vlp16
from stages.kernels.velodyne import LASER_ELEVATION_RAD, PULSES, decode, decode_dual
from stages.messages import LidarFirings


class FiringRows:
    """Collects the pulses of consecutive data packets into one LidarFirings message."""

    def __init__(self, max_packets: int) -> None:
        """`max_packets`: packets in a message."""
        self._max_packets = max_packets
        self._start()

    def _start(self) -> None:
        rows = self._max_packets * PULSES
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
        """Whether `max_packets` packets are in it."""
        return self.packets == self._max_packets

    def add(self, data: bytes, stamp_ns: int, lost_packets: int) -> bool:
        """Add every pulse of a packet that `reject_reason` accepts and whose first laser fired at stamp_ns.

        Single return gives 384 rows, dual return 192 to 384, in firing order: one row of kind 0 per pulse, with range 0
        and xyz (0, 0, 0) where nothing returned. In dual return mode a row of kind 1 with the same time follows where
        the last return differs from the strongest (or from the second strongest, which the sensor sends when the last
        return is the strongest). Returns False and adds nothing when the azimuths are invalid.
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
        """The message of all packets added since the previous call."""
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
    """Compile the kernels, or load them from numba's cache, before the first packet arrives."""
    for mode in (vlp16.STRONGEST, vlp16.DUAL):
        FiringRows(1).add(bytes(vlp16.RETURN_MODE_AT) + bytes([mode, vlp16.PRODUCT_ID]), 0, 0)
