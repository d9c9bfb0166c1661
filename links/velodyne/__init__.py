"""Velodyne VLP-16: packets from UDP or a recording -> LidarFirings."""

from links.velodyne.lidar import Lidar
from links.velodyne.position import parse_position

__all__ = ["Lidar", "parse_position"]
