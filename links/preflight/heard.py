"""What was heard while a preflight listened: a tap that takes records and keeps the few messages that checks compare.

Source: ours.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar, cast

from flow.link import Link, Record, Source, Tap
from flow.message import Message
from links.preflight.seen import Seen, seen_for
from stages import messages

KEPT: tuple[type[Message], ...] = (
    messages.AutopilotEstimator,
    messages.AutopilotStatus,
    messages.DroneAttitude,
    messages.DroneFix,
    messages.DroneImu,
    messages.DroneLocalPosition,
    messages.DroneOdometry,
    messages.VehicleMotion,
)
MOST_MESSAGES = 20_000  # of a type, the newest

M = TypeVar("M", bound=Message)


class Ear(Tap):
    """Hears every record and the messages of interest; from many threads, each topic from one."""

    def __init__(self) -> None:
        super().__init__()
        self._by_topic: dict[str, Seen] = {}
        self._topics: dict[str, str] = {}  # of the sources, by name
        self._messages: defaultdict[type[Message], deque[Message]] = defaultdict(lambda: deque(maxlen=MOST_MESSAGES))

    def attach(self, sources: Mapping[str, Source]) -> None:
        """Say whose records will come."""
        self._by_topic = {source.topic: seen_for(source) for source in sources.values()}
        self._topics = {name: source.topic for name, source in sources.items()}

    def wants(self, message: type[Message]) -> bool:
        """See Tap."""
        return message in KEPT

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """See Tap."""
        if type(message) in KEPT:
            self._messages[type(message)].append(message)

    def record(self, record: Record) -> None:
        """See Tap. A side topic, as /lidar/position, is with the source whose topic has the same first word."""
        seen = self._by_topic.get(record.topic)
        if seen is None:
            room = record.topic.rpartition("/")[0] + "/"
            seen = next((s for topic, s in self._by_topic.items() if topic.startswith(room) and room != "/"), None)
        if seen is not None:
            seen.take(record)

    def seen(self, name: str) -> Seen:
        """What came from the source of that name."""
        return self._by_topic[self._topics[name]]

    def messages(self, kind: type[M]) -> list[M]:
        """The newest messages of a type, oldest first."""
        return cast("list[M]", list(self._messages[kind]))


@dataclass(frozen=True, slots=True)
class Heard:
    """One source's part of what was heard."""

    name: str
    link: Link
    seen: Seen
    counters: Mapping[str, int]
    status: str | None  # what the link itself says is wrong
    end_ns: int  # until when was listened
    live: bool

    @property
    def silence(self) -> str:
        """Why nothing came, in words."""
        if self.status is not None:
            return self.status
        return "nothing came" if self.live else f"the recording holds nothing on {self.seen.topic}"


@dataclass(frozen=True, slots=True)
class AllHeard:
    """What was heard of every source, and the messages."""

    sources: tuple[Heard, ...]
    messages: Mapping[type[Message], list[Any]]
    live: bool

    def of(self, kind: type[Link]) -> list[Heard]:
        """The sources of one class."""
        return [heard for heard in self.sources if isinstance(heard.link, kind)]

    def all(self, kind: type[M]) -> list[M]:
        """The messages of one type."""
        return self.messages.get(kind, [])
