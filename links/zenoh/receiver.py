"""The receiving end of a hop: a source that replaces a node of another host (`flow.config.hosts`)."""

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
from links.clock.host_time import now_ns
from links.zenoh.connection import OpenSession, ZenohConnection, connected
from links.zenoh.envelope import RECORD_HEAD, read_envelope
from links.zenoh.peer_clock import PeerClock
from links.zenoh.session_settings import SessionSettings, key_of

if TYPE_CHECKING:
    import zenoh

WAKE_S = 0.05
JOIN_S = 0.3
COUNTED = ("received", "lost", "clock unknown", "without envelope", "invalid time")
RING = 256  # messages buffered for Python, a bound of memory: more than within the deadline of LiDAR packets


class ReceiverSettings(SourceSettings):
    """Settings of `Receiver`."""

    session: SessionSettings
    sender: str  # host


class Receiver(link.Source[ReceiverSettings]):
    """Receives the outputs of a node of another host, with stamps converted to this host's time.

    Not for YAML: `receiver_class` creates its outputs.
    """

    hops: ClassVar[tuple[Hop, ...]] = ()
    expected: ClassVar[Mapping[str, type[Message]]] = {}

    def __init__(self, settings: ReceiverSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._connection: ZenohConnection | None = None
        self._clock: PeerClock | None = None
        self._counts: Counter[str] = Counter()
        self._counting: Any = threading.Lock()
        self._newest: dict[str, tuple[int, int]] = {}  # key -> run and number of the newest message

    def decode(self, record: Record) -> Message:
        """The message of one record. Raises LinkError for a message that this receiver does not expect."""
        try:
            offset_ns, uncertainty_ns = RECORD_HEAD.unpack_from(record.data)
            message = decode(record.data, self.expected, RECORD_HEAD.size)
            return in_local_time(message, offset_ns, uncertainty_ns)
        except (CodecError, OverflowError, struct.error) as error:
            raise LinkError(f"{self.settings.topic}: invalid message from {self.settings.sender}: {error}") from None

    @contextmanager
    def listen(self) -> Iterator[Iterator[Record]]:
        """Receive from the other host. Raises LinkError when a certificate or the library is missing."""
        closing = threading.Event()
        records: queue.Queue[Record] = queue.Queue(len(self.hops))
        with connected(self.settings.session) as connection:
            self._connection, self._clock = connection, connection.clocks[self.settings.sender]
            threads = [
                threading.Thread(target=self._receive, args=(connection, hop, records, closing), daemon=True)
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

    def _receive(
        self, connection: ZenohConnection, hop: Hop, records: queue.Queue[Record], closing: threading.Event
    ) -> None:
        """Receive one output's messages, session after session; runs in the thread of a hop."""
        import zenoh

        while not closing.is_set():
            opened = connection.opened(WAKE_S)
            if opened is None:
                continue
            with contextlib.suppress(zenoh.ZError):  # the subscriber has ended, by us or with its session
                self._receive_on(connection, opened, hop, records, closing)

    def _receive_on(
        self,
        connection: ZenohConnection,
        opened: OpenSession,
        hop: Hop,
        records: queue.Queue[Record],
        closing: threading.Event,
    ) -> None:
        """Receive until the session ends: then `recv` raises ZError."""
        import zenoh

        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(min(hop.queue.depth, RING))
        subscriber = opened.session.declare_subscriber(key_of(hop), ring)
        threading.Thread(target=_end, args=(subscriber, closing, opened.ended), daemon=True).start()
        handler = subscriber.handler  # the subscriber cannot be undeclared while it waits in `recv`
        while not closing.is_set():
            record = self._record(connection, key_of(hop), handler.recv())
            if record is not None:
                _hand_over(record, records, closing)

    def _record(self, connection: ZenohConnection, key: str, sample: zenoh.Sample) -> Record | None:
        arrival_ns = now_ns()
        attachment = sample.attachment
        envelope = read_envelope(None if attachment is None else attachment.to_bytes())
        if envelope is None:
            self._count("without envelope")
            return None
        run, number = self._newest.get(key, (envelope.run, envelope.number - 1))  # earlier messages were not expected
        if run == envelope.run:
            self._count("lost", max(envelope.number - number - 1, 0))
        self._newest[key] = envelope.run, envelope.number
        clock_offset = connection.clocks[self.settings.sender].on_message(envelope.run, envelope.sent_ns, arrival_ns)
        if clock_offset is None:
            self._count("clock unknown")
            return None
        stamp_ns = envelope.stamp_ns + clock_offset.offset_ns
        if not (0 <= stamp_ns < 2**63 and abs(clock_offset.offset_ns) < 2**63):
            self._count("invalid time")
            return None
        self._count("received")
        return Record(
            self.settings.topic, arrival_ns, stamp_ns, RECORD_HEAD.pack(*clock_offset) + sample.payload.to_bytes()
        )

    def _count(self, what: str, by: int = 1) -> None:
        with self._counting:
            self._counts[what] += by

    @property
    def counters(self) -> dict[str, int]:
        """Totals since the start, and the clock offset (local - peer) with the bound of its error."""
        counts = {name: self._counts[name] for name in COUNTED}
        return counts if self._clock is None else counts | self._clock.counters

    @property
    def status(self) -> str | None:
        """See Link: error text of the connection to the other host."""
        return None if self._connection is None else self._connection.status_of(self.settings.sender)


def _until(closing: threading.Event, records: queue.Queue[Record]) -> Iterator[Record]:
    while not closing.is_set():
        try:
            yield records.get(timeout=WAKE_S)
        except queue.Empty:
            continue


def _hand_over(record: Record, records: queue.Queue[Record], closing: threading.Event) -> None:
    """Wait until the record is taken; meanwhile the ring keeps the newest messages."""
    while not closing.is_set():
        try:
            records.put(record, timeout=WAKE_S)
            return
        except queue.Full:
            continue


def _end(subscriber: zenoh.Subscriber[Any], closing: threading.Event, ended: threading.Event) -> None:
    """Undeclare a subscriber when its receiver or session ends; otherwise its `recv` blocks forever."""
    import zenoh

    while not (closing.wait(WAKE_S) or ended.is_set()):
        pass
    with contextlib.suppress(zenoh.ZError):  # the session has closed
        subscriber.undeclare()


def receiver_class(hops: list[Hop]) -> type[Receiver]:
    """A subclass of Receiver whose outputs are the messages of these hops."""

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
