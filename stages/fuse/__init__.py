"""Fusion of LiDAR positions, IMU and rotations by cameras into one pose of the drone."""

from stages.fuse.fuse import Fuse as Fuse
