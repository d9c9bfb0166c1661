"""Poses to the autopilot: which may be sent, as which messages, and whether its own estimate may contain them."""
