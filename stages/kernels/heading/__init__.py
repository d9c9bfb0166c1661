"""Compiled functions of the heading estimate."""
