"""The sending end of a hop: a link that sends messages to one other host (`flow.config.hosts`).

Source: ours.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

from flow import link
from flow.config.hosts import Hop, port_of
from flow.link import Record, SourceSettings
from flow.message import Message
from links.zenoh.connection import Connection, connected
from links.zenoh.lane import Lane
from links.zenoh.session import Session, key_of

JOIN_S = 0.2  # a thread whose line is stuck ends when Zenoh lets it go; the run does not wait for it


class SenderSettings(SourceSettings):
    """Settings of `Sender`."""

    session: Session
    to: str


class Sender(link.Source[SenderSettings]):
    """Sends to one host. It brings no records in: `listen` is the time for which it is connected.

    Not for YAML (`sender_class` makes its ports), and so not in the schema, which knows `class Name(Source)`.
    """

    hops: ClassVar[tuple[Hop, ...]] = ()

    def __init__(self, settings: SenderSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._lanes: dict[str, Lane] = {}
        self._connection: Connection | None = None
        self._unopened: int = 0
        for hop in self.hops:
            deadline_ns = round(hop.queue.deadline_ms * 1e6)
            self._lanes[port_of(hop)] = Lane(key_of(hop), hop.message, hop.queue.depth, deadline_ns)

    def send(self, port: str, message: Message) -> None:
        """Let a message wait on its lane; before the link is open it is dropped."""
        if self._connection is None:
            self._unopened += 1
        else:
            self._lanes[port].put(message)

    def decode(self, record: Record) -> None:
        """Nothing comes in here."""

    @contextmanager
    def listen(self) -> Iterator[Iterator[Record]]:
        """Connected to the other host. LinkError: a certificate or the library is missing."""
        closing = threading.Event()
        with connected(self.settings.session) as connection:
            self._connection = connection
            threads = [
                threading.Thread(target=lane.send_on, args=(connection, closing), name=f"send {lane.key}", daemon=True)
                for lane in self._lanes.values()
            ]
            for thread in threads:
                thread.start()
            try:
                yield _nothing_until(closing)
            finally:
                self._connection = None
                closing.set()
                for thread in threads:
                    thread.join(JOIN_S / len(threads))

    @property
    def counters(self) -> dict[str, int]:
        """Totals since the start over all outputs; dropped, late and failed by output, too, where there were any."""
        counts = {lane.key.split("/", 3)[3].replace("/", "."): lane.counts for lane in self._lanes.values()}
        totals = {
            "sent": sum(c.sent for c in counts.values()),
            "sent bytes": sum(c.sent_bytes for c in counts.values()),
        }
        totals["before it was open"] = self._unopened
        for what in ("dropped", "late", "failed"):
            numbers = {name: getattr(c, what) for name, c in counts.items()}
            totals[what] = sum(numbers.values())
            totals |= {f"{what}: {name}": number for name, number in numbers.items() if number}
        return totals

    @property
    def status(self) -> str | None:
        """What is wrong on the way to the other host."""
        settings = self.settings
        if self._connection is None:
            return None
        wrong = self._connection.status_with(settings.to)
        if wrong is not None or self._connection.clocks[settings.to].answered_ns is None:
            return wrong
        unheard = [lane.key for lane in self._lanes.values() if not lane.heard]
        if unheard:
            return f"{settings.to} does not listen to {', '.join(unheard)}: is it running, with the same hosts file?"
        return next((lane.status for lane in self._lanes.values() if lane.status), None)


def _nothing_until(closing: threading.Event) -> Iterator[Record]:
    closing.wait()
    yield from ()


def sender_class(hops: list[Hop]) -> type[Sender]:
    """A Sender whose input ports are these hops."""
    members: dict[str, Any] = {f"on_{port_of(hop)}": _handler(port_of(hop), hop.message) for hop in hops}
    members |= {"hops": tuple(hops), "__module__": __name__, "__doc__": Sender.__doc__}
    members["__annotations__"] = {"hops": "ClassVar[tuple[Hop, ...]]"}
    return type("Sender", (Sender,), members)


def _handler(port: str, message_type: type[Message]) -> Callable[[Sender, Message], None]:
    def on(self: Sender, message: Message) -> None:
        self.send(port, message)

    on.__annotations__ = {"message": message_type, "return": None}
    return on
