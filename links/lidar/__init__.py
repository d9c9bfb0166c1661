"""Spinning LiDARs: UDP or recorded packets to LidarFirings."""

from links.lidar.beam_files import hesai_beams, ouster_beams, rig_unit
from links.lidar.formats import AnyFormat, packet_format, recognised_model
from links.lidar.lidar import Lidar
from links.lidar.position import parse_position
from links.lidar.recorded_rig import recorded_lidars

__all__ = [
    "AnyFormat",
    "Lidar",
    "hesai_beams",
    "ouster_beams",
    "packet_format",
    "parse_position",
    "recognised_model",
    "recorded_lidars",
    "rig_unit",
]
