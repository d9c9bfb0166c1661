"""ROS: bags to recordings, recordings and runs to ROS 2 bags; needs the extra `ros` (the package rosbags)."""

from links.ros.mapping import BagMapping, TopicUse

__all__ = ["BagMapping", "TopicUse"]
