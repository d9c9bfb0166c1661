"""Compiled functions for rotations, trajectories and lenses."""
