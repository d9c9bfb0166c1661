"""Compiled functions for LiDAR packets."""
