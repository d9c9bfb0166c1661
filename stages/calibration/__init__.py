"""Self-calibration: how the LiDAR sits on its servo, from surfaces seen more than once during a sweep."""

from stages.calibration.servo_clock import ServoClock as ServoClock
