"""Events of a run: what went wrong, or works again, as text; reported at once, and then not again and again.

Source: ours.
"""

from __future__ import annotations

import re
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from flow.message import Message, message

QUIET_NS, MAX_QUIET_NS = 10_000_000_000, 600_000_000_000
"""After a report the same event is not reported for QUIET_NS; the time doubles with each report, up to MAX_QUIET_NS."""
MAX_EVENTS = 200  # kept individually; further ones are counted together
MAX_UNFETCHED = 1000
_NUMBER = re.compile(r"\d+(\.\d+)?")


@dataclass(slots=True)
class Event:
    """One event of one node, with how often it happened. Texts that differ only in numbers are one event."""

    node: str
    text: str  # the latest
    first_ns: int
    last_ns: int
    count: int = 1
    quiet_until_ns: int = 0
    quiet_ns: int = QUIET_NS

    def __str__(self) -> str:
        return f"{self.node}: {self.text}" + (f" ({self.count} times)" if self.count > 1 else "")


@message
class EventMessage(Message):
    """A report of an event, for taps of a live run: output `run.events`."""

    node: str
    text: str
    resolved: bool  # the node works again


class Events:
    """All events of a run. Any thread reports, one thread fetches the reports."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._events: dict[tuple[str, str], Event] = {}
        self._unfetched: deque[str] = deque(maxlen=MAX_UNFETCHED)
        self._lock = threading.Lock()
        self.publish: Callable[[EventMessage], None] | None = None
        """Called with each report, from the thread that reports."""

    def report(self, node: str, text: str, *, resolved: bool = False) -> None:
        """Something went wrong at a node, or works again (`resolved`)."""
        now_ns = self._now_ns()
        with self._lock:
            key = (node, _NUMBER.sub("#", text))
            if key not in self._events and len(self._events) >= MAX_EVENTS:
                key, text = (node, ""), "more events of other kinds"
            event = self._events.get(key)
            if event is None:
                event = self._events[key] = Event(node, text, now_ns, now_ns)
            else:
                event.text, event.last_ns = text, now_ns
                event.count += 1
                if now_ns < event.quiet_until_ns:
                    return
                event.quiet_ns = min(2 * event.quiet_ns, MAX_QUIET_NS)
            event.quiet_until_ns = now_ns + event.quiet_ns
            report = str(event)
            self._unfetched.append(report)
        if self.publish is not None:
            text = report.removeprefix(f"{node}: ")
            self.publish(EventMessage(stamp_ns=now_ns, node=node, text=text, resolved=resolved))

    def fetch(self) -> list[str]:
        """The reports since the call before, oldest first."""
        with self._lock:
            texts = list(self._unfetched)
            self._unfetched.clear()
        return texts

    @property
    def all(self) -> list[Event]:
        """Every event of the run, in the order of their first occurrence."""
        with self._lock:
            return list(self._events.values())
