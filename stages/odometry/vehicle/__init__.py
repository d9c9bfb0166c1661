"""P V.B: how the vehicle moved, from its camera, with the LiDAR's metres; or as its own odometry tells."""

from stages.odometry.vehicle.source_selection import VehicleMotionChoice as VehicleMotionChoice
from stages.odometry.vehicle.visual_lidar_odometry import VehicleEgo as VehicleEgo
