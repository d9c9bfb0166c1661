"""Motion of the drone, from its camera and its autopilot. P V.E."""

from stages.odometry.drone.fisheye_odometry import FisheyeOdometry as FisheyeOdometry
from stages.odometry.drone.inertial_motion import InertialMotion as InertialMotion
