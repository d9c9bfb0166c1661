"""Fusion of LiDAR positions, rotations and odometry into one pose of the drone."""

from stages.fuse.fuse import Fuse
from stages.fuse.inertial.fuse import InertialFuse

__all__ = ["Fuse", "InertialFuse"]
