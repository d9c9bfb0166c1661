"""Why a LiDAR packet is rejected.

Source: ours.
"""

from __future__ import annotations

import enum

HOUR_US = 3_600_000_000


class PacketRejectReason(enum.Enum):
    """Reason to ignore a packet; the value is the text in counters and errors."""

    LENGTH = "of another length than the model's data packets"
    POSITION = "a position packet (512 bytes, expected on UDP 8308)"
    MODEL = "not the model's product id"
    UNIT = "of a sensor with another serial number"
    RETURN_MODE = "unknown return mode"
    FLAG = "a data block without its flag"
    AZIMUTH = "azimuths beyond 360 deg or jumping (is the field of view limited in the sensor's settings?)"
    EMPTY = "no valid column (is the sensor starting?)"
    TIMESTAMP = "time of one hour or more after the hour"
    ORDER = "duplicate or out of order"
    CLOCK = "sensor time far from the host's (clock: utc needs both locked to UTC; otherwise set clock: free)"
