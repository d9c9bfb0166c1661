"""MAVLink: what the drone's autopilot says. Sending poses to it is not built yet."""

from links.mavlink.autopilot import Autopilot

__all__ = ["Autopilot"]
