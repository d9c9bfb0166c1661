"""What a preflight observes of the sources of a graph: record statistics, counters, statuses and messages.

The checks read these classes. They are filled in the same way from live hardware and from a recording (`collect.py`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from flow.counters import Counters
from flow.link import Link, Record
from flow.message import Message
from links.preflight.record_statistics import RecordStatistics

M = TypeVar("M", bound=Message)


class Observation:
    """Raw records of one source, by topic. A driver subclasses it to keep what its checks need."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.topics: defaultdict[str, RecordStatistics] = defaultdict(RecordStatistics)

    @property
    def records(self) -> RecordStatistics:
        """Statistics of the source's main topic."""
        return self.topics[self.topic]

    @property
    def recorded_gb_per_hour(self) -> float | None:
        """Disk space that a recording of this source takes [GB/h]; None: negligible."""
        return None

    def add(self, record: Record) -> None:
        """Take one record of any of the source's topics."""
        self.topics[record.topic].add(record)


@dataclass(frozen=True, slots=True)
class ObservedSource:
    """One source of the graph and everything observed of it."""

    name: str
    link: Link
    observation: Observation
    counters: Counters
    status: str | None  # error text of the link; None: it works
    end_ns: int  # end of the observation, host time
    live: bool

    @property
    def no_data_reason(self) -> str:
        """Why no record arrived, as a sentence without a full stop."""
        if self.status is not None:
            return self.status
        return "nothing came" if self.live else f"the recording holds nothing on {self.observation.topic}"


@dataclass(frozen=True, slots=True)
class Observations:
    """Everything observed of a graph: its sources and the messages that checks compare."""

    sources: tuple[ObservedSource, ...]
    messages: Mapping[type[Message], list[Any]]
    live: bool
    rig: Mapping[str, Any] = field(default_factory=dict[str, Any])  # the `rig` section of the configuration

    def of(self, kind: type[Link]) -> list[ObservedSource]:
        """The sources whose link is a `kind`."""
        return [source for source in self.sources if isinstance(source.link, kind)]

    def all(self, kind: type[M]) -> list[M]:
        """The messages of one type, oldest first."""
        return self.messages.get(kind, [])
