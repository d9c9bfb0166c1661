"""Frame that poses are sent in: that of the autopilot's own position when the first pose was sent.

    p_sent = Rz(yaw)^T p_map + offset,   R_sent_drone = Rz(yaw)^T R_map_drone

The autopilot takes its position from grd when it changes over, and resets to it. In this frame the reset is small:
home, fences, and targets of Guided, RTL and missions, which it keeps in global coordinates, stay where they are over
ground. The frame stays while `map` does, so that the drone returns to its place after a gap. It begins again

    at the autopilot's boot
    with the autopilot's first position, if it had none before: until then the origin is that of `map`
    where `map` has begun again, if the pose is then more than FAR_M from the autopilot's own position, or its axes are
    turned by more than WRONG_COMPASS_RAD: it is another one

The autopilot's position may contain poses of before. It chooses the frame, and measures nothing.

Without yaw the axes may be learnt again where the pose jumps; they turn about the drone.

Source: ours; ArduPilot NavEKF3_core::CorrectExtNavForSensorOffset, ResetPositionNE, ModeRTL::compute_return_target,
ModeGuided::pos_control_run (targets that do not move with a reset); PX4 Ekf::updateEvPosFusion (reset to external
vision when GPS stops), FlightTaskAuto.
"""

from __future__ import annotations

from dataclasses import dataclass

from stages.geometry.frames import Array64, rotation_z

FAR_M = 10.0  # from the autopilot's own position: more than that drifts while the vehicle's motion is unknown (assumed)
ECHO_M = 3.0  # an own position that comes later and is nearer may be our own poses, late (assumed)


@dataclass(frozen=True, slots=True)
class SentFrame:
    """A frame, z up."""

    yaw_rad: float
    """Yaw of its x axis in `map`."""
    offset_m: Array64
    """Origin of `map` in it (3,)."""
    anchored: bool = True
    """Whether its origin is by the autopilot's own position."""
    map_number: int = 0
    """`RelativePose.map_number` of the newest `map` for which it holds."""

    @property
    def R_sent_map(self) -> Array64:
        """Rotation (3, 3) from `map`."""
        return rotation_z(-self.yaw_rad)

    def position(self, xyz_map_m: Array64) -> Array64:
        """A position (3,) of `map` in this frame [m]."""
        return self.R_sent_map @ xyz_map_m + self.offset_m

    @classmethod
    def through(cls, yaw_rad: float, xyz_map_m: Array64, xyz_sent_m: Array64) -> SentFrame:
        """Axes with this yaw in which a position (3,) of `map` has these coordinates (3,)."""
        return cls(yaw_rad, xyz_sent_m - rotation_z(-yaw_rad) @ xyz_map_m)
