"""Why a packet was refused: the words that counters and errors use.

Source: ours.
"""

from __future__ import annotations

import enum


class RejectReason(enum.Enum):
    """One reason to ignore a packet."""

    LENGTH = "not 1206 bytes long"
    POSITION = "a position packet (512 bytes; they belong on UDP 8308)"
    MODEL = "not the VLP-16's product id"
    RETURN_MODE = "an unknown return mode"
    FLAG = "a data block without the flag 0xEEFF"
    AZIMUTH = "azimuths beyond 360 deg or jumping (is the field of view cut in the sensor's settings?)"
    TIMESTAMP = "a time of an hour or more after the hour"
    ORDER = "a duplicate or out of order"
    CLOCK = "sensor time far from the host's (clock: utc needs both locked to UTC; else set clock: free)"
