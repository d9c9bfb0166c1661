"""Simulated sensors behind cues: GNSS receivers, ranging radios, a barometer; also wrong ones."""
