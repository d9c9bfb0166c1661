"""Velodyne VLP-16: packets from UDP or a recording -> LidarFirings."""

from links.velodyne.flown import flown_lidars
from links.velodyne.lidar import Lidar
from links.velodyne.position import parse_position

__all__ = ["Lidar", "flown_lidars", "parse_position"]
