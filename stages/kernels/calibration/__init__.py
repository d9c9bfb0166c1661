"""Compiled functions for calibration."""
