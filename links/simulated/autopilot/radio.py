"""A radio or serial link: frames arrive late, in order, and are sometimes lost.

    arrival_k = max(sent_k + latency + jitter, arrival_{k-1} + bytes_k * 10 / bitrate)

The jitter is exponential. Losses come in bursts (Gilbert): within a burst all frames are lost, as in an outage.

Source: ours.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from flow.stage import StrictModel
from links.simulated.world.path import TimeSpan

BITS_PER_BYTE = 10  # start and stop bit of a serial line


class RadioSettings(StrictModel):
    """Delays and losses of one direction."""

    latency_s: float = Field(default=0.006, ge=0, le=5)  # minimum
    jitter_s: float = Field(default=0.004, ge=0, le=5)  # mean of the delay above the minimum
    bitrate_bps: float = Field(default=921_600.0, ge=9_600)
    loss_fraction: float = Field(default=0.0, ge=0, lt=1)
    loss_burst_frames: float = Field(default=3.0, ge=1)  # mean length of a burst
    outages_s: tuple[TimeSpan, ...] = ()


class Radio:
    """One direction of a link. Call `arrival_ns` in the order of sending."""

    def __init__(self, settings: RadioSettings, start_ns: int, rng: np.random.Generator) -> None:
        self._settings = settings
        self._outages = [(start_ns + round(1e9 * a), start_ns + round(1e9 * b)) for a, b in settings.outages_s]
        self._rng = rng
        self._in_burst = False
        self._last_ns = start_ns

    def arrival_ns(self, sent_ns: int, size_bytes: int) -> int | None:
        """Arrival time of a frame; None: it is lost."""
        s = self._settings
        jitter_s = self._rng.exponential(s.jitter_s) if s.jitter_s else 0.0
        end = 1 / s.loss_burst_frames
        begin = min(1.0, end * s.loss_fraction / (1 - s.loss_fraction))
        self._in_burst = bool(self._rng.random() < (1 - end if self._in_burst else begin))
        if self._in_burst or any(a <= sent_ns < b for a, b in self._outages):
            return None
        least_ns = self._last_ns + round(size_bytes * BITS_PER_BYTE / s.bitrate_bps * 1e9)
        self._last_ns = max(sent_ns + round(1e9 * (s.latency_s + jitter_s)), least_ns)
        return self._last_ns
