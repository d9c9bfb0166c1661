"""Fusion: one pose from everything that tells of the drone."""

from stages.fuse.fuse import EkfFuse, Fuse

__all__ = ["EkfFuse", "Fuse"]
