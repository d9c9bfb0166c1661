"""Frames, rotations, rigid motions, trajectories and lenses: what every section of the method shares."""
