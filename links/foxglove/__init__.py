"""Recordings and runs for Foxglove, with its own message schemas."""

from links.foxglove.export import export as export
