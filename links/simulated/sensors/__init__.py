"""Simulated sensors and servo: they produce the bytes of the real devices."""
