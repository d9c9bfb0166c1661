"""Cues: where the drone is by other sensors. They direct the search and are evidence with a cap, never a position."""

from stages.cues.relative_cues import RelativeCues as RelativeCues
