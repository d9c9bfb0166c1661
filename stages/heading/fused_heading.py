"""Whose word on the yaw is believed: the streets' (RelativeRotation, RESOLVED) or the drone's own motion's.

A pose 90 deg wrong crashes a drone that believes it, so doubt wins:

    both tell, and differ by more than 4 sigma and 5 deg    neither is believed until they agree again, or the streets
                                                            have not been told for 30 s
    the streets' branch was switched                        they are not believed for 2 s, unless motion agrees
    the streets' branch is no longer RESOLVED               what came from them is not believed unless motion agreed

Source: ours; DESIGN: "never send an unresolved branch".
"""

from __future__ import annotations

import math

from stages.heading.yaw_fit import Yaw, apart_rad

SLACK_RAD = math.radians(5.0)
CLEAR, ALIKE = 4.0, 3.0  # sigmas
MOTION_NS = 5_000_000_000  # a yaw by motion serves as a witness for this long
VP_ROTATION_NS = 1_000_000_000
SETTLE_NS = 2_000_000_000
FORGET_NS = 30_000_000_000


class Heading:
    """Remembers what both said of the yaw of R_map_odom, and judges."""

    def __init__(self) -> None:
        self._motion: Yaw | None = None
        self._vp_yaw: Yaw | None = None
        self._resolved_ns: int | None = None
        self._switches: int | None = None
        self._switched_ns: int | None = None
        self.contradiction = ""

    def add_motion_yaw(self, yaw: Yaw) -> None:
        """Motion's word."""
        self._motion = yaw
        self._compare(yaw.stamp_ns)

    def add_vp_rotation(self, stamp_ns: int, switches: int, yaw_rad: float | None, sigma_rad: float) -> bool:
        """The streets' word, RESOLVED; yaw None: the autopilot's attitude is not known. Whether it is believed."""
        if self._switches is not None and switches != self._switches:
            self._switched_ns = stamp_ns
        self._switches, self._resolved_ns = switches, stamp_ns
        if yaw_rad is not None:
            self._vp_yaw = Yaw(stamp_ns, yaw_rad, sigma_rad**2)
            self._compare(stamp_ns)
        if self.contradiction:
            return False
        settled = self._switched_ns is None or stamp_ns - self._switched_ns >= SETTLE_NS
        return settled or (yaw_rad is not None and self.agrees(stamp_ns, yaw_rad, sigma_rad))

    def switched(self, switches: int) -> bool:
        """Whether a rotation comes from another branch than those before."""
        return self._switches is not None and switches != self._switches

    def agrees(self, stamp_ns: int, yaw_rad: float, sigma_rad: float) -> bool:
        """Whether motion, lately, told the same yaw."""
        m = self._fresh_motion(stamp_ns)
        return m is not None and apart_rad(m.yaw_rad, yaw_rad) <= ALIKE * math.hypot(m.sigma_rad, sigma_rad) + SLACK_RAD

    def denies(self, stamp_ns: int, yaw_rad: float, sigma_rad: float) -> bool:
        """Whether motion, lately, told clearly another yaw."""
        m = self._fresh_motion(stamp_ns)
        return m is not None and apart_rad(m.yaw_rad, yaw_rad) > CLEAR * math.hypot(m.sigma_rad, sigma_rad) + SLACK_RAD

    def contradict(self, why: str, resolved_ns: int | None = None) -> None:
        """Found out elsewhere that they differ; `resolved_ns`: by what the streets told then."""
        self.contradiction = why
        self._resolved_ns = self._resolved_ns if resolved_ns is None else resolved_ns

    def pass_time(self, now_ns: int) -> None:
        """A contradiction is over when one side has been silent for long."""
        if self.contradiction and (self._resolved_ns is None or now_ns - self._resolved_ns > FORGET_NS):
            self.contradiction, self._vp_yaw = "", None

    def forget_motion(self) -> None:
        """Motion's word was about another frame or another drone."""
        self._motion = None

    def _fresh_motion(self, stamp_ns: int) -> Yaw | None:
        m = self._motion
        return m if m is not None and abs(stamp_ns - m.stamp_ns) <= MOTION_NS else None

    def _compare(self, stamp_ns: int) -> None:
        if self._vp_yaw is None or stamp_ns - self._vp_yaw.stamp_ns > VP_ROTATION_NS:
            return
        yaw_rad, sigma_rad = self._vp_yaw.yaw_rad, self._vp_yaw.sigma_rad
        if self.denies(stamp_ns, yaw_rad, sigma_rad):
            assert self._motion is not None
            off = math.degrees(apart_rad(self._motion.yaw_rad, yaw_rad))
            self.contradiction = f"the streets and the drone's motion tell headings {off:.0f} deg apart"
        elif self.contradiction and self.agrees(stamp_ns, yaw_rad, sigma_rad):
            self.contradiction = ""
