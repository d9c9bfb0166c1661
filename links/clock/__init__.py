"""The host's clock as a link.

Source: ours.
"""

from links.clock.clock import Clock

__all__ = ["Clock"]
