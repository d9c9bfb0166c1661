"""Drift of a device's clock against the host's, from the round trips that bound its offset.

A round trip (request at host time ts1, reply at device time tc1, arrival at host time t) measures host - device at its
middle, with an error of at most half its length h. The shortest round trip of each WINDOW_NS is used; the others were
delayed. The drift is the slope of a line fitted to them. An error that is uniform within +-h has the variance h^2 / 3;
the sigma is scaled up if the residuals scatter more:

    w = 3 / h^2,  slope = sum w (m - m0)(o - o0) / S,  S = sum w (m - m0)^2,  sigma = sqrt(max(chi2 / (n - 2), 1) / S)

A constant asymmetry of the path shifts all offsets equally and does not change the slope.

Source: weighted least squares; https://mavlink.io/en/services/timesync.html for the exchange; ours.
"""

from __future__ import annotations

import math
from collections import deque

WINDOW_NS = 5_000_000_000
MAX_WINDOWS = 60  # five minutes: a crystal's frequency changes with its temperature
MIN_WINDOWS = 5
MIN_HALF_NS = 20_000  # half a round trip: resolution of reading the clocks
MAX_SIGMA_PPM = 50.0  # a drift with a larger sigma is not reported

_RoundTrip = tuple[float, float, float]  # middle [s], host - device [s], both relative to the first; half length [s]


class ClockDrift:
    """Drift of one device's clock, updated per round trip. Deterministic."""

    def __init__(self) -> None:
        self._windows: deque[_RoundTrip] = deque(maxlen=MAX_WINDOWS)
        self.clear()

    def clear(self) -> None:
        """Forget everything: the device's clock was reset, or the replies were for another host."""
        self._windows.clear()
        self._first: tuple[int, int] | None = None
        self._window = -1
        self._estimate: tuple[float, float] | None = None

    def add(self, ts1_ns: int, tc1_ns: int, arrival_ns: int) -> None:
        """Add one round trip, in order of arrival."""
        middle_ns, half_ns = (ts1_ns + arrival_ns) // 2, max((arrival_ns - ts1_ns) // 2, MIN_HALF_NS)
        if self._first is None:
            self._first = middle_ns, middle_ns - tc1_ns
        begin_ns, offset_ns = self._first
        sample = 1e-9 * (middle_ns - begin_ns), 1e-9 * (middle_ns - tc1_ns - offset_ns), 1e-9 * half_ns
        window = (arrival_ns - begin_ns) // WINDOW_NS
        if window != self._window:
            self._window = window
            self._estimate = self._fit()
            self._windows.append(sample)
        elif sample[2] < self._windows[-1][2]:
            self._windows[-1] = sample

    @property
    def ppm(self) -> tuple[float, float] | None:
        """(rate of host - device, sigma) [ppm] from the completed windows; None: not known."""
        return self._estimate

    def _fit(self) -> tuple[float, float] | None:
        if len(self._windows) < MIN_WINDOWS:
            return None
        weights = [3.0 / half**2 for _, _, half in self._windows]
        total = math.fsum(weights)
        m0 = math.fsum(w * m for w, (m, _, _) in zip(weights, self._windows, strict=True)) / total
        o0 = math.fsum(w * o for w, (_, o, _) in zip(weights, self._windows, strict=True)) / total
        spread = math.fsum(w * (m - m0) ** 2 for w, (m, _, _) in zip(weights, self._windows, strict=True))
        slope = math.fsum(w * (m - m0) * (o - o0) for w, (m, o, _) in zip(weights, self._windows, strict=True)) / spread
        residuals = [o - o0 - slope * (m - m0) for m, o, _ in self._windows]
        chi2 = math.fsum(w * e * e for w, e in zip(weights, residuals, strict=True))
        sigma = math.sqrt(max(chi2 / (len(residuals) - 2), 1.0) / spread)
        return (1e6 * slope, 1e6 * sigma) if 1e6 * sigma <= MAX_SIGMA_PPM else None
