"""Conversion of LiDAR packets and servo angles to points in the vehicle frame. P III.A."""

from stages.sweep.sweep import Sweep as Sweep
