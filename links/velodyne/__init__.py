"""Velodyne VLP-16: UDP or recorded packets to LidarFirings."""

from links.velodyne.lidar import Lidar
from links.velodyne.position import parse_position
from links.velodyne.recorded_rig import recorded_lidars

__all__ = ["Lidar", "parse_position", "recorded_lidars"]
