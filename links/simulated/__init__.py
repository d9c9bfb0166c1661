"""A simulated world and sensors that give the same bytes as the hardware.

Source: ours.
"""

from links.simulated.rig.live_rig import LiveRig

__all__ = ["LiveRig"]
