"""The outside world: sensors, servo, autopilot, recordings, viewer, command line. Only links touch it."""

__version__ = "0.2.0"
