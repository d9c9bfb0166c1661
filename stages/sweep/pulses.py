"""Functions of a slice of pulses that several stages use.

Source: ours.
"""

from __future__ import annotations

from stages.messages import SweptPulses


def middle_ns(pulses: SweptPulses) -> int:
    """Firing time of the middle pulse: the vehicle's pose at that time is used for the whole slice."""
    return int(pulses.point_stamp_ns[pulses.point_stamp_ns.size // 2])
