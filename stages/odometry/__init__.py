"""P V.B and V.E: how the vehicle and the drone move, from their own odometry, their cameras and the LiDAR."""
