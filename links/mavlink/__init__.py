"""MAVLink: messages from the drone's autopilot, and poses sent to it."""

from links.mavlink.autopilot import Autopilot

__all__ = ["Autopilot"]
