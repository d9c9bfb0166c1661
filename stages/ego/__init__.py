"""P V.B: how the vehicle moved, from its camera, with the LiDAR's metres; or as its own odometry tells."""

from stages.ego.motion_choice import VehicleMotionChoice as VehicleMotionChoice
from stages.ego.vehicle_ego import VehicleEgo as VehicleEgo
