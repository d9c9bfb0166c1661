"""The sending end of a hop: a link that sends messages to one other host (`flow.config.hosts`)."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

from flow import link
from flow.config.hosts import Hop, port_of
from flow.link import Record, SourceSettings
from flow.message import Message
from links.zenoh.connection import ZenohConnection, connected
from links.zenoh.output_queue import OutputQueue
from links.zenoh.peer_clock import PeerClock
from links.zenoh.session_settings import SessionSettings, key_of

JOIN_S = 0.2  # limit of waiting for the threads; a blocked one ends later


class SenderSettings(SourceSettings):
    """Settings of `Sender`."""

    session: SessionSettings
    to: str


class Sender(link.Source[SenderSettings]):
    """Sends messages to one host. It has no records: `listen` is the time for which it is connected.

    Not for YAML: `sender_class` creates its inputs.
    """

    hops: ClassVar[tuple[Hop, ...]] = ()

    def __init__(self, settings: SenderSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._queues: dict[str, OutputQueue] = {}
        self._connection: ZenohConnection | None = None
        self._clock: PeerClock | None = None
        self._unopened: int = 0
        for hop in self.hops:
            deadline_ns = round(hop.queue.deadline_ms * 1e6)
            self._queues[port_of(hop)] = OutputQueue(key_of(hop), hop.message, hop.queue.depth, deadline_ns)

    def send(self, port: str, message: Message) -> None:
        """Queue a message; before the link is open it is dropped."""
        if self._connection is None:
            self._unopened += 1
        else:
            self._queues[port].put(message)

    def decode(self, record: Record) -> None:
        """A sender has no records."""

    @contextmanager
    def listen(self) -> Iterator[Iterator[Record]]:
        """Connect to the other host. Raises LinkError when a certificate or the library is missing."""
        closing = threading.Event()
        with connected(self.settings.session) as connection:
            self._connection, self._clock = connection, connection.clocks[self.settings.to]
            threads = [
                threading.Thread(target=queue.run, args=(connection, closing), name=f"send {queue.key}", daemon=True)
                for queue in self._queues.values()
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
        """Totals since the start over all outputs, and the clock offset (local - peer) with the bound of its error.

        Dropped, late and failed by output, too, where there were any.
        """
        counts = {queue.key.split("/", 3)[3].replace("/", "."): queue.counts for queue in self._queues.values()}
        totals = {
            "sent": sum(c.sent for c in counts.values()),
            "sent bytes": sum(c.sent_bytes for c in counts.values()),
        }
        totals["not open"] = self._unopened
        for what in ("dropped", "late", "failed"):
            numbers = {name: getattr(c, what) for name, c in counts.items()}
            totals[what] = sum(numbers.values())
            totals |= {f"{what}: {name}": number for name, number in numbers.items() if number}
        return totals if self._clock is None else totals | self._clock.counters

    @property
    def status(self) -> str | None:
        """See Link: error text of the connection, missing subscribers, or an invalid message."""
        settings = self.settings
        if self._connection is None:
            return None
        error = self._connection.status_of(settings.to)
        if error is not None or self._connection.clocks[settings.to].reply_ns is None:
            return error
        without_subscriber = [queue.key for queue in self._queues.values() if not queue.has_subscriber]
        if without_subscriber:
            keys = ", ".join(without_subscriber)
            return f"{settings.to} does not subscribe to {keys}: is it running, with the same hosts file?"
        return next((queue.status for queue in self._queues.values() if queue.status), None)


def _nothing_until(closing: threading.Event) -> Iterator[Record]:
    closing.wait()
    yield from ()


def sender_class(hops: list[Hop]) -> type[Sender]:
    """A subclass of Sender whose inputs are these hops."""
    members: dict[str, Any] = {f"on_{port_of(hop)}": _handler(port_of(hop), hop.message) for hop in hops}
    members |= {"hops": tuple(hops), "__module__": __name__, "__doc__": Sender.__doc__}
    members["__annotations__"] = {"hops": "ClassVar[tuple[Hop, ...]]"}
    return type("Sender", (Sender,), members)


def _handler(port: str, message_type: type[Message]) -> Callable[[Sender, Message], None]:
    def on(self: Sender, message: Message) -> None:
        self.send(port, message)

    on.__annotations__ = {"message": message_type, "return": None}
    return on
