"""The report of a live run: how late each edge is, what it dropped, which deadlines it missed.

Source: ours.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

from flow.config.edge import Edge
from flow.message import Message, message
from flow.metrics import Latency
from flow.replay import RunReport


class EdgeCount:
    """The counts of one edge, kept by its consumer's thread."""

    __slots__ = ("edge", "lag", "missed", "newest_lag_ns")

    def __init__(self, edge: Edge) -> None:
        self.edge = edge
        self.lag = Latency()  # from the arrival of the record that caused a message to the end of its handling
        self.newest_lag_ns = self.missed = 0

    def done(self, lag_ns: int) -> None:
        """Count a message that was handled `lag_ns` after the arrival of the record that caused it."""
        self.lag.add(max(lag_ns, 1))
        self.newest_lag_ns = lag_ns
        if lag_ns > self.edge.queue.deadline_ms * 1e6:
            self.missed += 1


@dataclass(slots=True)
class EdgeReport:
    """The messages of one edge."""

    source: str  # sweep.swept_pulses
    queue: str  # drop_oldest 64
    deadline_ms: float
    taken: int
    dropped: int
    missed: int  # handled after the deadline
    lag_p50_ms: float
    lag_p99_ms: float
    lag_max_ms: float
    lag_ms: float  # of the newest


class LinkState(enum.Enum):
    """State of a source in a live run."""

    OPENING = "opening"
    OPEN = "open"
    FAILED = "failed"  # it is opened again
    CLOSED = "closed"


@dataclass(slots=True)
class LinkReport:
    """State and records of one source."""

    state: LinkState = LinkState.OPENING
    records: int = 0
    openings: int = 0
    undecoded: int = 0  # records whose decoding raised
    reason: str = ""  # why it failed last

    @property
    def state_text(self) -> str:
        """The state for people: why it failed, otherwise the state's name."""
        return self.reason if self.state is LinkState.FAILED else self.state.value


@dataclass(slots=True)
class LiveReport(RunReport):
    """A live run so far."""

    edges: dict[str, EdgeReport] = field(default_factory=dict[str, EdgeReport])  # by the consumer's port
    links: dict[str, LinkReport] = field(default_factory=dict[str, LinkReport])
    restarts: dict[str, int] = field(default_factory=dict[str, int])  # of stages that raised
    failures: dict[str, int] = field(default_factory=dict[str, int])
    switched_off: list[str] = field(default_factory=list[str])  # stages that raised too often
    tap_drops: dict[str, int] = field(default_factory=dict[str, int])
    statuses: dict[str, str] = field(default_factory=dict[str, str])  # what does not work now, by link

    @property
    def dropped(self) -> int:
        """Messages that their consumer never got."""
        return sum(edge.dropped for edge in self.edges.values())

    @property
    def missed(self) -> int:
        """Messages handled after their deadline."""
        return sum(edge.missed for edge in self.edges.values())


@message
class EdgeStatus(Message):
    """The state of an edge of a live run; taps receive one a second for each edge, as `run.<consumer>.<port>`."""

    lag_ms: float  # of the newest message
    dropped: int  # since the start
    missed: int
    waiting: int  # messages in the queue now


def edge_report(count: EdgeCount, dropped: int) -> EdgeReport:
    """The counts of an edge, with times in milliseconds."""
    edge, lag = count.edge, count.lag
    return EdgeReport(
        source=f"{edge.producer}.{edge.output}",
        queue=str(edge.queue),
        deadline_ms=edge.queue.deadline_ms,
        taken=lag.count,
        dropped=dropped,
        missed=count.missed,
        lag_p50_ms=lag.percentile_ns(50) / 1e6,
        lag_p99_ms=lag.percentile_ns(99) / 1e6,
        lag_max_ms=lag.max_ns / 1e6,
        lag_ms=count.newest_lag_ns / 1e6,
    )
