"""Edges between hosts over Eclipse Zenoh: `host_graph` returns the graph that one host of a hosts file runs."""

from __future__ import annotations

from pathlib import Path

from flow.config.hosts import Hop, Hosts, graph_of_host
from flow.config.hosts_file import load_hosts
from flow.config.node_spec import NodeSpec
from flow.graph import Graph
from flow.link import LinkError
from links.zenoh.receiver import Receiver, receiver_class
from links.zenoh.sender import Sender, sender_class
from links.zenoh.session_settings import SessionSettings, session_of

__all__ = ["Receiver", "Sender", "SessionSettings", "ZenohEnds", "host_graph", "session_of"]

TOPIC = "/hosts/"


class ZenohEnds:
    """Creates the nodes at the ends of hops."""

    def receiver(self, hosts: Hosts, name: str, hops: list[Hop]) -> NodeSpec:
        """A source with the name of the node that it replaces; its topic is /hosts/<name>."""
        config = {"topic": TOPIC + name, "session": session_of(hosts, hops[0].receiver), "sender": hops[0].sender}
        return NodeSpec(name, "links", "links.zenoh.Receiver", receiver_class(hops), config)

    def sender(self, hosts: Hosts, name: str, hops: list[Hop]) -> NodeSpec:
        """A sink with an input port per hop; its topic has no records."""
        config = {"topic": TOPIC + name, "session": session_of(hosts, hops[0].sender), "to": hops[0].receiver}
        return NodeSpec(name, "links", "links.zenoh.Sender", sender_class(hops), config)


def host_graph(graph: Graph, hosts_file: Path, host: str, *, to_run: bool = False) -> Graph:
    """The graph that `host` runs. Raises ConfigError with all errors of the hosts file.

    `to_run`: also raise LinkError unless the host's key and certificates exist.
    """
    hosts = load_hosts(hosts_file, graph)
    part = graph_of_host(hosts, host, ZenohEnds())
    if to_run:
        own = hosts.hosts[host]
        missing = [str(path) for path in (own.certificate, own.key, own.authority) if not path.is_file()]
        if missing:
            raise LinkError(f"{hosts_file}: host '{host}' needs {', '.join(missing)}: see links/zenoh/README.md")
    return part
