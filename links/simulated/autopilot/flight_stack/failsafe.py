"""EKF failsafe and arming checks of ArduCopter, and PX4's position failsafe.

    ArduCopter  at 10 Hz: fails while two of velocity, position and yaw variances exceed FS_EKF_THRESH (velocity counts
                twice above double), or there is no position; after 8 failures in a row the yaw is reset, after 9 lanes
                may switch, after 10 it lands without position
    PX4         the position is invalid EKF2_NOAID_TOUT after the last aiding: it descends

Source: ArduPilot ArduCopter/ekf_check.cpp, AP_Arming.cpp (visodom_checks), AP_VisualOdom.cpp (pre_arm_check),
ArduCopter/AP_Arming_Copter.cpp (mandatory_gps_checks: "waiting for home"); PX4 ekf2 and commander.
"""

from __future__ import annotations

import enum
import math

from links.simulated.autopilot.flight_stack.estimation.ekf3 import Ekf3
from links.simulated.autopilot.flight_stack.estimation.source_rules import (
    EKF_CHECK_ITERATIONS,
    FS_EKF_THRESH,
    AidingSource,
)


class EkfAction(enum.Enum):
    """What a failed check requires."""

    YAW_RESET = enum.auto()
    LANE_SWITCH = enum.auto()
    FAILSAFE = enum.auto()


class EkfCheck:
    """Copter::ekf_check. Call `update` at 10 Hz while armed."""

    def __init__(self) -> None:
        self.fails = 0
        self.failed = False

    def update(self, ekf: Ekf3) -> EkfAction | None:
        """One check; what is to be done now, None: nothing."""
        if not ekf.origin:
            return None
        if over_threshold(ekf) or not ekf.has_position:
            if self.failed:
                return None
            self.fails += 1
            if self.fails == EKF_CHECK_ITERATIONS - 2 and over_threshold(ekf):
                return EkfAction.YAW_RESET
            if self.fails == EKF_CHECK_ITERATIONS - 1:
                return EkfAction.LANE_SWITCH
            if self.fails >= EKF_CHECK_ITERATIONS:
                self.failed = True
                return EkfAction.FAILSAFE
        elif self.fails > 0:
            self.fails -= 1
            if self.fails == 0:
                self.failed = False
        return None


def over_threshold(ekf: Ekf3) -> bool:
    """Copter::ekf_over_threshold on the roots of the test ratios."""
    status = ekf.status
    yaw, velocity, position = (math.sqrt(max(v, 0.0)) for v in (status.yaw, status.velocity, status.position))
    over = int(yaw >= FS_EKF_THRESH)
    over += 2 if velocity >= 2 * FS_EKF_THRESH else int(velocity >= FS_EKF_THRESH)
    return over >= 2 or (position >= FS_EKF_THRESH and over >= 1)


def arming_refusal(ekf: Ekf3, external_healthy: bool, uses_external: bool) -> str | None:
    """Why it does not arm, as the text of its pre-arm check; None: it arms.

    uses_external: VISO_TYPE is set, because a source set uses external poses.
    """
    if uses_external and not external_healthy:
        return "PreArm: VisOdom: not healthy"
    if not ekf.yaw_aligned:
        return "PreArm: AHRS: EKF3 Yaw inconsistent"
    if not ekf.has_position:
        needs = "GPS" if ekf.sources.position is AidingSource.GPS else "Position Estimate"
        return f"PreArm: Need {needs}"
    if not ekf.origin:
        return "PreArm: AHRS: waiting for home"
    return None
