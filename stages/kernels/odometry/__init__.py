"""Compiled functions for vehicle odometry."""
