"""What went wrong in a run, in words: said at once, and when it goes on, not again and again.

Source: ours.
"""

from __future__ import annotations

import re
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from flow.message import Message, message

AGAIN_NS, LONGEST_NS = 10_000_000_000, 600_000_000_000  # the same thing is said again after so long; doubles each time
MAX_KINDS = 200  # that are told apart; more are counted together
MAX_WAITING = 1000  # that nobody has fetched
_NUMBER = re.compile(r"\d+(\.\d+)?")


@dataclass(slots=True)
class Incident:
    """One kind of trouble at one node; texts that differ in numbers only are one kind."""

    node: str
    text: str  # as it was said last
    first_ns: int
    last_ns: int
    count: int = 1
    quiet_until_ns: int = 0
    quiet_ns: int = AGAIN_NS

    def __str__(self) -> str:
        return f"{self.node}: {self.text}" + (f" ({self.count} times)" if self.count > 1 else "")


@message
class IncidentTold(Message):
    """An incident as it is told, no more often than there: for taps, live, as `run.incidents`."""

    node: str
    text: str
    mended: bool  # it came right again


class Incidents:
    """Any thread reports, one fetches what is to be told."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._kinds: dict[tuple[str, str], Incident] = {}
        self._fresh: deque[str] = deque(maxlen=MAX_WAITING)
        self._lock = threading.Lock()
        self.tell: Callable[[IncidentTold], None] | None = None  # each that is told at once, from the thread it is of

    def report(self, node: str, text: str, *, mended: bool = False) -> None:
        """One more thing went wrong at a node, or came right again (`mended`)."""
        now_ns = self._now_ns()
        with self._lock:
            kind = (node, _NUMBER.sub("#", text))
            if kind not in self._kinds and len(self._kinds) >= MAX_KINDS:
                kind, text = (node, ""), "more trouble of other kinds"
            incident = self._kinds.get(kind)
            if incident is None:
                incident = self._kinds[kind] = Incident(node, text, now_ns, now_ns)
            else:
                incident.text, incident.last_ns = text, now_ns
                incident.count += 1
                if now_ns < incident.quiet_until_ns:
                    return
                incident.quiet_ns = min(2 * incident.quiet_ns, LONGEST_NS)
            incident.quiet_until_ns = now_ns + incident.quiet_ns
            told = str(incident)
            self._fresh.append(told)
        if self.tell is not None:
            self.tell(IncidentTold(stamp_ns=now_ns, node=node, text=told.removeprefix(f"{node}: "), mended=mended))

    def fetch(self) -> list[str]:
        """What has not been told yet, oldest first."""
        with self._lock:
            texts = list(self._fresh)
            self._fresh.clear()
        return texts

    @property
    def all(self) -> list[Incident]:
        """Every kind of trouble of the run, in the order of first appearance."""
        with self._lock:
            return list(self._kinds.values())
