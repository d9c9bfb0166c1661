"""MAVLink: what the drone's autopilot says, and the poses it is told."""

from links.mavlink.autopilot import Autopilot

__all__ = ["Autopilot"]
