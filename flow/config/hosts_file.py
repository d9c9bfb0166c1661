"""Reads a hosts file (its format: `flow.config.hosts`), or reports all its errors at once, each at file:line.

Source: ours.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, cast

from flow.config.edge import QueueSettings, default_queue
from flow.config.hosts import Hop, Host, Hosts, sender_name
from flow.config.tree import Tree, load_tree
from flow.config_error import ConfigError, did_you_mean, one_of
from flow.graph import Graph
from flow.link import Tap
from flow.remote.codec import encoding_of

SECTIONS = ("hosts", "placement", "taps")
HOST_KEYS = ("listen", "connect", "certificate", "key", "authority")
FILE_KEYS = ("certificate", "key", "authority")
_ENDPOINT = re.compile(r"tls/([\w.-]+|\[[0-9a-fA-F:]+\]):(\d{1,5})\Z")
_NAME = re.compile(r"[a-z][a-z0-9_]*\Z")


def load_hosts(file: Path, graph: Graph) -> Hosts:
    """Read a hosts file and assign the nodes of `graph` to its hosts. ConfigError: all errors that it has."""
    tree = load_tree(file)
    for key in tree.values:
        if key not in SECTIONS:
            tree.error((key,), f"unknown section '{key}'; there is {one_of(SECTIONS)}.{did_you_mean(key, SECTIONS)}")
    hosts, hub = _hosts(tree, file)
    placement = _placement(tree, graph, _section(tree, "hosts"))
    tapped = _tapped(tree, graph, placement)
    hops = _hops(tree, graph, hub, placement, tapped)
    if tree.errors:
        raise ConfigError.in_order(tree.errors)
    return Hosts(graph, hosts, hub, placement, hops)


def _section(tree: Tree, name: str) -> dict[str, Any]:
    value = tree.values.get(name, {})
    if isinstance(value, dict):
        return cast("dict[str, Any]", value)
    tree.error((name,), "must be a mapping.")
    return {}


def _hosts(tree: Tree, file: Path) -> tuple[dict[str, Host], str]:
    """Hosts by name, and the name of the hub."""
    declared = _section(tree, "hosts")
    endpoints: dict[str, tuple[str | None, str | None]] = {}
    files: dict[str, list[Path]] = {}
    for name, raw in declared.items():
        path = ("hosts", name)
        if not _NAME.match(name):
            tree.error(path, f"'{name}' is no name: use small letters, digits and '_', starting with a letter.")
        if not isinstance(raw, dict):
            tree.error(path, f"must be a mapping of {one_of(HOST_KEYS)}.")
            continue
        host = cast("dict[str, Any]", raw)
        for key in host:
            if key not in HOST_KEYS:
                near = did_you_mean(key, HOST_KEYS)
                tree.error((*path, key), f"unknown key '{key}'; there is {one_of(HOST_KEYS)}.{near}")
        endpoints[name] = (_endpoint(tree, path, host, "listen"), _endpoint(tree, path, host, "connect"))
        files[name] = [_file(tree, path, host, key, file) for key in FILE_KEYS]
    hubs = [name for name, (listen, _) in endpoints.items() if listen is not None]
    if len(hubs) != 1:
        found = f"these do: {one_of(hubs)}" if hubs else "none does"
        tree.error(("hosts",), f"one host, best the vehicle, must have 'listen: tls/ADDRESS:PORT'; {found}.")
        return {}, ""
    hub = hubs[0]
    at_hub = endpoints[hub][0]
    if endpoints[hub][1] is not None:
        tree.error(("hosts", hub, "connect"), "this host listens: the others connect to it.")
    return {name: Host(name, connect or at_hub or "", *files[name]) for name, (_, connect) in endpoints.items()}, hub


def _endpoint(tree: Tree, path: tuple[str, ...], host: dict[str, Any], key: str) -> str | None:
    value = host.get(key)
    if value is None:
        return None
    match = _ENDPOINT.match(value) if isinstance(value, str) else None
    if match is None or not 0 < int(match[2]) <= 65_535:
        tree.error((*path, key), f"must read tls/ADDRESS:PORT, as in tls/192.168.7.1:7447, got {value!r}.")
    return str(value)


def _file(tree: Tree, path: tuple[str, ...], host: dict[str, Any], key: str, file: Path) -> Path:
    value = host.get(key)
    if not isinstance(value, str) or not value:
        why = "is missing" if value is None else f"must be a file's name, got {value!r}"
        tree.error((*path, key), f"{why}: the host's {key} as a PEM file, relative to this file.")
        return file
    return Path(tree.location((*path, key)).file).parent / value


def _placement(tree: Tree, graph: Graph, hosts: dict[str, Any]) -> dict[str, str]:
    """Host of every node."""
    placement: dict[str, str] = {}
    for node, host in _section(tree, "placement").items():
        path = ("placement", node)
        if node not in graph.nodes and node not in graph.left_out:
            tree.error(path, f"no stage or link '{node}'.{did_you_mean(node, graph.nodes)}")
        elif not isinstance(host, str) or host not in hosts:
            near = did_you_mean(host, hosts) if isinstance(host, str) else ""
            tree.error(path, f"no host {host!r}; there is {one_of(hosts)}.{near}")
        elif node in graph.nodes:  # what this rig leaves out, other rigs have
            placement[node] = host
    missing = [node for node in graph.nodes if node not in _section(tree, "placement")]
    if missing:
        tree.error(("placement",), f"has no host for {', '.join(missing)}.")
    for host in hosts:
        if sender_name(host) in graph.nodes:
            tree.error(("hosts", host), f"a node has the name '{sender_name(host)}' already: rename it or the host.")
    return placement


def _tapped(tree: Tree, graph: Graph, placement: dict[str, str]) -> dict[str, list[tuple[str, str]]]:
    """The outputs (node, output) that each tap gets, of this host or others."""
    outputs = {f"{node}.{output}": (node, output) for node, output, _ in graph.outputs()}
    taps = [name for name, spec in graph.nodes.items() if issubclass(spec.cls, Tap)]
    tapped = {tap: _wanted(graph, tap) for tap in taps if tap in placement}
    for tap, wanted in _section(tree, "taps").items():
        path = ("taps", tap)
        if tap not in taps:
            there = f"there is {one_of(taps)}" if taps else "the graph has none"
            tree.error(path, f"no tap '{tap}'; {there}.{did_you_mean(tap, taps)}")
            continue
        if not isinstance(wanted, list):
            tree.error(path, "must be a list of node.output.")
            continue
        names = cast("list[Any]", wanted)
        for index, name in enumerate(names):
            if not isinstance(name, str) or name not in outputs:
                near = did_you_mean(name, outputs) if isinstance(name, str) else ""
                tree.error((*path, str(index)), f"no output {name!r}.{near}")
        if tap in placement:
            tapped[tap] = [outputs[name] for name in names if isinstance(name, str) and name in outputs]
    return tapped


def _wanted(graph: Graph, tap: str) -> list[tuple[str, str]]:
    """All outputs that a tap wants."""
    node = graph.nodes[tap].build()
    return [(n, output) for n, output, message in graph.outputs() if isinstance(node, Tap) and node.wants(message)]


def _hops(
    tree: Tree, graph: Graph, hub: str, placement: dict[str, str], tapped: dict[str, list[tuple[str, str]]]
) -> tuple[Hop, ...]:
    """Every output that another host needs, once for each host that receives it."""
    types = {(node, output): message for node, output, message in graph.outputs()}
    needed: dict[tuple[str, str, str], list[QueueSettings]] = {}  # (node, output, host) -> queues of its edges there
    for edge in graph.edges:
        source, target = placement.get(edge.producer), placement.get(edge.consumer)
        if source is None or target is None or source == target:
            continue
        for host in _route(source, target, hub):
            needed.setdefault((edge.producer, edge.output, host), []).append(edge.queue)
    for tap, outputs in tapped.items():
        for node, output in outputs:
            source = placement.get(node)
            if source is not None and source != placement[tap]:
                for host in _route(source, placement[tap], hub):
                    needed.setdefault((node, output, host), [])
    hops: list[Hop] = []
    for (node, output, host), queues in needed.items():
        message = types[node, output]
        try:
            encoding_of(message)
        except TypeError as error:
            tree.error(("placement", node), f"{node}.{output} goes to {host}, but {error}.")
        sender = hub if host != hub else placement[node]
        hops.append(Hop(node, output, message, sender, host, _largest(queues) or default_queue(message)))
    return tuple(hops)


def _route(source: str, target: str, hub: str) -> list[str]:
    """The hosts that receive a message in turn."""
    return [target] if hub in (source, target) else [hub, target]


def _largest(queues: list[QueueSettings]) -> QueueSettings | None:
    """The queue that keeps most; None of none."""
    return max(queues, key=lambda queue: (queue.depth, queue.deadline_ms), default=None)
