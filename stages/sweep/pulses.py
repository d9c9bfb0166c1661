"""What several stages ask of a slice's pulses.

Source: ours.
"""

from __future__ import annotations

from stages.messages import SweptPulses


def middle_ns(pulses: SweptPulses) -> int:
    """When the middle one of a slice's pulses left: the vehicle's pose then is the slice's."""
    return int(pulses.point_stamp_ns[pulses.point_stamp_ns.size // 2])
