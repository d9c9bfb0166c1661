"""Our TIMESYNC requests that wait for an answer, and whether the answers come late.

A radio or a bridge behind a faster line takes poses at once and hands them on late, and no system here knows of it:
only the answers tell. How much of a round trip is the way there is not known, so all of it may be. Late are two of the
last three; then poses go out again after three seconds of prompt answers, since what fills a bridge may be the poses
themselves. An answer that is lost says nothing, and an autopilot that never answers is never late.

Source: ours; https://mavlink.io/en/services/timesync.html; DESIGN: ArduPilot's health ends after 300 ms.
"""

from __future__ import annotations

from collections import deque

ASK_NS = 250_000_000  # between two requests
LATE_NS = 300_000_000  # what comes later, the autopilot would have taken for silence
LATEST, LATE_OF_LATEST = 3, 2
PROMPT_AGAIN = 12  # in a row: three seconds
WAITING = 64  # requests: a quarter of a minute


class RoundTrips:
    """`asked` and `answered` in turn; `late`: whether poses would come late."""

    def __init__(self) -> None:
        self.late = False
        self._waiting: deque[int] = deque(maxlen=WAITING)
        self._took_ns: deque[int] = deque(maxlen=LATEST)
        self._prompt = 0  # in a row

    @property
    def newest_ns(self) -> int | None:
        """The round trip of the answer that came last."""
        return self._took_ns[-1] if self._took_ns else None

    @property
    def trouble(self) -> str | None:
        """In words, while answers come late."""
        if not self.late:
            return None
        return (
            f"answers to TIMESYNC take longer than {1e-9 * LATE_NS:g} s: no poses are sent, they would come late. Is a "
            "radio or bridge too slow for them (clock.rate_hz), or for what the autopilot sends (SRn_...)?"
        )

    def asked(self, at_ns: int) -> None:
        """A request has gone out; `at_ns` is what it holds."""
        self._waiting.append(at_ns)

    def answered(self, asked_ns: int, arrival_ns: int) -> bool:
        """Whether an answer is to a request of ours, and the first to it."""
        if asked_ns not in self._waiting:
            return False
        self._waiting.remove(asked_ns)
        self._took_ns.append(arrival_ns - asked_ns)
        late = [took_ns > LATE_NS for took_ns in self._took_ns]
        self._prompt = 0 if late[-1] else self._prompt + 1
        self.late = sum(late) >= LATE_OF_LATEST or (self.late and self._prompt < PROMPT_AGAIN)
        return True
