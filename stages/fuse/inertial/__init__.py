"""Fusion by IMU: a bank of yaw hypotheses until the heading is decided, then a fixed-lag smoother."""
