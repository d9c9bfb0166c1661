"""How fast a device's clock runs away from the host's, from the exchanges that bound its offset.

An exchange (asked at host time ts1, answered at device time tc1, heard at t) tells host - device at its middle, wrong
by at most half its length. Of each WINDOW_NS the shortest one counts: the others waited somewhere. A line through them
has the drift as its slope; an error of h, evenly within its bound, has the variance h^2 / 3, more where they scatter:

    w = 3 / h^2,  slope = sum w (m - m0)(o - o0) / S,  S = sum w (m - m0)^2,  sigma = sqrt(max(chi2 / (n - 2), 1) / S)

A way that is always longer in one direction shifts all offsets alike, and no slope.

Source: weighted least squares; https://mavlink.io/en/services/timesync.html for the exchange; ours.
"""

from __future__ import annotations

import math
from collections import deque

WINDOW_NS = 5_000_000_000
MOST_WINDOWS = 60  # five minutes: a crystal warms up and cools down
FEWEST_WINDOWS = 5
SHORTEST_NS = 20_000  # half an exchange: clocks are read no finer
SIGMA_PPM = 50.0  # known worse, it is not told

_Exchange = tuple[float, float, float]  # its middle [s], host - device [s], both from the first; half its length [s]


class ClockDrift:
    """Of one device, exchange by exchange. Pure: the same exchanges give the same numbers."""

    def __init__(self) -> None:
        self._windows: deque[_Exchange] = deque(maxlen=MOST_WINDOWS)
        self.clear()

    def clear(self) -> None:
        """The device's clock began anew, or the answers were another's."""
        self._windows.clear()
        self._first: tuple[int, int] | None = None
        self._window = -1
        self._told: tuple[float, float] | None = None

    def add(self, ts1_ns: int, tc1_ns: int, arrival_ns: int) -> None:
        """One exchange, in order of arrival."""
        middle_ns, half_ns = (ts1_ns + arrival_ns) // 2, max((arrival_ns - ts1_ns) // 2, SHORTEST_NS)
        if self._first is None:
            self._first = middle_ns, middle_ns - tc1_ns
        begin_ns, offset_ns = self._first
        found = 1e-9 * (middle_ns - begin_ns), 1e-9 * (middle_ns - tc1_ns - offset_ns), 1e-9 * half_ns
        window = (arrival_ns - begin_ns) // WINDOW_NS
        if window != self._window:
            self._window = window
            self._told = self._fit()
            self._windows.append(found)
        elif found[2] < self._windows[-1][2]:
            self._windows[-1] = found

    @property
    def ppm(self) -> tuple[float, float] | None:
        """By how much the host's clock gains on the device's, and one sigma, by windows that are over, if known."""
        return self._told

    def _fit(self) -> tuple[float, float] | None:
        if len(self._windows) < FEWEST_WINDOWS:
            return None
        weights = [3.0 / half**2 for _, _, half in self._windows]
        total = math.fsum(weights)
        m0 = math.fsum(w * m for w, (m, _, _) in zip(weights, self._windows, strict=True)) / total
        o0 = math.fsum(w * o for w, (_, o, _) in zip(weights, self._windows, strict=True)) / total
        spread = math.fsum(w * (m - m0) ** 2 for w, (m, _, _) in zip(weights, self._windows, strict=True))
        slope = math.fsum(w * (m - m0) * (o - o0) for w, (m, o, _) in zip(weights, self._windows, strict=True)) / spread
        left = [o - o0 - slope * (m - m0) for m, o, _ in self._windows]
        chi2 = math.fsum(w * e * e for w, e in zip(weights, left, strict=True))
        sigma = math.sqrt(max(chi2 / (len(left) - 2), 1.0) / spread)
        return (1e6 * slope, 1e6 * sigma) if 1e6 * sigma <= SIGMA_PPM else None
