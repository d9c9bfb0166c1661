"""P V.E: how the drone moved, from its camera."""

from stages.odometry.drone.fisheye_odometry import FisheyeOdometry as FisheyeOdometry
