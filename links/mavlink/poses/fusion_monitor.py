"""Whether the autopilot's EKF rejects the pose that it is sent, by its own status messages.

EKF_STATUS_REPORT (ArduPilot) and ESTIMATOR_STATUS have the innovation test ratio of the horizontal position: above 1 it
is rejected. Neither says which source is meant, so the ratio counts only while poses are sent, and not

    while ArduPilot is known to use another source set than grd's: it is that of GPS
    above 1 while a GPS glitch is reported. ArduPilot reports one only while it uses GPS; that of PX4 is the larger one
        of GPS and grd. PX4 may keep the flag after it has stopped GPS; a rejection is then not seen. PX4 1.14 and 1.15
        set it only while the compass is rejected, too: `report` is better there with GPS

On grd's set the ratio of the compass is the larger one of the yaw that grd sends and of the compass before the switch,
which is kept. ArduPilot rejects a wrong yaw for the rest of the flight, also after a reset, which is one of the
position: grd's positions are then in other axes than the EKF's yaw.

The stream is not useful then, and a reset to a pose that contradicts the autopilot's own sensors may be wrong.
`on_rejection` chooses what happens:

    stop     no poses until the ratio was small, or NaN (nothing is fused), for RESUME_AFTER_NS (default): below
             RESUME_BELOW, or below 1 if the set in use is not known. ArduPilot repeats the last ratio while it fuses no
             position: only a change to set 1 ends it
    reset    the reset counter changes, so that the EKF takes the position; after MAX_RESETS in a row, and for a yaw, as
             `stop`
    report   only a text and a counter

MAX_REJECTED_NS is shorter than the second after which the EKF failsafe acts. ArduPilot's position times out 7 s after
the last fused pose: within RESUME_AFTER_NS it is known whether a position is accepted again; a reset that holds for
RESETS_FORGOTTEN_NS was right.

Source: ours; ArduPilot NavEKF3_core::send_status_report (square roots of ratios), FuseVelPosNED (posTestRatio),
fuseEulerYaw (yawTestRatio), getFilterStatus (gps_glitching), ekf_check.cpp (FS_EKF_THRESH 0.8 for 1 s),
posRetryTimeNoVel_ms; PX4 Ekf::get_innovation_test_status; https://mavlink.io/en/messages/common.html#ESTIMATOR_STATUS.
"""

from __future__ import annotations

import math
from typing import Any, Literal

OnRejection = Literal["stop", "reset", "report"]

REJECTS_POSITION, REJECTS_YAW = "autopilot rejects the position", "autopilot rejects the yaw"
MAX_REJECTED_NS = 600_000_000  # ratio above 1 for so long, before ArduPilot's failsafe of 1 s
RESUME_BELOW, RESUME_AFTER_NS = 0.5, 3_000_000_000  # half the innovation that the gate allows, as preflight warns of
MAX_RESETS = 3
RESETS_FORGOTTEN_NS = 5_000_000_000  # without rejection, after which resets are counted again from zero
GPS_GLITCH = {"EKF_STATUS_REPORT": 1 << 15, "ESTIMATOR_STATUS": 1 << 10}  # EKF_GPS_GLITCHING, ESTIMATOR_GPS_GLITCH
MAX_STATUS_GAP_NS = 2_000_000_000  # between two status messages: no statement in between


class FusionMonitor:
    """Evaluates status messages in order."""

    def __init__(self, on_rejection: OnRejection) -> None:
        self.rejections = 0
        """How often a rejection began."""
        self.stopped = False
        """Whether no pose may be sent."""
        self._action: OnRejection = on_rejection
        self._resets = 0
        self._above_ns: int | None = None  # since when the ratio is above 1
        self._below_ns: int | None = None  # since when it is below RESUME_BELOW
        self._newest_ns: int | None = None
        self._rejected_ns: int | None = None
        self._kept_ratio = math.inf  # bound of the ratio that the compass had before the autopilot used grd's set

    def add(
        self, message: Any, sending: bool, now_ns: int, uses_grd: bool | None = None, sends_yaw: bool = False
    ) -> tuple[str, bool] | None:
        """Add a status message. (text, whether to change the reset counter) when a rejection begins.

        `uses_grd`: whether ArduPilot uses the source set of grd; None: not known.
        """
        if message.get_type() not in GPS_GLITCH:
            return None
        ratio, of_yaw = _ratio(message) if uses_grd is not False else math.nan, False
        if not uses_grd:
            self._kept_ratio = math.inf
        yaw_ratio = self._yaw_ratio(message) if uses_grd and sends_yaw else None
        if yaw_ratio is not None and yaw_ratio > max(1.0, ratio or 0.0):
            ratio, of_yaw = yaw_ratio, True
        if ratio is None or (math.isnan(ratio) and not self.stopped):
            self._above_ns = self._below_ns = None
            return None
        if self._newest_ns is None or now_ns - self._newest_ns > MAX_STATUS_GAP_NS:
            self._above_ns = self._below_ns = None
        self._newest_ns = now_ns
        self._above_ns = (self._above_ns or now_ns) if ratio > 1 and (sending or self.stopped) else None
        accepted = ratio < (1.0 if uses_grd is None else RESUME_BELOW) or math.isnan(ratio)
        self._below_ns = (self._below_ns or now_ns) if accepted else None
        if self.stopped and self._below_ns is not None and now_ns - self._below_ns >= RESUME_AFTER_NS:
            self.stopped = False
        if self.stopped or self._above_ns is None or now_ns - self._above_ns < MAX_REJECTED_NS:
            return None
        return self._reject(ratio, of_yaw, now_ns)

    def _yaw_ratio(self, message: Any) -> float | None:
        """Test ratio of the yaw if it is above that of the compass at the switch to grd's set; None: not known."""
        if message.get_type() != "EKF_STATUS_REPORT":
            return None
        ratio = float(message.compass_variance)
        self._kept_ratio = min(self._kept_ratio, ratio)
        return ratio if ratio > self._kept_ratio else None

    def on_boot(self) -> None:
        """The autopilot has booted."""
        self.stopped, self._resets = False, 0
        self._kept_ratio = math.inf
        self._above_ns = self._below_ns = self._newest_ns = self._rejected_ns = None

    def _reject(self, ratio: float, of_yaw: bool, now_ns: int) -> tuple[str, bool]:
        settled = self._rejected_ns is None or now_ns - self._rejected_ns > RESETS_FORGOTTEN_NS
        self._resets = 0 if settled else self._resets
        self.rejections += 1
        self._rejected_ns, self._above_ns = now_ns, None
        reset = self._action == "reset" and self._resets < MAX_RESETS and not of_yaw
        self._resets += reset
        self.stopped = self._action != "report" and not reset
        return f"{REJECTS_YAW if of_yaw else REJECTS_POSITION} ({ratio:.1f})", reset


def _ratio(message: Any) -> float | None:
    """Test ratio of the horizontal position, 1 at the gate; NaN: nothing is fused; None: it is that of GPS."""
    kind = message.get_type()
    ratio = float(message.pos_horiz_variance if kind == "EKF_STATUS_REPORT" else message.pos_horiz_ratio)
    return None if message.flags & GPS_GLITCH[kind] and ratio > 1 else ratio
