"""Simulated sensors behind cues: GNSS receivers, ranging radios, a barometer; with their lies."""
