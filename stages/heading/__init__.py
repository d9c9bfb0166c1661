"""Yaw of the drone by its motion: yaw branches, or any heading, weighted by the displacements of LiDAR and odometry.

`align` uses it to publish a rotation, `fuse` to check one.
"""
