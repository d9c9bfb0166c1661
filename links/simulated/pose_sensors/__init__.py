"""Sensors that measure position and rotation of the drone, in place of LiDAR and cameras, and links that read them."""
