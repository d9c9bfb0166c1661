"""Reads a hosts file: all its errors at once, each at file:line. `flow.hosts` says what stands in it.

Source: ours.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, cast

from flow.codec import plan_of
from flow.edge import Waiting, usual_waiting
from flow.graph import Graph
from flow.hosts import Hop, Host, Hosts, sender_name
from flow.link import Tap
from flow.problem import ConfigError, did_you_mean, one_of
from flow.tree import Tree, load_tree

SECTIONS = ("hosts", "place", "see")
HOST_KEYS = ("listen", "connect", "certificate", "key", "authority")
FILE_KEYS = ("certificate", "key", "authority")
_ENDPOINT = re.compile(r"tls/([\w.-]+|\[[0-9a-fA-F:]+\]):(\d{1,5})\Z")
_NAME = re.compile(r"[a-z][a-z0-9_]*\Z")


def load_hosts(file: Path, graph: Graph) -> Hosts:
    """Read a hosts file and place `graph` on its hosts. ConfigError with all that is wrong, each at its line."""
    tree = load_tree(file)
    for key in tree.values:
        if key not in SECTIONS:
            tree.problem((key,), f"unknown section '{key}'; there is {one_of(SECTIONS)}.{did_you_mean(key, SECTIONS)}")
    hosts, hub = _hosts(tree, file)
    place = _place(tree, graph, _section(tree, "hosts"))
    seen = _seen(tree, graph, place)
    hops = _hops(tree, graph, hub, place, seen)
    if tree.problems:
        raise ConfigError(sorted(dict.fromkeys(tree.problems), key=lambda p: (p.place.file, p.place.line)))
    return Hosts(graph, hosts, hub, place, hops)


def _section(tree: Tree, name: str) -> dict[str, Any]:
    value = tree.values.get(name, {})
    if isinstance(value, dict):
        return cast("dict[str, Any]", value)
    tree.problem((name,), "must be a mapping.")
    return {}


def _hosts(tree: Tree, file: Path) -> tuple[dict[str, Host], str]:
    """Hosts by name, and which is the hub."""
    declared = _section(tree, "hosts")
    endpoints: dict[str, tuple[str | None, str | None]] = {}
    files: dict[str, list[Path]] = {}
    for name, raw in declared.items():
        path = ("hosts", name)
        if not _NAME.match(name):
            tree.problem(path, f"'{name}' is no name: use small letters, digits and '_', starting with a letter.")
        if not isinstance(raw, dict):
            tree.problem(path, f"must be a mapping of {one_of(HOST_KEYS)}.")
            continue
        host = cast("dict[str, Any]", raw)
        for key in host:
            if key not in HOST_KEYS:
                near = did_you_mean(key, HOST_KEYS)
                tree.problem((*path, key), f"unknown key '{key}'; there is {one_of(HOST_KEYS)}.{near}")
        endpoints[name] = (_endpoint(tree, path, host, "listen"), _endpoint(tree, path, host, "connect"))
        files[name] = [_file(tree, path, host, key, file) for key in FILE_KEYS]
    hubs = [name for name, (listen, _) in endpoints.items() if listen is not None]
    if len(hubs) != 1:
        found = f"these do: {one_of(hubs)}" if hubs else "none does"
        tree.problem(("hosts",), f"one host must say 'listen: tls/ADDRESS:PORT', best the vehicle; {found}.")
        return {}, ""
    hub = hubs[0]
    at_hub = endpoints[hub][0]
    if endpoints[hub][1] is not None:
        tree.problem(("hosts", hub, "connect"), "this host listens: the others connect to it.")
    return {name: Host(name, connect or at_hub or "", *files[name]) for name, (_, connect) in endpoints.items()}, hub


def _endpoint(tree: Tree, path: tuple[str, ...], host: dict[str, Any], key: str) -> str | None:
    value = host.get(key)
    if value is None:
        return None
    match = _ENDPOINT.match(value) if isinstance(value, str) else None
    if match is None or not 0 < int(match[2]) <= 65_535:
        tree.problem((*path, key), f"must read tls/ADDRESS:PORT, as in tls/192.168.7.1:7447, got {value!r}.")
    return str(value)


def _file(tree: Tree, path: tuple[str, ...], host: dict[str, Any], key: str, file: Path) -> Path:
    value = host.get(key)
    if not isinstance(value, str) or not value:
        said = "is missing" if value is None else f"must be a file's name, got {value!r}"
        tree.problem((*path, key), f"{said}: the host's {key} as a PEM file, as seen from this file.")
        return file
    return Path(tree.place((*path, key)).file).parent / value


def _place(tree: Tree, graph: Graph, hosts: dict[str, Any]) -> dict[str, str]:
    """Host of every node."""
    place: dict[str, str] = {}
    for node, host in _section(tree, "place").items():
        path = ("place", node)
        if node not in graph.nodes and node not in graph.left_out:
            tree.problem(path, f"no stage or link '{node}'.{did_you_mean(node, graph.nodes)}")
        elif not isinstance(host, str) or host not in hosts:
            near = did_you_mean(host, hosts) if isinstance(host, str) else ""
            tree.problem(path, f"no host {host!r}; there is {one_of(hosts)}.{near}")
        elif node in graph.nodes:  # what this rig leaves out runs on others
            place[node] = host
    missing = [node for node in graph.nodes if node not in _section(tree, "place")]
    if missing:
        tree.problem(("place",), f"say on which host {', '.join(missing)} run{'s' if len(missing) == 1 else ''}.")
    for host in hosts:
        if sender_name(host) in graph.nodes:
            tree.problem(("hosts", host), f"a node is called '{sender_name(host)}' already: rename it or the host.")
    return place


def _seen(tree: Tree, graph: Graph, place: dict[str, str]) -> dict[str, list[tuple[str, str]]]:
    """What each placed tap is to see of other hosts: (node, output)."""
    outputs = {f"{node}.{output}": (node, output) for node, output, _ in graph.outputs()}
    taps = [name for name, spec in graph.nodes.items() if issubclass(spec.cls, Tap)]
    seen = {tap: _wanted(graph, tap) for tap in taps if tap in place}
    for tap, wanted in _section(tree, "see").items():
        path = ("see", tap)
        if tap not in taps:
            there = f"there is {one_of(taps)}" if taps else "the graph has none"
            tree.problem(path, f"no tap '{tap}'; {there}.{did_you_mean(tap, taps)}")
            continue
        if not isinstance(wanted, list):
            tree.problem(path, "must be a list of node.output.")
            continue
        names = cast("list[Any]", wanted)
        for index, name in enumerate(names):
            if not isinstance(name, str) or name not in outputs:
                near = did_you_mean(name, outputs) if isinstance(name, str) else ""
                tree.problem((*path, str(index)), f"no output {name!r}.{near}")
        if tap in place:
            seen[tap] = [outputs[name] for name in names if isinstance(name, str) and name in outputs]
    return seen


def _wanted(graph: Graph, tap: str) -> list[tuple[str, str]]:
    """All that a tap wants to see."""
    node = graph.nodes[tap].build()
    return [(n, output) for n, output, message in graph.outputs() if isinstance(node, Tap) and node.wants(message)]


def _hops(
    tree: Tree, graph: Graph, hub: str, place: dict[str, str], seen: dict[str, list[tuple[str, str]]]
) -> tuple[Hop, ...]:
    types = {(node, output): message for node, output, message in graph.outputs()}
    wanted: dict[tuple[str, str, str], list[Waiting]] = {}  # (node, output, host) -> how its consumers there wait
    for edge in graph.edges:
        home, there = place.get(edge.producer), place.get(edge.consumer)
        if home is None or there is None or home == there:
            continue
        for stop in _way(home, there, hub):
            wanted.setdefault((edge.producer, edge.output, stop), []).append(edge.waiting)
    for tap, outputs in seen.items():
        for node, output in outputs:
            home = place.get(node)
            if home is not None and home != place[tap]:
                for stop in _way(home, place[tap], hub):
                    wanted.setdefault((node, output, stop), [])
    hops: list[Hop] = []
    for (node, output, host), waits in wanted.items():
        message = types[node, output]
        try:
            plan_of(message)
        except TypeError as error:
            tree.problem(("place", node), f"{node}.{output} goes to {host}, but {error}.")
        sender = hub if host != hub else place[node]
        hops.append(Hop(node, output, message, sender, host, _widest(waits) or usual_waiting(message)))
    return tuple(hops)


def _way(home: str, there: str, hub: str) -> list[str]:
    """The hosts that a message reaches, in turn."""
    return [there] if hub in (home, there) else [hub, there]


def _widest(waits: list[Waiting]) -> Waiting | None:
    """The one of several ways to wait that keeps most."""
    return max(waits, key=lambda waiting: (waiting.depth, waiting.deadline_ms), default=None)
