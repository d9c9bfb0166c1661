"""The vehicle's own odometry, if it has one: recorded or UDP poses to VehicleMotion.

Source: recording format in recordings/README.md (/vehicle/odometry).
"""

from links.vehicle_odometry.odometry import VehicleOdometry

__all__ = ["VehicleOdometry"]
