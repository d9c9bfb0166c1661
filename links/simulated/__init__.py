"""Simulator of the rig: world, sensors, servo and autopilot. It produces the bytes that the hardware sends.

Source: ours.
"""

from links.simulated.pose_sensors.pose_source import SimulatedFixes, SimulatedRotations
from links.simulated.rig.live_rig import LiveRig

__all__ = ["LiveRig", "SimulatedFixes", "SimulatedRotations"]
