"""Link: one contact with the outside. Sources bring records in, sinks take messages out, taps see every edge.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from typing_extensions import TypeVar

from flow.message import Message
from flow.stage import Node, S, Settings

TRUTH_TOPICS = "/truth"
"""Topics that start so hold what an evaluation compares with; no source may bring them in (`flow.graph` refuses)."""

RUN_TOPICS = "/run/"
"""Topics that start so hold what a live run recorded of itself (`flow.consumption`); they are no node's either."""


@dataclass(frozen=True, slots=True)
class Record:
    """Raw bytes as they entered: what a recording keeps and what `Source.decode` takes."""

    topic: str
    arrival_ns: int  # on the host
    stamp_ns: int  # when it was measured, on the host's timeline
    data: bytes
    sequence: int = 0  # one counter over the whole recording


class LinkError(Exception):
    """A link cannot do its work. The text says what to check; it is shown to the user without a traceback."""


class Link(Node[S]):
    """Base of all links: sources (records in), sinks (`on_<port>`), or both, as a servo is."""

    def sent(self) -> Iterable[Record]:
        """What went out since the call before, for the recording; the live runner asks after each `on_<port>`."""
        return ()

    @property
    def trouble(self) -> str | None:
        """What does not work now, in words, where the link cannot raise it; the live runner says it when it changes."""
        return None

    def orphaned(self, port: str) -> str | None:
        """The stage behind an input works no more (live): what was done about it, in words. None: nothing need be."""
        return None


class SourceSettings(Settings):
    """Settings that every source has."""

    topic: str


SourceS = TypeVar("SourceS", bound=SourceSettings, default=SourceSettings, covariant=True)


class Source(Link[SourceS]):
    """A link that brings records in.

    Live, `listen` opens the hardware and yields records; in replay they come from a recording by `topic`.
    Both go through the same `decode`, whose annotation declares the outputs.
    """

    silent_after_s: ClassVar[float | None] = None  # one that has spoken and then says nothing for so long is in trouble

    @property
    def topic(self) -> str:
        """Topic of its records, `settings.topic`."""
        return self.settings.topic

    def decode(self, record: Record) -> Any:
        """Messages of one record: None, one message, or an iterable of messages."""
        raise NotImplementedError

    @property
    def senders(self) -> dict[str, dict[str, str]]:
        """What is known of who sends, by topic: a live recording says it with the topic's channel."""
        return {}

    def listen(self) -> AbstractContextManager[Iterator[Record]]:
        """Open the hardware: `with link.listen() as records`. Errors are LinkError.

        The context may be left by another thread: the records then end, at the latest after 0.5 s.
        """
        raise NotImplementedError(f"{type(self).__name__} cannot run live")


@dataclass(frozen=True, slots=True)
class Run:
    """What a tap is told when a run starts."""

    out_dir: Path
    name: str
    mermaid: str  # the graph as text
    settings_yaml: str  # the configuration as run
    live: bool = False  # else it replays a recording
    senders: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])  # by topic, of live sources


class Tap(Link[S]):
    """A link that sees every message on every edge, in the order of the run, without the stages knowing.

    It is declared in YAML beside the other links, without inputs. It may not change a message, and what it
    raises stops a replay: a tap that can fail for outside reasons (disk, viewer) handles that itself and counts it.
    In a live run `see` is called from one thread of the tap's own, behind a queue that drops the oldest.
    """

    def open(self, run: Run) -> None:
        """Called once before the first message."""

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """One message, once, as it leaves `output` ("track.drone_fix"); arrival_ns is the run's clock."""

    def wants(self, message: type[Message]) -> bool:
        """Whether a run shall hand over messages of this type; asked once for each output."""
        return True

    def record(self, record: Record) -> None:
        """One record of a live run as it came in, or as it was sent. Called from many threads; it may not wait."""

    def close(self) -> None:
        """Called once after the last message, also when the run fails."""
