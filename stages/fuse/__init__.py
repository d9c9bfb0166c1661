"""Fusion of LiDAR positions, rotations and odometry into one pose of the drone."""

from stages.fuse.fuse import Fuse

__all__ = ["Fuse"]
