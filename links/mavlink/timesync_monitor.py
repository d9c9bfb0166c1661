"""Monitor of TIMESYNC round trips: whether poses would arrive late.

A radio or bridge behind a fast line accepts poses immediately and forwards them late, which only the replies to
TIMESYNC reveal. The forward part of a round trip is unknown, so all of it is assumed. The link is slow when

    two of the last three replies were late, or
    eight consecutive requests had no reply while the autopilot sent frames (a bridge blocked in forward direction), or
    two frames within one second left the local send buffer late.

It counts as late from then until it has not been slow for three seconds. The poses themselves may be what fills a
bridge: then an unused link soon has short round trips and becomes late again. Therefore the waiting time doubles, up to
one minute, each time lateness returns before a minute of prompt replies while poses were sent.

A lost reply has no effect, and an autopilot that never replies is never late. One that has replied, sends frames, and
has not replied for 27 seconds is treated like one that never did once its waiting time is over: `latency_unknown`.

Source: ours; https://mavlink.io/en/services/timesync.html; ArduPilot's health timeout of 300 ms.
"""

from __future__ import annotations

from collections import deque

REQUEST_PERIOD_NS = 250_000_000  # period of requests
MAX_LATENCY_NS = 300_000_000  # the autopilot treats a longer delay as a timeout
WINDOW, LATE_IN_WINDOW = 3, 2
LATE_FRAMES_WITHIN_NS = 1_000_000_000  # between two frames that left late
UNANSWERED = 8  # 2 s; with 20 % frame loss this happens once per quarter of an hour
GIVEN_UP = 108  # 27 s; half a minute with the first waiting time
FIRST_WAIT_NS, MAX_WAIT_NS = 3_000_000_000, 60_000_000_000
PROVEN = 240  # prompt replies while poses are sent: one minute
MAX_PENDING = 64  # requests: a quarter of a minute


class TimesyncMonitor:
    """Evaluates requests (`on_request`), frames (`on_frame`) and replies (`on_reply`) in order."""

    def __init__(self) -> None:
        self.late = False  # poses would arrive late
        self.latency_unknown = False  # the autopilot has stopped replying
        self._pending: deque[int] = deque(maxlen=MAX_PENDING)
        self._round_trips_ns: deque[int] = deque(maxlen=WINDOW)  # empty: the autopilot does not reply
        self._open = False  # the newest request has no reply yet
        self._active = False  # a frame has arrived since the newest request
        self._unanswered = 0  # requests with frames but without a reply, since the newest reply
        self._late_frame_ns: int | None = None  # when a frame last left late
        self._slow_ns = 0  # when the link was last slow
        self._wait_ns = FIRST_WAIT_NS
        self._unproven = 0  # prompt replies that are missing until the waiting time is short again

    @property
    def newest_ns(self) -> int | None:
        """Round trip of the newest reply."""
        return self._round_trips_ns[-1] if self._round_trips_ns else None

    @property
    def status(self) -> str | None:
        """Error text while poses would arrive late, or the latency is unknown."""
        if self.late:
            return (
                f"TIMESYNC replies take longer than {1e-9 * MAX_LATENCY_NS:g} s or are missing, or the local line is "
                "that slow: no poses are sent, they would arrive late. Is a radio, bridge or line too slow for the "
                "poses (clock.rate_hz), or for the autopilot's messages (SRn_...)?"
            )
        if self.latency_unknown:
            return (
                "the autopilot no longer replies to TIMESYNC: poses are sent, but their latency is unknown. Does a "
                "router or bridge drop our frames?"
            )
        return None

    def on_request(self, request_ns: int) -> bool:
        """A request was sent with this time. True: with it, the monitor gives up waiting for replies."""
        self._pending.append(request_ns)
        if self._round_trips_ns and self._open and self._active:
            self._unanswered += 1
        self._open, self._active = True, False
        given_up = self._unanswered >= GIVEN_UP
        if given_up:
            self.reset()
            self.latency_unknown = True
        self._update(request_ns)
        return given_up

    def on_frame(self) -> None:
        """The autopilot has sent a frame."""
        self._active = True

    def on_reply(self, request_ns: int, arrival_ns: int, sending: bool) -> bool:
        """Use a reply; False: it is not the first one to a request of ours. `sending`: poses are being sent."""
        if request_ns not in self._pending:
            return False
        self._pending.remove(request_ns)
        self._open = self.latency_unknown = False
        self._unanswered = 0
        if sending and not self.late and arrival_ns - request_ns <= MAX_LATENCY_NS:
            self._unproven = max(0, self._unproven - 1)
        self._round_trips_ns.append(arrival_ns - request_ns)
        self._update(arrival_ns)
        return True

    def on_late_frame(self, now_ns: int) -> None:
        """One or several frames took longer than MAX_LATENCY_NS to leave the local send buffer."""
        repeated = self._late_frame_ns is not None and now_ns - self._late_frame_ns <= LATE_FRAMES_WITHIN_NS
        self._late_frame_ns = now_ns
        self._update(now_ns, repeated)

    def reset(self) -> None:
        """Forget the replies: after a reconnect or a silence it may be another autopilot, or one that never replies.

        A waiting time continues: the link may still be late.
        """
        self._round_trips_ns.clear()
        self._unanswered = 0
        self.latency_unknown = False

    def _update(self, now_ns: int, late_frames: bool = False) -> None:
        late = [round_trip_ns > MAX_LATENCY_NS for round_trip_ns in self._round_trips_ns]
        if sum(late) >= LATE_IN_WINDOW or late_frames or self._unanswered >= UNANSWERED:
            if not self.late:
                self._wait_ns = min(2 * self._wait_ns, MAX_WAIT_NS) if self._unproven else FIRST_WAIT_NS
            self.late, self._slow_ns = True, now_ns
        elif self.late and now_ns - self._slow_ns >= self._wait_ns and not (late and late[-1]):
            self.late, self._unproven = False, PROVEN
