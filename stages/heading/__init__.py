"""Yaw of the drone by its motion: yaw branches, or any heading, weighed by displacements by LiDAR and by odometry.

`align`, which publishes a rotation, and `fuse`, which checks it, both use it.
"""
