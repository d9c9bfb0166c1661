"""Compiled functions for drone tracking."""
