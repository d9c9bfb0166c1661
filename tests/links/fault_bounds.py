"""What must hold after each fault of `test_live_faults.py`; deploy/OPERATOR.md says it to the crew.

Generous: a machine that others use, too, is several times slower than a free one. At 50 poses a second 750 fit between
a fault's beginning and REST_S after its end (850 for those of 5 s).
"""

from __future__ import annotations

from typing import NamedTuple

REST_S = 12.0  # after each fault; poses are counted until then
KEPT_S = 0.5  # of a recording is lost at most when grd is killed
KILLED = "kill -9, started again"
POSITION_AGAIN_S, POSES_AGAIN_S = 30.0, 60.0  # from the kill to the first position, and to the first pose given out


class Must(NamedTuple):
    """What a fault may cost."""

    back_s: float | None  # from its end to the first record of what had failed; None: nothing is silent
    silent_s: float  # the longest time without a pose given out, from its beginning until REST_S after its end
    poses: int  # given out meanwhile, at least


MUST = {
    "LiDAR cut 3 s": Must(5, 8, 300),
    "servo stalls 3 s": Must(5, 8, 300),
    "servo: 20 answers 50 ms late": Must(5, 8, 300),
    "servo: garbage before 300 answers": Must(5, 8, 300),
    "servo unplugged 3 s": Must(5, 8, 300),  # tried again after at most 1 s
    "servo: power fails 3 s": Must(5, 8, 300),
    "camera gone 3 s": Must(8, 5, 300),  # tried again after at most 5 s; poses do without
    "autopilot boots again, 3 s silent": Must(5, 13, 50),  # its heading has to be seen anew
    "forged packets, 3 s": Must(None, 8, 200),
    "wall clock +1 h, then back": Must(None, 8, 200),
    "viewer stands still 5 s": Must(None, 8, 200),
    "disk full 5 s": Must(11, 5, 300),  # tried again 10 s after it was full
}
