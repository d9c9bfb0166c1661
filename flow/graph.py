"""The graph: a checked tree of stages and links with typed edges, or all its errors at once, each at file:line.

    stages:
      track:
        use: stages.track.Track            # module.Class
        config: {radius_m: 0.8}            # the class's settings
        inputs: {points: sweep.swept_points}  # an edge; its queue in a live run: flow/config/edge.py
        thread: lidar                      # live: stages and sources that name one share it; default: its own
        process: images                    # a worker process: flow/remote/stage_process.py, flow/subprocess_replay.py
        needs: $rig.cameras                # the stage is left out where the configuration has no such value
        low_priority: true                 # live: fewer images while other queues overflow: flow/live/backpressure.py
    links:
      lidar: {use: links.lidar.Lidar}   # sources and sinks: use, config, inputs, needs, thread

Source: ours.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel

from flow.config.classes import KINDS
from flow.config.edge import Edge, read_edges
from flow.config.node_spec import NodeSpec, read_nodes, rig_failed
from flow.config.secrets import values_without_secrets
from flow.config.setting_errors import check_values
from flow.config.tree import Section, Tree, load_tree, resolve
from flow.config_error import ConfigError, did_you_mean, one_of
from flow.link import RUN_TOPICS, TRUTH_TOPICS, Source
from flow.message import Message
from flow.remote.codec import encoding_of
from flow.stage import input_ports, output_ports

TOP_LEVEL = ("include", "replay", "rig", "stages", "links")


@dataclass(frozen=True, slots=True)
class Graph:
    """A graph without errors, ready to run. `nodes` are in rank order: producers before consumers."""

    nodes: dict[str, NodeSpec]
    edges: tuple[Edge, ...]
    replay: Path | None  # recording named by the configuration
    values: dict[str, Any]  # the merged configuration
    left_out: dict[str, str] = field(default_factory=dict[str, str])  # nodes, and what each needs

    def settings_yaml(self) -> str:
        """The merged configuration as YAML text: includes, overlays and --set applied, secrets in URLs replaced."""
        return yaml.safe_dump(values_without_secrets(self.values), sort_keys=False, width=120)

    def left_out_texts(self) -> list[str]:
        """A text for each missing value: `the configuration has no $rig.cameras: vp_drone, align left out`."""
        needed = dict.fromkeys(self.left_out.values())
        names = {needs: ", ".join(n for n, other in self.left_out.items() if other == needs) for needs in needed}
        return [f"the configuration has no {needs}: {which} left out" for needs, which in names.items()]

    def outputs(self) -> Iterator[tuple[str, str, type[Message]]]:
        """(node, output, message type) of every output, wired or not."""
        for spec in self.nodes.values():
            for output, message_type in output_ports(spec.cls).items():
                yield spec.name, output, message_type

    def partitions(self) -> list[frozenset[str]]:
        """The nodes that a replay runs in processes of their own, in rank order of their first stage with a `process`.

        A partition is a stage that names a process, with every node that feeds it, directly or through others.
        Partitions that share a node, or name the same process, are one.
        """
        partitions: list[frozenset[str]] = []
        for spec in self.nodes.values():
            if not spec.process:
                continue
            nodes = self.feeding(spec.name)
            related = nodes | {other.name for other in self.nodes.values() if other.process == spec.process}
            shared = [other for other in partitions if other & related]
            partitions = [other for other in partitions if not other & related] + [nodes.union(*shared)]
        return partitions

    def feeding(self, stage: str) -> frozenset[str]:
        """A stage with every node that feeds it, directly or through other stages."""
        producers: dict[str, set[str]] = {name: set() for name in self.nodes}
        for edge in self.edges:
            if self.nodes[edge.consumer].kind == "stages":  # a sink's inputs are for live runs
                producers[edge.consumer].add(edge.producer)
        nodes, open_nodes = {stage}, [stage]
        while open_nodes:
            new = producers[open_nodes.pop()] - nodes
            nodes |= new
            open_nodes += new
        return frozenset(nodes)

    def restricted_to(self, nodes: Collection[str]) -> Graph:
        """The graph of these nodes alone, with the edges among them; they are ranked as in the whole."""
        specs = {name: spec for name, spec in self.nodes.items() if name in nodes}
        edges = tuple(edge for edge in self.edges if edge.consumer in nodes and edge.producer in nodes)
        return replace(self, nodes=specs, edges=edges)


def load_graph(
    file: Path,
    overlays: Sequence[Path] = (),
    sets: Sequence[str] = (),
    sections: Mapping[str, Section] | None = None,
    *,
    packages: Collection[str] | None = None,
    rig: type[BaseModel] | None = None,
) -> Graph:
    """Read, merge and check a configuration; arguments as in `load_tree`. ConfigError: all errors that it has.

    `packages`: top-level packages from which it may name classes; None: any, the configuration is the user's own.
    `rig`: the model of the `rig` section; None: it may contain anything.
    """
    tree = load_tree(file, overlays, sets, sections)
    tree.packages = packages
    if rig is not None and "rig" in tree.values and not rig_failed(tree):
        check_values(tree, ("rig",), rig, resolve(tree, ("rig",), tree.values["rig"]), "rig")
    graph = check(tree, file)
    if tree.errors:
        raise ConfigError.in_order(tree.errors)
    return graph


def check(tree: Tree, file: Path) -> Graph:
    """Turn a tree into a graph. Errors are added to `tree.errors`; the graph is usable only when there is none."""
    for key in tree.values:
        if key not in TOP_LEVEL:
            tree.error((key,), f"unknown section '{key}'; there is {one_of(TOP_LEVEL)}.{did_you_mean(key, TOP_LEVEL)}")
    left_out: dict[str, str] = {}
    nodes = {spec.name: spec for kind in KINDS for spec in read_nodes(tree, kind, left_out)}
    if not tree.values.get("stages"):
        tree.error(("stages",), "no stages: a graph needs at least one.")
    edges = tuple(edge for spec in nodes.values() for edge in read_edges(tree, nodes, spec, left_out))
    _check_threads(tree, nodes)
    _check_topics(tree, nodes)
    order = _rank(tree, nodes, edges)
    graph = Graph({name: nodes[name] for name in order}, edges, _recording(tree, file), tree.values, left_out)
    _check_processes(tree, graph)
    return graph


def recording_named(file: Path, overlays: Sequence[Path] = (), sets: Sequence[str] = ()) -> Path | None:
    """The recording that a configuration names, without any other check; None: the configuration runs live."""
    return _recording(load_tree(file, overlays, sets), file)


def _recording(tree: Tree, file: Path) -> Path | None:
    """The `replay:` entry, a path relative to the file that has the entry; None without one."""
    value = tree.values.get("replay")
    if value is None:
        return None
    if not isinstance(value, str):
        tree.error(("replay",), f"must be a recording's file name, got {value!r}.")
        return None
    written_in = Path(tree.location(("replay",)).file)
    recording = (written_in if written_in.is_file() else file).parent / value
    if not recording.is_file():
        near = did_you_mean(recording.name, [p.name for p in recording.parent.glob("*.mcap")])
        tree.error(("replay",), f"no such recording '{value}'.{near}")
    return recording


def _check_threads(tree: Tree, nodes: dict[str, NodeSpec]) -> None:
    """All stages of a thread have low priority, or none."""
    low_priority = {spec.thread: spec for spec in nodes.values() if spec.kind == "stages" and spec.low_priority}
    for spec in nodes.values():
        if spec.kind == "stages" and not spec.low_priority and spec.thread in low_priority:
            other = low_priority[spec.thread].name
            text = f"'{other}' has low_priority and the same thread, '{spec.thread}': both would pause."
            tree.error(("stages", spec.name, "thread"), text)
        if spec.kind == "links" and spec.thread and not (issubclass(spec.cls, Source) and spec.cls.polled):
            text = f"{spec.cls.__name__} needs a thread of its own: leave 'thread' out, or write 'thread: null'."
            tree.error(("links", spec.name, "thread"), text)
        if spec.kind == "links" and spec.thread in low_priority:
            other = low_priority[spec.thread].name
            text = f"'{other}' has low_priority, so this source would pause with it: name another thread."
            tree.error(("links", spec.name, "thread"), text)


def _check_processes(tree: Tree, graph: Graph) -> None:
    """Messages to and from worker processes must be ones that can be encoded."""
    partitions = graph.partitions()
    for spec in graph.nodes.values():
        if not spec.process:
            continue
        (nodes,) = (nodes for nodes in partitions if spec.name in nodes)
        messages = dict.fromkeys(message for _, _, message in graph.restricted_to(nodes).outputs())
        for message in messages | dict.fromkeys(input_ports(spec.cls).values()):
            try:
                encoding_of(message)
            except TypeError as error:
                text = f"{error}: leave it out, the stage can run in the run's own process only."
                tree.error(("stages", spec.name, "process"), text)


def _check_topics(tree: Tree, nodes: dict[str, NodeSpec]) -> None:
    """Each topic has one source; the topics of truth and of the run itself have none."""
    source_of: dict[str, str] = {}
    for spec in nodes.values():
        if issubclass(spec.cls, Source):
            topic = str(spec.config.get("topic", spec.cls.settings_type.model_fields["topic"].default))
            path = (spec.kind, spec.name, "config", "topic")
            if topic.startswith(TRUTH_TOPICS):
                tree.error(path, f"truth is for evaluation only: no source may bring in '{topic}'.")
            if topic.startswith(RUN_TOPICS):
                tree.error(path, f"'{topic}' holds records of the run itself: no source may bring it in.")
            first = source_of.setdefault(topic, spec.name)
            if first != spec.name:
                tree.error(path, f"'{first}' already brings in {topic}: one source for each topic.")


def _rank(tree: Tree, nodes: dict[str, NodeSpec], edges: tuple[Edge, ...]) -> list[str]:
    """Nodes with producers first. A cycle among stages is an error; through a link (servo) it is legal."""
    sources = [n for n, spec in nodes.items() if spec.kind == "links" and output_ports(spec.cls)]
    sinks = [n for n, spec in nodes.items() if spec.kind == "links" and not output_ports(spec.cls)]
    waiting = {n: [e.producer for e in edges if e.consumer == n] for n, s in nodes.items() if s.kind == "stages"}
    order: list[str] = []
    while waiting:
        ready = [n for n, needs in waiting.items() if not any(need in waiting for need in needs)]
        if not ready:
            _report_cycle(tree, waiting)
            ready = list(waiting)
        order += ready
        waiting = {n: needs for n, needs in waiting.items() if n not in ready}
    return [*sources, *order, *sinks]


def _report_cycle(tree: Tree, waiting: dict[str, list[str]]) -> None:
    path = [next(iter(waiting))]
    while path[-1] not in path[:-1]:
        path.append(next(need for need in waiting[path[-1]] if need in waiting))
    loop = path[path.index(path[-1]) :][::-1]
    tree.error(
        ("stages", loop[0], "inputs"),
        f"cycle {' -> '.join(loop)}; a cycle is legal only through a link (a servo, an autopilot).",
    )
