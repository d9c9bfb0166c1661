"""The turntable's servo, a DYNAMIXEL MX-28AR: states in, goals out; live through a process of its own.

Source: ours; recording format in recordings/README.md (/servo/state).
"""

from links.dynamixel.servo import Servo

__all__ = ["Servo"]
