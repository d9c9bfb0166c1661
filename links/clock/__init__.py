"""Clocks: the host's timeline, the `Clock` source of ticks, and estimators of other devices' clocks."""

from links.clock.clock import Clock

__all__ = ["Clock"]
