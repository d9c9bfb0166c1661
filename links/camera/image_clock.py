"""When a picture of a stream came, by the stream's own times: freed of what it waited for the decoder.

    came = position + offset,   offset <= arrival - position of each picture

The picture that waited least holds the offset; the camera's clock and the host's drift apart by little. Pictures that
had come before the stream was opened are all late: they are handed out faster than they were taken, until one is new.

Source: ours; RFC 3550, 5.1 (RTP's time stamps, which FFmpeg gives as CAP_PROP_POS_MSEC).
"""

from __future__ import annotations

from links.clock.device_clock import DeviceClock

AS_FAST = 0.97  # handed out in this share of the time between two pictures, or more: nothing waits any more
STEADY = 3  # pictures in a row: one that takes long to decode does not show it


class ImageClock:
    """Of one open stream. Pure: the same positions and arrivals give the same times."""

    def __init__(self) -> None:
        self._clock = DeviceClock()
        self._last: tuple[int, int] | None = None
        self._steady = 0

    @property
    def caught_up(self) -> bool:
        """Whether pictures are handed out no faster than they were taken."""
        return self._steady >= STEADY

    def came_ns(self, position_ns: int, arrival_ns: int) -> int | None:
        """Host time, never after the arrival; None for a stream whose position stands still: it tells nothing."""
        if self._last is not None:
            step_ns, took_ns = position_ns - self._last[0], arrival_ns - self._last[1]
            if step_ns <= 0:
                return None
            self._steady = self._steady + 1 if took_ns >= AS_FAST * step_ns else 0
        self._last = position_ns, arrival_ns
        came_ns = self._clock.read(position_ns, arrival_ns)
        return arrival_ns if came_ns is None else min(came_ns, arrival_ns)
