"""The turntable's servo, a DYNAMIXEL MX-28AR: states in, goals out; live in a separate process.

Source: recording format in recordings/README.md (/servo/state).
"""

from links.dynamixel.servo import Servo

__all__ = ["Servo"]
