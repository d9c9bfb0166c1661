"""Self-calibration of the LiDAR's mount on its servo, from surfaces observed more than once during a sweep."""

from stages.calibration.servo_clock import ServoClock as ServoClock
