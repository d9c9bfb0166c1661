"""Decoder of data packets: every laser pulse with its time, azimuth, range and xyz in the lidar frame.

    azimuth = azimuth_block + rate * (time since the block's first pulse) + azimuth offset of the laser
    x = r cos(el) sin(az)    y = r cos(el) cos(az)    z = r sin(el) + vertical offset of the laser

`rate` is the packet's mean rate, (azimuth of the last block - azimuth of the first) / (time between them). A block's
azimuth jitters by 0.01 to 0.02 deg: a rate from two neighbouring blocks gives an error of 0.4 mrad at the block's last
pulses, the mean rate 0.1 mrad. sin and cos are computed only for the blocks and the pulse delays, and combined by the
addition theorems. Beams that start at a distance n from the axis have r - n instead of r, from n (sin(azimuth_block),
cos(azimuth_block), 0). The compiled functions are in `stages/kernels/lidar/packets.py`.

Source: VLP-16 User Manual 63-9243 Rev. E, sections 9.3 to 9.5; the mean rate is ours.
"""

from __future__ import annotations

import numpy as np

from links.lidar.formats import AnyFormat, packet_format
from links.lidar.packet_format import STRONGEST
from links.lidar.velodyne import RETURN_MODE_AT
from stages.kernels.lidar.packets import Firings, decode
from stages.messages import LidarFirings


class FiringRows:
    """Collects the pulses of the consecutive data packets of a slice into one LidarFirings message."""

    def __init__(self, form: AnyFormat, slice_ns: int) -> None:
        self._form, self._slice_ns = form, slice_ns
        self.packets = 0

    def _start(self, packet_ns: int) -> None:
        """Make room for the whole packets, at least one, whose duration is nearest to the slice's."""
        self._max_packets = max(1, round(self._slice_ns / packet_ns))
        size = self._max_packets * self._form.max_rows
        self._count = 0
        self._rows = Firings(
            pulse_stamp_ns=np.empty(size, np.int64),
            laser=np.empty(size, np.uint8),
            azimuth_rad=np.empty(size, np.float32),
            range_m=np.empty(size, np.float32),
            reflectivity=np.empty(size, np.uint8),
            return_kind=np.empty(size, np.uint8),
            xyz_lidar_m=np.empty((size, 3), np.float32),
        )

    @property
    def full(self) -> bool:
        """Whether the slice is complete."""
        return self.packets > 0 and self.packets == self._max_packets

    def add(self, data: bytes, stamp_ns: int, lost_packets: int) -> bool:
        """Add every pulse of a packet that `reject_reason` accepts and whose first laser fired at stamp_ns.

        Rows are in firing order (a VLP-16: 384 in single return, 192 to 384 in dual return): one row of kind 0 per
        pulse, with range 0 and xyz (0, 0, 0) where nothing returned. In dual return mode a row of kind 1 with the same
        time follows where the last return differs from the strongest (or from the second strongest, which the sensor
        sends when the last return is the strongest). Returns False and adds nothing when the azimuths are invalid.
        """
        form = self._form
        dual = form.return_mode(data) == "dual"
        if self.packets == 0:
            self._start(form.duration_ns(data))
        rows = decode(data, stamp_ns, dual, form.layout, form.scales, form.pulses, self._count, *self._rows)
        if rows == 0:
            return False
        if self.packets == 0:
            self._stamp_ns, self._lost_packets = stamp_ns, lost_packets
        self.packets += 1
        self._count += rows
        return True

    def take(self) -> LidarFirings:
        """The message of all packets added since the previous call."""
        rows, count = self._rows, self._count
        self.packets = 0
        return LidarFirings(
            stamp_ns=self._stamp_ns,
            pulse_stamp_ns=rows.pulse_stamp_ns[:count],
            laser=rows.laser[:count],
            azimuth_rad=rows.azimuth_rad[:count],
            range_m=rows.range_m[:count],
            reflectivity=rows.reflectivity[:count],
            return_kind=rows.return_kind[:count],
            xyz_lidar_m=rows.xyz_lidar_m[:count],
            lost_packets=self._lost_packets,
            laser_elevation_rad=self._form.elevation_rad,
        )


def compile_kernels() -> None:
    """Compile the kernel, or load it from numba's cache, before the first packet arrives."""
    FiringRows(packet_format("VLP-16"), 1).add(bytes(RETURN_MODE_AT) + bytes([STRONGEST, 0]), 0, 0)
