"""The live runner: a graph on threads, its report, and the repetition of a recorded live run."""

from flow.live.live import Live

__all__ = ["Live"]
