"""P V.B: how the vehicle moved, from its camera, with the LiDAR's metres."""

from stages.ego.vehicle_ego import VehicleEgo as VehicleEgo
