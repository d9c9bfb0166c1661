"""Compiled functions for drone detection."""
