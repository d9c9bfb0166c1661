"""Our TIMESYNC requests that wait for an answer, and whether poses would come late.

A radio or a bridge behind a faster line takes poses at once and hands them on late, and no system here knows of it:
only the answers tell. How much of a round trip is the way there is not known, so all of it may be. It is slow where

    two of the last three answers were late, or
    eight requests in a row found no answer while the autopilot was heard: a bridge that hangs on the way there, or
    two frames within a second left our own line late

and late from then until it has not been slow for three seconds. What fills a bridge may be the poses themselves: then
a line that nobody sends on is soon prompt, and late again. So each time that lateness comes back before a minute of
answers was prompt while poses went out, the wait doubles, up to a minute.

An answer that is lost says nothing, and an autopilot that never answers is never late. One that has answered, is heard
and answers no more for 27 seconds is taken for one that never did when its wait is over: `unseen`.

Source: ours; https://mavlink.io/en/services/timesync.html; DESIGN: ArduPilot's health ends after 300 ms.
"""

from __future__ import annotations

from collections import deque

ASK_NS = 250_000_000  # between two requests
LATE_NS = 300_000_000  # what comes later, the autopilot would have taken for silence
LATEST, LATE_OF_LATEST = 3, 2
LEFT_LATE_NS = 1_000_000_000  # between two that left late
UNANSWERED = 8  # for 2 s; where a fifth of all frames is lost that is once in a quarter of an hour
GIVEN_UP = 108  # 27 seconds; with the first wait half a minute
FIRST_WAIT_NS, LONGEST_WAIT_NS = 3_000_000_000, 60_000_000_000
PROVEN = 240  # prompt answers while poses go out: a minute
WAITING = 64  # requests: a quarter of a minute


class RoundTrips:
    """`asked`, `heard` and `answered` in turn; `late`: whether poses would come late."""

    def __init__(self) -> None:
        self.late = False
        self.unseen = False  # it has answered and does no more: lateness is not seen
        self._waiting: deque[int] = deque(maxlen=WAITING)
        self._took_ns: deque[int] = deque(maxlen=LATEST)  # empty: it does not answer
        self._open = False  # the newest request waits for its answer
        self._heard = False  # since the newest request
        self._unanswered = 0  # requests since the newest answer after which it was heard
        self._left_late_ns: int | None = None  # when a frame left late, last
        self._slow_ns = 0  # when it was slow last
        self._wait_ns = FIRST_WAIT_NS
        self._unproven = 0  # prompt answers that are missing until the wait is short again

    @property
    def newest_ns(self) -> int | None:
        """The round trip of the answer that came last."""
        return self._took_ns[-1] if self._took_ns else None

    @property
    def status(self) -> str | None:
        """In words, while poses would come late, or it is no longer seen whether they do."""
        if self.late:
            return (
                f"answers to TIMESYNC take longer than {1e-9 * LATE_NS:g} s or do not come, or our own line is that "
                "slow: no poses are sent, they would come late. Is a radio, bridge or line too slow for them "
                "(clock.rate_hz), or for what the autopilot sends (SRn_...)?"
            )
        if self.unseen:
            return (
                "the autopilot has answered TIMESYNC and does no more: poses are sent, and whether they come late is "
                "not seen. Does a router or bridge keep our frames back?"
            )
        return None

    def asked(self, at_ns: int) -> bool:
        """A request has gone out; `at_ns` is what it holds. True: with it, answers are no longer waited for."""
        self._waiting.append(at_ns)
        if self._took_ns and self._open and self._heard:
            self._unanswered += 1
        self._open, self._heard = True, False
        given_up = self._unanswered >= GIVEN_UP
        if given_up:
            self.begin_anew()
            self.unseen = True
        self._judge(at_ns)
        return given_up

    def heard(self) -> None:
        """The autopilot has said something."""
        self._heard = True

    def answered(self, asked_ns: int, arrival_ns: int, sending: bool) -> bool:
        """Whether an answer is to a request of ours, and the first to it; `sending`: poses go out now."""
        if asked_ns not in self._waiting:
            return False
        self._waiting.remove(asked_ns)
        self._open = self.unseen = False
        self._unanswered = 0
        if sending and not self.late and arrival_ns - asked_ns <= LATE_NS:
            self._unproven = max(0, self._unproven - 1)
        self._took_ns.append(arrival_ns - asked_ns)
        self._judge(arrival_ns)
        return True

    def left_late(self, now_ns: int) -> None:
        """A frame, or some at once, took longer than LATE_NS to leave our own line."""
        again = self._left_late_ns is not None and now_ns - self._left_late_ns <= LEFT_LATE_NS
        self._left_late_ns = now_ns
        self._judge(now_ns, again)

    def begin_anew(self) -> None:
        """Another connection, or heard after a silence: it may be another autopilot, or one that answers no more.

        A wait goes on: what was late may be so still.
        """
        self._took_ns.clear()
        self._unanswered = 0
        self.unseen = False

    def _judge(self, now_ns: int, left_late: bool = False) -> None:
        late = [took_ns > LATE_NS for took_ns in self._took_ns]
        if sum(late) >= LATE_OF_LATEST or left_late or self._unanswered >= UNANSWERED:
            if not self.late:
                self._wait_ns = min(2 * self._wait_ns, LONGEST_WAIT_NS) if self._unproven else FIRST_WAIT_NS
            self.late, self._slow_ns = True, now_ns
        elif self.late and now_ns - self._slow_ns >= self._wait_ns and not (late and late[-1]):
            self.late, self._unproven = False, PROVEN
