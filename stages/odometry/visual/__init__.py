"""Visual odometry of one fisheye camera: feature tracking, and the motion between two images."""
