"""Detector of the paper (P III.B)."""
