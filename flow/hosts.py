"""Hosts: which machine runs which stages and links. An overlay on a checked graph; without it all run on one.

    hosts:
      vehicle: {listen: "tls/192.168.7.1:7447", certificate: vehicle.pem, key: vehicle.key, authority: ca.pem}
      drone: {certificate: drone.pem, key: drone.key, authority: ca.pem}
      base: {certificate: base.pem, key: base.key, authority: ca.pem}
    place: {lidar: vehicle, sweep: vehicle, camera_drone: drone, vp_drone: drone, viewer: base, ...}
    see: {viewer: [track.drone_fix, fuse.relative_pose]}  # what a tap gets of other hosts; else all that it wants

One host listens: the hub. All others connect to it, so every edge that crosses is one hop to or from the hub, or two;
between two others the hub hands on. `flow.hosts_file` reads the file, `part_of` gives the graph of one host: its own
nodes, a receiver in the place (and with the name) of each node elsewhere that something here listens to, a sender to
each host. No edge changes otherwise: it keeps its name, its message and how messages wait on it. A cycle through hosts
is as legal as it was without.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

from flow.classes import KINDS
from flow.edge import Edge, Waiting
from flow.graph import Graph
from flow.message import Message
from flow.node_spec import NodeSpec
from flow.problem import ConfigError, Place, Problem, did_you_mean, one_of


@dataclass(frozen=True, slots=True)
class Host:
    """One machine: its name is also the common name of its certificate."""

    name: str
    endpoint: str  # tls/ADDRESS:PORT: where the hub listens, or where this host finds it
    certificate: Path
    key: Path
    authority: Path  # certificate of the authority that signed all hosts' certificates


@dataclass(frozen=True, slots=True)
class Hop:
    """One output on its way between the hub and another host."""

    producer: str
    output: str
    message: type[Message]
    sender: str  # host
    receiver: str  # host
    waiting: Waiting


@dataclass(frozen=True, slots=True)
class Hosts:
    """A graph's nodes placed on hosts."""

    graph: Graph
    hosts: dict[str, Host]
    hub: str
    place: dict[str, str]  # node -> host
    hops: tuple[Hop, ...]


class Ends(Protocol):
    """What makes the nodes at the two ends of a hop; `links.zenoh` has one."""

    def receiver(self, hosts: Hosts, name: str, hops: list[Hop]) -> NodeSpec:
        """A source that stands for node `name`, which runs on another host; its outputs are those of `hops`."""
        ...

    def sender(self, hosts: Hosts, name: str, hops: list[Hop]) -> NodeSpec:
        """A sink whose inputs are called as `port_of` says."""
        ...


def port_of(hop: Hop) -> str:
    """Input port of a sender: node__output (an output's name has no double underscore)."""
    return f"{hop.producer}__{hop.output}"


def sender_name(host: str) -> str:
    """Name of the node that sends to a host."""
    return f"to_{host}"


def part_of(hosts: Hosts, name: str, ends: Ends) -> Graph:
    """The graph that host `name` runs. ConfigError for a host that there is not."""
    if name not in hosts.hosts:
        text = f"no host '{name}'; there is {one_of(hosts.hosts)}.{did_you_mean(name, hosts.hosts)}"
        raise ConfigError([Problem(Place("--host", 0), "", text)])
    graph = hosts.graph
    own = {node: spec for node, spec in graph.nodes.items() if hosts.place[node] == name}
    received = _grouped((hop for hop in hosts.hops if hop.receiver == name), "producer")
    sent = _grouped((hop for hop in hosts.hops if hop.sender == name), "receiver")
    nodes = {node: ends.receiver(hosts, node, hops) for node, hops in received.items()} | own
    nodes |= {sender_name(to): ends.sender(hosts, sender_name(to), hops) for to, hops in sent.items()}
    edges = [edge for edge in graph.edges if edge.consumer in own]
    for to, hops in sent.items():
        edges += [Edge(h.producer, h.output, sender_name(to), port_of(h), h.message, h.waiting) for h in hops]
    return Graph(nodes, tuple(edges), None, _values(graph, name, own), graph.left_out)


def _grouped(hops: Iterator[Hop], by: str) -> dict[str, list[Hop]]:
    groups: dict[str, list[Hop]] = {}
    for hop in hops:
        groups.setdefault(getattr(hop, by), []).append(hop)
    return groups


def _values(graph: Graph, name: str, own: Mapping[str, NodeSpec]) -> dict[str, Any]:
    """The configuration of the part, for people: the whole one's, with the nodes that run here."""
    values: dict[str, Any] = {"host": name, **graph.values}
    for kind in KINDS:
        declared = cast("dict[str, Any]", graph.values.get(kind) or {})
        values[kind] = {node: value for node, value in declared.items() if node in own}
    return values
