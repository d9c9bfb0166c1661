"""Arbitration between the yaw by vanishing points (a RESOLVED RelativeRotation) and by the drone's own motion.

A pose with a yaw error of 90 deg crashes the drone that uses it, so a contradiction withdraws the yaw:

    both differ by more than 4 sigma and 5 deg     neither is used until they agree again, or no rotation by vanishing
                                                   points has come for 30 s
    the branch of the vanishing points switched    they are not used for 2 s, unless motion agrees
    that branch is no longer RESOLVED              a yaw from vanishing points is dropped unless motion agreed

Source: ours; DESIGN: "never send an unresolved branch".
"""

from __future__ import annotations

import math

from stages.heading.yaw_fit import Yaw, apart_rad

SLACK_RAD = math.radians(5.0)
CLEAR, ALIKE = 4.0, 3.0  # sigmas
MOTION_NS = 5_000_000_000  # a yaw by motion is compared for this long
VP_ROTATION_NS = 1_000_000_000
SETTLE_NS = 2_000_000_000
FORGET_NS = 30_000_000_000


class Heading:
    """Keeps the newest yaw of R_map_odom by each source and compares them."""

    def __init__(self) -> None:
        self._motion: Yaw | None = None
        self._vp_yaw: Yaw | None = None
        self._resolved_ns: int | None = None
        self._switches: int | None = None
        self._switched_ns: int | None = None
        self.contradiction = ""

    def add_motion_yaw(self, yaw: Yaw) -> None:
        """Add a yaw by motion."""
        self._motion = yaw
        self._compare(yaw.stamp_ns)

    def add_vp_rotation(self, stamp_ns: int, switches: int, yaw_rad: float | None, sigma_rad: float) -> bool:
        """Add a RESOLVED yaw by vanishing points; None: no attitude. Returns whether it is accepted."""
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
        """Whether a recent yaw by motion agrees within ALIKE sigmas and SLACK_RAD."""
        m = self._fresh_motion(stamp_ns)
        return m is not None and apart_rad(m.yaw_rad, yaw_rad) <= ALIKE * math.hypot(m.sigma_rad, sigma_rad) + SLACK_RAD

    def denies(self, stamp_ns: int, yaw_rad: float, sigma_rad: float) -> bool:
        """Whether a recent yaw by motion differs by more than CLEAR sigmas and SLACK_RAD."""
        m = self._fresh_motion(stamp_ns)
        return m is not None and apart_rad(m.yaw_rad, yaw_rad) > CLEAR * math.hypot(m.sigma_rad, sigma_rad) + SLACK_RAD

    def contradict(self, why: str, resolved_ns: int | None = None) -> None:
        """Set a contradiction that the caller found; `resolved_ns`: time of the rotation by vanishing points."""
        self.contradiction = why
        self._resolved_ns = self._resolved_ns if resolved_ns is None else resolved_ns

    def pass_time(self, now_ns: int) -> None:
        """A contradiction ends when no rotation by vanishing points has come for FORGET_NS."""
        if self.contradiction and (self._resolved_ns is None or now_ns - self._resolved_ns > FORGET_NS):
            self.contradiction, self._vp_yaw = "", None

    def forget_motion(self) -> None:
        """Drop the yaw by motion: it was of another frame or another drone."""
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
            self.contradiction = f"headings by vanishing points and by the drone's motion differ by {off:.0f} deg"
        elif self.contradiction and self.agrees(stamp_ns, yaw_rad, sigma_rad):
            self.contradiction = ""
