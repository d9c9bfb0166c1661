"""Which host runs which stages and links: an overlay on a checked graph. Without it one host runs all of them.

    hosts:
      vehicle: {listen: "tls/192.168.7.1:7447", certificate: vehicle.pem, key: vehicle.key, authority: ca.pem}
      drone: {certificate: drone.pem, key: drone.key, authority: ca.pem}
      base: {certificate: base.pem, key: base.key, authority: ca.pem}
    placement: {lidar: vehicle, sweep: vehicle, camera_drone: drone, vp_drone: drone, viewer: base, ...}
    taps: {viewer: [track.drone_fix, fuse.relative_pose]}  # outputs of other hosts for a tap; default: all it wants

One host, the hub, listens; all others connect to it. So an edge between hosts is one hop to or from the hub, or two
hops through it. `flow.config.hosts_file` reads the file. `graph_of_host` returns the graph of one host: its own nodes,
a receiver with the name of each remote node that feeds them, and a sender to each host. Edges keep their name, message
and queue. A cycle through hosts is as legal as it is on one host.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

from flow.config.classes import KINDS
from flow.config.edge import Edge, QueueSettings
from flow.config.node_spec import NodeSpec
from flow.config_error import ConfigError, ErrorDetail, Location, did_you_mean, one_of
from flow.graph import Graph
from flow.message import Message


@dataclass(frozen=True, slots=True)
class Host:
    """One machine: its name is also the common name of its certificate."""

    name: str
    endpoint: str  # tls/ADDRESS:PORT: where the hub listens, or where this host connects to it
    certificate: Path
    key: Path
    authority: Path  # certificate of the authority that signed all hosts' certificates


@dataclass(frozen=True, slots=True)
class Hop:
    """The messages of one output between the hub and another host."""

    producer: str
    output: str
    message: type[Message]
    sender: str  # host
    receiver: str  # host
    queue: QueueSettings


@dataclass(frozen=True, slots=True)
class Hosts:
    """The hosts of a graph's nodes."""

    graph: Graph
    hosts: dict[str, Host]
    hub: str
    placement: dict[str, str]  # node -> host
    hops: tuple[Hop, ...]


class Ends(Protocol):
    """A factory for the nodes at the two ends of a hop; `links.zenoh` has one."""

    def receiver(self, hosts: Hosts, name: str, hops: list[Hop]) -> NodeSpec:
        """A source that replaces node `name` of another host; its outputs are those of `hops`."""
        ...

    def sender(self, hosts: Hosts, name: str, hops: list[Hop]) -> NodeSpec:
        """A sink whose input ports have the names that `port_of` gives."""
        ...


def port_of(hop: Hop) -> str:
    """Input port of a sender: node__output (no output has a double underscore in its name)."""
    return f"{hop.producer}__{hop.output}"


def sender_name(host: str) -> str:
    """Name of the node that sends to a host."""
    return f"to_{host}"


def graph_of_host(hosts: Hosts, name: str, ends: Ends) -> Graph:
    """The graph that host `name` runs. ConfigError: there is no such host."""
    if name not in hosts.hosts:
        text = f"no host '{name}'; there is {one_of(hosts.hosts)}.{did_you_mean(name, hosts.hosts)}"
        raise ConfigError([ErrorDetail(Location("--host", 0), "", text)])
    graph = hosts.graph
    own = {node: spec for node, spec in graph.nodes.items() if hosts.placement[node] == name}
    received = _grouped((hop for hop in hosts.hops if hop.receiver == name), "producer")
    sent = _grouped((hop for hop in hosts.hops if hop.sender == name), "receiver")
    nodes = {node: ends.receiver(hosts, node, hops) for node, hops in received.items()} | own
    nodes |= {sender_name(to): ends.sender(hosts, sender_name(to), hops) for to, hops in sent.items()}
    edges = [edge for edge in graph.edges if edge.consumer in own]
    for to, hops in sent.items():
        edges += [Edge(h.producer, h.output, sender_name(to), port_of(h), h.message, h.queue) for h in hops]
    return Graph(nodes, tuple(edges), None, _values(graph, name, own), graph.left_out)


def _grouped(hops: Iterator[Hop], by: str) -> dict[str, list[Hop]]:
    groups: dict[str, list[Hop]] = {}
    for hop in hops:
        groups.setdefault(getattr(hop, by), []).append(hop)
    return groups


def _values(graph: Graph, name: str, own: Mapping[str, NodeSpec]) -> dict[str, Any]:
    """The configuration for people: the whole one, with only the nodes of this host."""
    values: dict[str, Any] = {"host": name, **graph.values}
    for kind in KINDS:
        declared = cast("dict[str, Any]", graph.values.get(kind) or {})
        values[kind] = {node: value for node, value in declared.items() if node in own}
    return values
