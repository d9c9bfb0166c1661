"""Compiled functions for sweeps."""
