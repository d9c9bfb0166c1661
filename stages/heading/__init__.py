"""Yaw of the drone's body: a bank of hypotheses by raw IMU, LiDAR positions, vanishing points and odometry.

`fuse` uses it until the heading is decided. `align` weighs its yaw branches by displacements (hypothesis_bank.py).
"""
