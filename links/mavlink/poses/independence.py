"""Whether the autopilot's estimate can contain poses that grd sent.

It cannot while no pose that enters an EKF was sent since the autopilot booted. ODOMETRY and VISION_POSITION_ESTIMATE
enter one whenever a source of it is external, with ArduPilot's EK3_SRC_OPTIONS bit 0 even when the active one is not.
LANDING_TARGET does not: ArduPilot keeps it in the filter of AC_PrecLand; PX4 fuses the velocity of a static target
(EKF2's auxiliary velocity), but the profile px4 never sends it.

Times decide, not the order in which threads run: a frame received at t is compared with the poses sent before t. So
live and replay agree, since a pose is stamped and reported under the lock that a received frame waits for.

Source: ours; ArduPilot AP_NavEKF_Source::useVelXYSource, AC_PrecLand::run_estimator; PX4 EKF2::UpdateAuxVelSample.
"""

from __future__ import annotations

from collections import deque

from links.mavlink.timesync_monitor import MAX_LATENCY_NS

POSES = frozenset({"ODOMETRY", "VISION_POSITION_ESTIMATE"})  # messages that enter an EKF
MAX_PENDING = 65_536  # poses sent while nothing is received: 20 minutes at 50 Hz; then the oldest are dropped


class Independence:
    """Compares the times of sent poses with the autopilot's boot. `on_sent` may be called from another thread."""

    def __init__(self) -> None:
        self._pending: deque[int] = deque(maxlen=MAX_PENDING)  # times of sent poses that no received frame has passed
        self._sent_ns: int | None = None  # newest pose sent before the newest received frame
        self._booted_ns: int | None = None
        self._reboots = 0

    def on_sent(self, kind: str, sent_ns: int) -> None:
        """A message of this type was sent: by this session in order of time, after those of earlier ones."""
        if kind in POSES:
            self._pending.append(sent_ns)

    def on_clock(self, booted_ns: int, reboots: int) -> None:
        """Host time of the autopilot's boot by its clock, and how often it was seen to boot.

        The first estimates are late by the delay of the link, so the earliest one counts.
        """
        if self._booted_ns is None or reboots != self._reboots:
            self._booted_ns, self._reboots = booted_ns, reboots
        self._booted_ns = min(self._booted_ns, booted_ns)

    def at(self, arrival_ns: int) -> bool:
        """Whether the estimate in a frame received at this time is independent of the poses sent before.

        A pose sent shortly before the boot may still have been under way.
        """
        while self._pending and self._pending[0] < arrival_ns:
            self._sent_ns = max(self._pending.popleft(), self._sent_ns or 0)
        if self._sent_ns is None:
            return True
        return self._booted_ns is not None and self._sent_ns < self._booted_ns - MAX_LATENCY_NS
