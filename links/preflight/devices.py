"""The list of LinkChecks that a preflight applies. A new driver with checks of its own is added here."""

from __future__ import annotations

from flow.link import Link
from links.camera.checks import CameraChecks
from links.clock.checks import ClockChecks
from links.cues.checks import CuesChecks
from links.dynamixel.checks import ServoChecks
from links.lidar.checks import LidarChecks
from links.mavlink.checks import AutopilotChecks
from links.preflight.link_checks import LinkChecks
from links.recording.checks import RecorderChecks
from links.vehicle_odometry.checks import VehicleOdometryChecks
from links.zenoh.checks import ReceiverChecks, SenderChecks

DEVICES: tuple[LinkChecks, ...] = (
    LidarChecks(),
    ServoChecks(),
    CameraChecks(),
    AutopilotChecks(),
    VehicleOdometryChecks(),
    CuesChecks(),
    ClockChecks(),
    ReceiverChecks(),
    SenderChecks(),
    RecorderChecks(),
)
_UNKNOWN = LinkChecks()


def checks_for(link: Link) -> LinkChecks:
    """The checks of a link's class."""
    return next((checks for checks in DEVICES if isinstance(link, checks.link_class)), _UNKNOWN)
