"""P V.B: how the vehicle moved, from its camera, with the LiDAR's metres; or as its own odometry tells."""

from stages.odometry.vehicle.source_selection import VehicleMotionSelector as VehicleMotionSelector
from stages.odometry.vehicle.visual_lidar_odometry import VisualLidarOdometry as VisualLidarOdometry
