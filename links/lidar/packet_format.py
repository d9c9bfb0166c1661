"""How a model's data packets are read: what every format answers, and the arrays for the compiled decoder.

Source: ours; see the formats, `velodyne.py`, `hesai.py`, `ouster.py`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from links.lidar.reject_reason import PacketRejectReason
from stages.geometry.lidar_models import LidarProfile
from stages.geometry.rig_lidar import LidarBeams
from stages.kernels.lidar import packets as columns

FRAME_BYTES = 66  # of UDP, IP and Ethernet headers, preamble and gap
STRONGEST, LAST, DUAL = 0x37, 0x38, 0x39  # return mode byte: VLP-16 manual, table 9-2; the Hesai XT sends the same


class PacketFormat(ABC):
    """Data packets of one model, and its beams."""

    packet_bytes: int
    """Length of a data packet."""
    factory_port: int
    bit_ns: float = 10.0  # of the sensor's Ethernet

    def __init__(
        self, profile: LidarProfile, beams: LidarBeams | None, sequences_per_block: int, layout: NDArray[np.int64]
    ) -> None:
        self.profile, self.layout = profile, layout
        count = profile.lasers
        elevation = profile.elevation_deg if beams is None else beams.elevation_deg
        azimuth = (profile.azimuth_deg or (0.0,) * count) if beams is None else beams.azimuth_deg
        self.elevation_rad = np.radians(np.array(elevation, dtype=np.float64))
        self.azimuth_offset_rad = np.radians(np.array(azimuth, dtype=np.float64))
        vertical_offset_m = 1e-3 * np.array(profile.vertical_offset_mm or (0.0,) * count, dtype=np.float64)
        delay_ns = np.array(profile.firing_ns)
        laser = np.tile(np.arange(count), sequences_per_block)
        sequence = np.repeat(np.arange(sequences_per_block), count)
        self.pulses = np.zeros((len(laser), columns.PULSE_COLUMNS))
        self.pulses[:, columns.COS_ELEVATION] = np.cos(self.elevation_rad)[laser]
        self.pulses[:, columns.SIN_ELEVATION] = np.sin(self.elevation_rad)[laser]
        self.pulses[:, columns.Z_OFFSET_M] = vertical_offset_m[laser]
        self.pulses[:, columns.AZIMUTH_OFFSET_RAD] = self.azimuth_offset_rad[laser]
        self.pulses[:, columns.DELAY_NS] = sequence * profile.sequence_ns + delay_ns[laser]
        if profile.turns_while_firing:
            self.pulses[:, columns.TURN_NS] = self.pulses[:, columns.DELAY_NS]
        self.pulses[:, columns.LASER] = laser
        self.scales = np.array([1e-3 * profile.range_unit_mm, 0.0, 0.0])
        second = layout[columns.SECOND_RANGE_IN_ENTRY] >= 0
        self.max_rows = int(layout[columns.BLOCKS]) * len(self.pulses) * (2 if second else 1)
        """Most rows of a packet."""

    def is_data(self, data: bytes) -> bool:
        """Whether a payload has the length of a data packet."""
        return len(data) == self.packet_bytes

    @abstractmethod
    def reject_reason(self, data: bytes) -> PacketRejectReason | None:
        """Why a payload is not a data packet of this model, by its fixed bytes; None: it is one."""

    @abstractmethod
    def timestamp_us(self, data: bytes) -> int:
        """Microseconds after the hour when the packet's first laser fired; of an accepted packet."""

    @abstractmethod
    def duration_ns(self, data: bytes) -> int:
        """Duration of a packet's pulses [ns]."""

    @abstractmethod
    def return_mode(self, data: bytes) -> str:
        """strongest, last, dual, or the mode byte."""

    def other_model(self, data: bytes) -> str | None:
        """Name of the other sensor that sent a rejected packet; None: unknown."""
        del data
        return None

    def first_pulse_ns(self, arrival_ns: int, data: bytes) -> int:
        """When the first laser of a packet fired [ns]: arrival - duration of its pulses - transmission time.

        A packet leaves when its last firing sequence is over. The result is late by the delay in the sensor and in the
        host's network stack (tens to hundreds of microseconds). Other payloads keep their arrival time.
        """
        if not self.is_data(data):
            return arrival_ns
        return arrival_ns - self.duration_ns(data) - round(8 * self.bit_ns * (len(data) + FRAME_BYTES))


MODES = {STRONGEST: "strongest", LAST: "last", DUAL: "dual"}
MODE_NAMES = tuple(MODES.get(mode, f"0x{mode:02X}") for mode in range(256))


def block_layout(
    blocks: int,
    first_block_at: int,
    azimuth_in_block: int,
    entry_bytes: int,
    pulses: int,
    block_ns: int,
    spin_hz: float,
) -> NDArray[np.int64]:
    """Layout of blocks with an azimuth in 0.01 deg before entries of range u16 and reflectivity u8.

    Its largest step is the furthest that the head turns in a block's time, with half as much to spare.
    """
    turn = 36_000
    layout = np.full(columns.LAYOUT, -1, dtype=np.int64)
    layout[columns.BLOCKS] = blocks
    layout[columns.FIRST_BLOCK_AT] = first_block_at
    layout[columns.BLOCK_BYTES] = azimuth_in_block + 2 + entry_bytes * pulses
    layout[columns.AZIMUTH_IN_BLOCK] = azimuth_in_block
    layout[columns.AZIMUTH_TURN] = turn
    layout[columns.MAX_STEP] = int(1.5 * spin_hz * turn * block_ns * 1e-9)
    layout[columns.BLOCK_NS] = block_ns
    layout[columns.FIRST_ENTRY_IN_BLOCK] = azimuth_in_block + 2
    layout[columns.ENTRY_BYTES] = entry_bytes
    layout[columns.RANGE_BYTES] = 2
    layout[columns.RANGE_MASK] = 0xFFFF
    layout[columns.REFLECTIVITY_AFTER_RANGE] = 2
    return layout
