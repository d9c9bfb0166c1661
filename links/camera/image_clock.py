"""Reception time of a stream's images by the stream's own time stamps, without the delay of the decoder.

    received = position + offset,   offset <= arrival - position of each image

The image with the smallest delay determines the offset; the clocks of camera and host drift slowly. Images that the
source buffered before the stream was opened are late: they are delivered faster than they were captured, until one is
current.

Source: RFC 3550, 5.1 (RTP time stamps, which FFmpeg provides as CAP_PROP_POS_MSEC); the estimate is ours.
"""

from __future__ import annotations

from links.clock.device_clock import DeviceClock

REAL_TIME_SHARE = 0.97  # images delivered at intervals of at least this share of the capture interval are not buffered
STEADY = 3  # consecutive such images; a single one may have taken long to decode


class ImageClock:
    """Clock of one open stream. Deterministic: the same positions and arrivals give the same times."""

    def __init__(self) -> None:
        self._clock = DeviceClock()
        self._last: tuple[int, int] | None = None
        self._steady = 0

    @property
    def caught_up(self) -> bool:
        """Whether images are delivered no faster than they were captured."""
        return self._steady >= STEADY

    def received_ns(self, position_ns: int, arrival_ns: int) -> int | None:
        """Host time of reception, never after the arrival; None: the stream's position does not advance."""
        if self._last is not None:
            step_ns, took_ns = position_ns - self._last[0], arrival_ns - self._last[1]
            if step_ns <= 0:
                return None
            self._steady = self._steady + 1 if took_ns >= REAL_TIME_SHARE * step_ns else 0
        self._last = position_ns, arrival_ns
        received_ns = self._clock.read(position_ns, arrival_ns)
        return arrival_ns if received_ns is None else min(received_ns, arrival_ns)
