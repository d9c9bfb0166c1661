"""Cues by UDP: GNSS of the vehicle (JSON or NMEA), GNSS of the drone (Remote ID), UWB ranges.

Source: recording format in recordings/README.md (/cues).
"""

from links.cues.cues import Cues

__all__ = ["Cues"]
