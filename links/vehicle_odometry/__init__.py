"""The vehicle's own odometry, where it has one: recorded poses to vehicle motion.

Source: ours; recording format in recordings/README.md (/vehicle/odometry).
"""

from links.vehicle_odometry.odometry import VehicleOdometry

__all__ = ["VehicleOdometry"]
