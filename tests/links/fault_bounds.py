"""Bounds that must hold after each fault of `test_live_faults.py`; deploy/OPERATOR.md lists them.

They are generous: a loaded machine is several times slower than a free one. At 50 poses per second 750 fit between the
beginning of a fault and REST_S after its end (850 for faults of 5 s).
"""

from __future__ import annotations

from typing import NamedTuple

REST_S = 12.0  # pause after each fault; poses are counted until its end
MAX_RECORDING_LOSS_S = 0.5  # when grd is killed
KILLED = "kill -9, restarted"
FIRST_POSITION_S, FIRST_POSE_S = 30.0, 60.0  # from the kill to the first position, and to the first accepted pose


class FaultBounds(NamedTuple):
    """Limits for one fault."""

    back_s: float | None  # from its end to the first record of the failed source; None: no source fails
    silent_s: float  # longest time without an accepted pose, from its beginning until REST_S after its end
    poses: int  # minimum number of accepted poses in this time


BOUNDS = {
    "LiDAR disconnected 3 s": FaultBounds(5, 8, 300),
    "servo stalls 3 s": FaultBounds(5, 8, 300),
    "servo: 20 replies 50 ms late": FaultBounds(5, 8, 300),
    "servo: garbage before 300 replies": FaultBounds(5, 8, 300),
    "servo unplugged 3 s": FaultBounds(5, 8, 300),  # opened again after at most 1 s
    "servo without power 3 s": FaultBounds(5, 8, 300),
    "camera disconnected 3 s": FaultBounds(8, 5, 300),  # opened again after at most 5 s; poses do not need it
    "autopilot reboots, 3 s silent": FaultBounds(5, 13, 50),  # its yaw is estimated again
    "forged packets, 3 s": FaultBounds(None, 8, 200),
    "wall clock +1 h, then back": FaultBounds(None, 8, 200),
    "viewer stopped 5 s": FaultBounds(None, 8, 200),
    "disk full 5 s": FaultBounds(11, 5, 300),  # recording is tried again after 10 s
}
