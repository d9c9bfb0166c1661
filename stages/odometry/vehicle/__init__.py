"""Motion of the vehicle, from its camera with metric scale by the LiDAR, or from its own odometry. P V.B."""

from stages.odometry.vehicle.source_selection import VehicleMotionSelector as VehicleMotionSelector
from stages.odometry.vehicle.visual_lidar_odometry import VisualLidarOdometry as VisualLidarOdometry
