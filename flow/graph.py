"""The graph: a checked tree of stages and links with typed edges, or all its errors at once, each at file:line.

    stages:
      track:
        use: stages.track.Track            # module.Class
        config: {radius_m: 0.8}            # the class's settings
        inputs: {points: sweep.swept_points}  # how messages wait in a live run: flow/edge.py
        on_error: restart                  # live, when it raises: a fresh one takes over; or skip; or stop the run
        thread: lidar                      # live: shared with others that say so; without it, it has its own
        process: pictures                  # in that, live (flow/stage_process.py) and replayed (flow/apart.py)
        needs: $rig.cameras                # left out, which is said, where nothing stands there
        yields: true                       # live: takes fewer pictures while others' queues run over (flow/yielding.py)
    links:
      lidar: {use: links.velodyne.Lidar}   # sources and sinks; use, config, inputs, needs

Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from flow.classes import KINDS
from flow.codec import plan_of
from flow.edge import Edge
from flow.link import RUN_TOPICS, TRUTH_TOPICS, Source
from flow.message import Message
from flow.node_spec import NodeSpec, read_nodes
from flow.problem import ConfigError, did_you_mean, one_of
from flow.stage import input_ports, output_ports
from flow.tree import Section, Tree, load_tree
from flow.wires import read_edges

TOP_LEVEL = ("include", "replay", "rig", "stages", "links")


@dataclass(frozen=True, slots=True)
class Graph:
    """A graph without errors, ready to run. `nodes` stand in rank order: producers before consumers."""

    nodes: dict[str, NodeSpec]
    edges: tuple[Edge, ...]
    replay: Path | None  # recording named by the configuration
    values: dict[str, Any]  # the merged configuration
    left_out: dict[str, str] = field(default_factory=dict[str, str])  # nodes, and what each lacks

    def settings_yaml(self) -> str:
        """The merged configuration as YAML text: includes, overlays and --set applied."""
        return yaml.safe_dump(self.values, sort_keys=False, width=120)

    def said_left_out(self) -> list[str]:
        """`left out, as nothing stands for $rig.cameras: vp_drone, align`, a line for each thing that is missing."""
        needed = dict.fromkeys(self.left_out.values())
        names = {needs: ", ".join(n for n, other in self.left_out.items() if other == needs) for needs in needed}
        return [f"left out, as nothing stands for {needs}: {which}" for needs, which in names.items()]

    def outputs(self) -> Iterator[tuple[str, str, type[Message]]]:
        """(node, output, message type) of every output, wired or not."""
        for spec in self.nodes.values():
            for output, message_type in output_ports(spec.cls).items():
                yield spec.name, output, message_type


def load_graph(
    file: Path, overlays: Sequence[Path] = (), sets: Sequence[str] = (), sections: Mapping[str, Section] | None = None
) -> Graph:
    """Read, merge and check a configuration; arguments as `load_tree`. Raises ConfigError with every problem found."""
    tree = load_tree(file, overlays, sets, sections)
    graph = check(tree, file)
    if tree.problems:
        ordered = sorted(dict.fromkeys(tree.problems), key=lambda p: (p.place.file, p.place.line))
        raise ConfigError(ordered)
    return graph


def check(tree: Tree, file: Path) -> Graph:
    """Turn a tree into a graph; whatever is wrong is noted in `tree.problems` (then the graph is not to be used)."""
    for key in tree.values:
        if key not in TOP_LEVEL:
            tree.problem(
                (key,), f"unknown section '{key}'; there is {one_of(TOP_LEVEL)}.{did_you_mean(key, TOP_LEVEL)}"
            )
    left: dict[str, str] = {}
    nodes = {spec.name: spec for kind in KINDS for spec in read_nodes(tree, kind, left)}
    if not tree.values.get("stages"):
        tree.problem(("stages",), "no stages: a graph needs at least one.")
    edges = tuple(edge for spec in nodes.values() for edge in read_edges(tree, nodes, spec, left))
    _check_threads(tree, nodes, edges)
    _check_processes(tree, nodes)
    _check_topics(tree, nodes)
    order = _rank(tree, nodes, edges)
    return Graph({name: nodes[name] for name in order}, edges, _recording(tree, file), tree.values, left)


def recording_named(file: Path, overlays: Sequence[Path] = (), sets: Sequence[str] = ()) -> Path | None:
    """The recording that a configuration names, before anything else of it is checked; None: it runs live."""
    return _recording(load_tree(file, overlays, sets), file)


def _recording(tree: Tree, file: Path) -> Path | None:
    """The `replay:` entry: a path as seen from the file that says it, else None."""
    value = tree.values.get("replay")
    if value is None:
        return None
    if not isinstance(value, str):
        tree.problem(("replay",), f"must be a recording's file name, got {value!r}.")
        return None
    written_in = Path(tree.place(("replay",)).file)
    recording = (written_in if written_in.is_file() else file).parent / value
    if not recording.is_file():
        near = did_you_mean(recording.name, [p.name for p in recording.parent.glob("*.mcap")])
        tree.problem(("replay",), f"no such recording '{value}'.{near}")
    return recording


def _check_threads(tree: Tree, nodes: dict[str, NodeSpec], edges: tuple[Edge, ...]) -> None:
    """A thread must not wait for itself, and yields with all of its stages."""
    yields = {spec.thread: spec for spec in nodes.values() if spec.kind == "stages" and spec.yields}
    for spec in nodes.values():
        if spec.kind == "stages" and not spec.yields and spec.thread in yields:
            other = yields[spec.thread].name
            text = f"'{other}' works in the same thread, '{spec.thread}', and yields: both would rest."
            tree.problem(("stages", spec.name, "thread"), text)
    for edge in edges:
        producer, consumer = nodes[edge.producer], nodes[edge.consumer]
        both = producer.kind == consumer.kind == "stages" and producer.thread == consumer.thread
        if both and edge.waiting.policy == "block":
            text = f"'block' would wait for ever: '{edge.producer}' works in the same thread, '{consumer.thread}'."
            tree.problem(("stages", edge.consumer, "inputs", edge.port, "policy"), text)


def _check_processes(tree: Tree, nodes: dict[str, NodeSpec]) -> None:
    """What goes to and from another process must be messages that travel."""
    for spec in nodes.values():
        for message in (*input_ports(spec.cls).values(), *output_ports(spec.cls).values()) if spec.process else ():
            try:
                plan_of(message)
            except TypeError as error:
                text = f"{error}: leave it out, the stage can work in the run's own process only."
                tree.problem(("stages", spec.name, "process"), text)


def _check_topics(tree: Tree, nodes: dict[str, NodeSpec]) -> None:
    taken: dict[str, str] = {}
    for spec in nodes.values():
        if issubclass(spec.cls, Source):
            topic = str(spec.config.get("topic", spec.cls.settings_type.model_fields["topic"].default))
            path = (spec.kind, spec.name, "config", "topic")
            if topic.startswith(TRUTH_TOPICS):
                tree.problem(path, f"truth is for evaluation only: no source may bring in '{topic}'.")
            if topic.startswith(RUN_TOPICS):
                tree.problem(path, f"what a run tells of itself stands under '{topic}': no source may bring it in.")
            first = taken.setdefault(topic, spec.name)
            if first != spec.name:
                tree.problem(path, f"'{first}' already brings in {topic}: one source for each topic.")


def _rank(tree: Tree, nodes: dict[str, NodeSpec], edges: tuple[Edge, ...]) -> list[str]:
    """Nodes with producers first. A cycle among stages is a problem; through a link (servo) it is legal."""
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
    walk = [next(iter(waiting))]
    while walk[-1] not in walk[:-1]:
        walk.append(next(need for need in waiting[walk[-1]] if need in waiting))
    loop = walk[walk.index(walk[-1]) :][::-1]
    tree.problem(
        ("stages", loop[0], "inputs"),
        f"cycle {' -> '.join(loop)}; a cycle is legal only through a link (a servo, an autopilot).",
    )
