"""Compiled functions for image features and two-view geometry."""
