"""Links connect a graph to the outside. Sources bring records in, sinks send messages out, taps receive every message.

Source: ours.
"""

from __future__ import annotations

import select
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol

from typing_extensions import TypeVar

from flow.message import Message
from flow.stage import Node, S, Settings

TRUTH_TOPICS = "/truth"
"""Prefix of topics that hold the truth, for evaluation; no source may bring them in (`flow.graph` checks it)."""

WAKE_S = 0.2
"""The longest wait before a source is polled again, and before a waiting thread checks whether it was closed."""

RUN_TOPICS = "/run/"
"""Prefix of topics that a live run records about itself (`flow.live.input_order`); no source may bring them in."""


@dataclass(frozen=True, slots=True)
class Record:
    """Raw bytes as they entered: what a recording holds and what `Source.decode` takes."""

    topic: str
    arrival_ns: int  # on the host
    stamp_ns: int  # of the measurement, on the host's clock
    data: bytes
    sequence: int = 0  # one counter over the whole recording


class LinkError(Exception):
    """A link cannot work. Its text, shown without a traceback, names what to check."""


class Link(Node[S]):
    """Base of all links: sources (records in), sinks (`on_<port>`), or both, as a servo is."""

    def sent(self) -> Iterable[Record]:
        """What was sent since the call before, for the recording; the live runner calls it after each `on_<port>`."""
        return ()

    @property
    def status(self) -> str | None:
        """What does not work now, where the link cannot raise it; None: all works. A live run reports each change."""
        return None

    def upstream_lost(self, port: str) -> str | None:
        """React to the end of the stage behind an input (live). The reaction as text; None: no reaction is needed."""
        return None

    def upstream_restarted(self, port: str) -> str | None:
        """React to a restart of the stage behind an input (live), which has lost what it knew; as `upstream_lost`."""
        return None


class SourceSettings(Settings):
    """Settings that every source has."""

    topic: str


class Readable(Protocol):
    """What `select` can wait for."""

    def fileno(self) -> int:
        """The file descriptor."""
        ...


class PolledRecords(ABC, Iterator[Record]):
    """What `Source.listen` gives where nothing blocks but waiting for `files`.

    The iterator waits. A thread that does other work too waits for `files`, at most `wait_s`, and takes `pending`.
    """

    def __init__(self) -> None:
        self.closed = threading.Event()
        """Set by any thread: the iterator ends within WAKE_S."""
        self._arrived: deque[Record] = deque()
        self._error: LinkError | None = None  # raised after the records that came before it

    @property
    def files(self) -> Sequence[Readable]:
        """Readable when records have arrived; they may change."""
        return ()

    @property
    def wait_s(self) -> float:
        """The longest wait before `pending` must be called."""
        return WAKE_S

    @abstractmethod
    def pending(self) -> Iterable[Record]:
        """Records that have arrived, without waiting; more may be left. LinkError: the source has failed."""

    def __next__(self) -> Record:
        while not self._arrived:
            if self.closed.is_set():
                raise StopIteration
            if self._error is not None:
                raise self._error
            try:
                select.select(self.files, [], [], self.wait_s)
                self._arrived.extend(self.pending())
            except LinkError as error:
                self._error = error
            except (OSError, ValueError):  # a file is closed by another thread
                if self.closed.is_set():
                    raise StopIteration from None
                raise
        return self._arrived.popleft()


SourceS = TypeVar("SourceS", bound=SourceSettings, default=SourceSettings, covariant=True)


class Source(Link[SourceS]):
    """A link that brings records in.

    Live, `listen` opens the hardware and iterates over records; in replay they come from a recording by `topic`.
    Both go through the same `decode`, whose annotation declares the outputs. It takes records of `replay_topics`: its
    own topic, and in replay what it sent itself, which it knows live without a record.
    """

    silent_after_s: ClassVar[float | None] = None  # a source that has sent records and then none for so long has failed
    polled: ClassVar[bool] = False  # `listen` gives PolledRecords: live it can share a thread with stages

    @property
    def topic(self) -> str:
        """Topic of its records, `settings.topic`."""
        return self.settings.topic

    @property
    def replay_topics(self) -> tuple[str, ...]:
        """Topics of the records that `decode` takes in replay."""
        return (self.topic,)

    def decode(self, record: Record) -> Any:
        """Messages of one record: None, one message, or an iterable of messages."""
        raise NotImplementedError

    @property
    def senders(self) -> dict[str, dict[str, str]]:
        """Properties of the sender, by topic; a live recording stores them with the topic's channel."""
        return {}

    def listen(self) -> AbstractContextManager[Iterator[Record]]:
        """Open the hardware: `with link.listen() as records`. Errors are LinkError.

        The context may be left by another thread: the records then end, at the latest after 0.5 s.
        """
        raise NotImplementedError(f"{type(self).__name__} cannot run live")


@dataclass(frozen=True, slots=True)
class Run:
    """The run that a tap is opened for."""

    out_dir: Path
    name: str
    mermaid: str  # the graph as text
    settings_yaml: str  # the merged configuration
    live: bool = False  # False: a replay
    senders: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])  # by topic, of live sources


class Tap(Link[S]):
    """A link that receives every message of every output, in the order of the run.

    It is declared in YAML among the other links, without inputs. It must not change a message. What it raises stops a
    replay, so a tap that can fail for outside reasons (disk, viewer) handles and counts such failures itself. In a live
    run one thread of the tap's own calls `see`, behind a queue that drops the oldest message.
    """

    def open(self, run: Run) -> None:
        """Called once before the first message."""

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Take one message of `output` ("track.drone_fix"); arrival_ns is the run's clock."""

    def wants(self, message: type[Message]) -> bool:
        """Whether the tap takes messages of this type; called once for each output."""
        return True

    def record(self, record: Record) -> None:
        """Take one record of a live run, received or sent. Called from many threads; it must not block."""

    def close(self) -> None:
        """Called once after the last message, also when the run fails."""
