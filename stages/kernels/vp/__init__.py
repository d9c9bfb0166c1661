"""Compiled functions for vanishing point detection."""
