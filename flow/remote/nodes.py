"""What a replay needs of nodes that run in other processes: their outputs, failures and reports.

`flow.subprocess_replay` implements `RemoteNodes`.

Source: ours.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, NamedTuple, Protocol

from flow.counters import Counters
from flow.events import Event
from flow.link import LinkError
from flow.message import Message
from flow.metrics import Latency


class RemoteFailure(NamedTuple):
    """What a remote node raised."""

    node: str
    error: Exception
    cause: BaseException | None  # of the error


class RemoteOutputs(NamedTuple):
    """Outputs of remote nodes for one record, or for the end of one of them, in order."""

    messages: list[tuple[str, Message | None]]  # output, message; None: one that no node or tap here takes
    failure: RemoteFailure | None = None  # after the last of them


class Refusal(NamedTuple):
    """The first record that a source without data could not decode."""

    arrival_ns: int
    error: LinkError


class PartitionReport(NamedTuple):
    """What remote nodes did in the whole run."""

    steps: int
    compute: dict[str, Latency]  # by node
    events: list[Event]
    counters: dict[str, Counters]  # by node
    hashes: dict[str, str]  # of their outputs, as `Digest` computes them

    def to_json(self) -> dict[str, Any]:
        """Plain values, for `of_json`."""
        compute = {name: latency.to_list() for name, latency in self.compute.items()}
        counters = {name: counts.to_json() for name, counts in self.counters.items()}
        events = [asdict(event) for event in self.events]
        return {**self._asdict(), "compute": compute, "events": events, "counters": counters}

    @staticmethod
    def of_json(values: dict[str, Any]) -> PartitionReport:
        """The report that `to_json` wrote."""
        return PartitionReport(
            steps=values["steps"],
            compute={name: Latency.of_list(counts) for name, counts in values["compute"].items()},
            events=[Event(**fields) for fields in values["events"]],
            counters={name: Counters.of_json(counts) for name, counts in values["counters"].items()},
            hashes=values["hashes"],
        )


class RemoteNodes(Protocol):
    """Nodes that run in other processes, in partitions: each node that feeds one of them is one of them too."""

    nodes: frozenset[str]
    topics: frozenset[str]  # of the sources among them

    def outputs_of(self, topic: str) -> RemoteOutputs:
        """Their outputs for the next record of one of their topics."""
        ...

    def end(self, last_ns: int) -> list[Refusal]:
        """Announce the end of the records. Returns the sources of which no record could be decoded."""
        ...

    def finish(self, node: str) -> RemoteOutputs:
        """Their outputs at the end of a stage; called for each stage, in order."""
        ...

    def reports(self) -> list[PartitionReport]:
        """Measurements of all partitions; called last."""
        ...
