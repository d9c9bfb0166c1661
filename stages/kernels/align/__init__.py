"""Compiled functions for camera alignment."""
