"""The receiving end of a hop: a source that replaces a node of another host (`flow.config.hosts`).

Source: ours.
"""

from __future__ import annotations

import contextlib
import queue
import struct
import threading
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ClassVar, Union

from flow import link
from flow.config.hosts import Hop
from flow.link import LinkError, Record, SourceSettings
from flow.message import Message
from flow.remote.codec import decode
from flow.remote.codec_fields import CodecError
from flow.remote.timeline import in_local_time
from links.host_time import now_ns
from links.zenoh.connection import Connection, Opened, connected
from links.zenoh.peer_clock import PeerClock
from links.zenoh.session import Session, key_of
from links.zenoh.wire import RECORD_HEAD, read_envelope

if TYPE_CHECKING:
    import zenoh

WAKE_S = 0.05
JOIN_S = 0.3
COUNTED = ("received", "lost", "before the clock was known", "without an envelope", "at no possible time")
RING = 256  # messages that wait for Python: more than the usual deadline of a LiDAR's packets, a bound on memory


class ReceiverSettings(SourceSettings):
    """Settings of `Receiver`."""

    session: Session
    sender: str  # host


class Receiver(link.Source[ReceiverSettings]):
    """Brings in what a node of another host gives, told in this host's time.

    Not for YAML (`receiver_class` makes its outputs), and so not in the schema, which knows `class Name(Source)`.
    """

    hops: ClassVar[tuple[Hop, ...]] = ()
    expected: ClassVar[Mapping[str, type[Message]]] = {}

    def __init__(self, settings: ReceiverSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._connection: Connection | None = None
        self._clock: PeerClock | None = None
        self._counts: Counter[str] = Counter()
        self._counting: Any = threading.Lock()
        self._newest: dict[str, tuple[int, int]] = {}  # key -> run and number of the newest

    def decode(self, record: Record) -> Message:
        """The message of one record. LinkError: it is none that this receiver expects."""
        try:
            offset_ns, uncertainty_ns = RECORD_HEAD.unpack_from(record.data)
            message = decode(record.data, self.expected, RECORD_HEAD.size)
            return in_local_time(message, offset_ns, uncertainty_ns)
        except (CodecError, OverflowError, struct.error) as error:
            raise LinkError(f"{self.settings.topic}: what {self.settings.sender} sent is refused: {error}") from None

    @contextmanager
    def listen(self) -> Iterator[Iterator[Record]]:
        """Hear the other host. LinkError: a certificate or the library is missing."""
        closing = threading.Event()
        records: queue.Queue[Record] = queue.Queue(len(self.hops))
        with connected(self.settings.session) as connection:
            self._connection, self._clock = connection, connection.clocks[self.settings.sender]
            threads = [
                threading.Thread(target=self._hear, args=(connection, hop, records, closing), daemon=True)
                for hop in self.hops
            ]
            for thread in threads:
                thread.start()
            try:
                yield _until(closing, records)
            finally:
                self._connection = None
                closing.set()
                for thread in threads:
                    thread.join(JOIN_S / len(threads))

    def _hear(self, connection: Connection, hop: Hop, records: queue.Queue[Record], closing: threading.Event) -> None:
        """Take one output's messages as they come, session after session; the thread of a hop runs this."""
        import zenoh

        while not closing.is_set():
            opened = connection.opened(WAKE_S)
            if opened is None:
                continue
            with contextlib.suppress(zenoh.ZError):  # the subscriber has ended, with us or with its session
                self._hear_on(connection, opened, hop, records, closing)

    def _hear_on(
        self,
        connection: Connection,
        opened: Opened,
        hop: Hop,
        records: queue.Queue[Record],
        closing: threading.Event,
    ) -> None:
        """Take messages until the session ends: then `recv` raises ZError."""
        import zenoh

        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(min(hop.queue.depth, RING))
        subscriber = opened.session.declare_subscriber(key_of(hop), ring)
        threading.Thread(target=_end, args=(subscriber, closing, opened.over), daemon=True).start()
        handler = subscriber.handler  # the subscriber itself cannot be ended while it waits in `recv`
        while not closing.is_set():
            record = self._taken(connection, key_of(hop), handler.recv())
            if record is not None:
                _hand_over(record, records, closing)

    def _taken(self, connection: Connection, key: str, sample: zenoh.Sample) -> Record | None:
        arrival_ns = now_ns()
        attachment = sample.attachment
        envelope = read_envelope(None if attachment is None else attachment.to_bytes())
        if envelope is None:
            self._count("without an envelope")
            return None
        run, number = self._newest.get(key, (envelope.run, envelope.number - 1))  # before, nobody was here to hear it
        if run == envelope.run:
            self._count("lost", max(envelope.number - number - 1, 0))
        self._newest[key] = envelope.run, envelope.number
        difference = connection.clocks[self.settings.sender].heard(envelope.run, envelope.sent_ns, arrival_ns)
        if difference is None:
            self._count("before the clock was known")
            return None
        stamp_ns = envelope.stamp_ns + difference.offset_ns
        if not (0 <= stamp_ns < 2**63 and abs(difference.offset_ns) < 2**63):
            self._count("at no possible time")
            return None
        self._count("received")
        return Record(
            self.settings.topic, arrival_ns, stamp_ns, RECORD_HEAD.pack(*difference) + sample.payload.to_bytes()
        )

    def _count(self, what: str, by: int = 1) -> None:
        with self._counting:
            self._counts[what] += by

    @property
    def counters(self) -> dict[str, int]:
        """Totals since the start, and the other host's clock: ours - theirs, and what that is wrong by at most."""
        counts = {name: self._counts[name] for name in COUNTED}
        difference = None if self._clock is None else self._clock.difference
        if self._clock is not None and difference is not None:
            counts["clock offset [us]"] = difference.offset_ns // 1000
            counts["clock uncertainty [us]"] = difference.uncertainty_ns // 1000
            counts["restarts of the other host"] = self._clock.restarts
        return counts

    @property
    def status(self) -> str | None:
        """What is wrong on the way from the other host."""
        return None if self._connection is None else self._connection.status_with(self.settings.sender)


def _until(closing: threading.Event, records: queue.Queue[Record]) -> Iterator[Record]:
    while not closing.is_set():
        try:
            yield records.get(timeout=WAKE_S)
        except queue.Empty:
            continue


def _hand_over(record: Record, records: queue.Queue[Record], closing: threading.Event) -> None:
    """Wait until the record is taken: meanwhile the ring keeps the newest of the others."""
    while not closing.is_set():
        try:
            records.put(record, timeout=WAKE_S)
            return
        except queue.Full:
            continue


def _end(subscriber: zenoh.Subscriber[Any], closing: threading.Event, over: threading.Event) -> None:
    """End a subscriber with its receiver or its session. Else its `recv` waits for ever."""
    import zenoh

    while not (closing.wait(WAKE_S) or over.is_set()):
        pass
    with contextlib.suppress(zenoh.ZError):  # the session has closed
        subscriber.undeclare()


def receiver_class(hops: list[Hop]) -> type[Receiver]:
    """A Receiver whose outputs are these hops' messages."""

    def decode(self: Receiver, record: Record) -> Message:
        return Receiver.decode(self, record)

    decode.__annotations__ = {"record": Record, "return": Union[tuple(hop.message for hop in hops)]}  # noqa: UP007
    members: dict[str, Any] = {
        "decode": decode,
        "hops": tuple(hops),
        "__module__": __name__,
        "__doc__": Receiver.__doc__,
    }
    members["expected"] = {hop.message.__name__: hop.message for hop in hops}
    members["__annotations__"] = {
        "hops": "ClassVar[tuple[Hop, ...]]",
        "expected": "ClassVar[Mapping[str, type[Message]]]",
    }
    return type("Receiver", (Receiver,), members)
