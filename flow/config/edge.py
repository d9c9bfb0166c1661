"""The edges of a graph, and the queue of each in a live run.

    inputs:
      points: sweep.swept_points                                      # the default queue of its message type
      pulses: {from: sweep.swept_pulses, policy: drop_oldest, depth: 64, deadline_ms: 50}

`latest` keeps only the newest message. `drop_oldest` keeps up to `depth` messages and then drops the oldest. Dropped
messages are counted. A message misses its deadline, which is counted too, when its consumer finishes with it more than
`deadline_ms` after the arrival of the record that caused it. A replay drops nothing.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

from flow.config.classes import KINDS
from flow.config.node_spec import NodeSpec
from flow.config.tree import KeyPath, Tree
from flow.config_error import did_you_mean, one_of
from flow.message import Message, array_fields
from flow.stage import input_ports, output_ports

Policy = Literal["latest", "drop_oldest"]
POLICIES: tuple[str, ...] = get_args(Policy)
KEYS = ("from", "policy", "depth", "deadline_ms")
DEPTH = 512  # 0.7 s of a VLP-16's packets: a short pause of the host loses none, and the oldest is not too old
MAX_DEPTH = 100_000
DEADLINE_MS = 100.0  # after some gaps of this length the autopilot considers its pose source lost
MAX_DEADLINE_MS = 60_000.0


@dataclass(frozen=True, slots=True)
class QueueSettings:
    """How messages wait on an edge of a live run."""

    policy: Policy
    depth: int
    deadline_ms: float = DEADLINE_MS

    def __str__(self) -> str:
        return self.policy if self.policy == "latest" else f"{self.policy} {self.depth}"


@dataclass(frozen=True, slots=True)
class Edge:
    """A connection from an output of one node to an input port of another."""

    producer: str
    output: str
    consumer: str
    port: str
    message: type[Message]
    queue: QueueSettings

    @property
    def name(self) -> str:
        """`track.pulses`: each port has one edge."""
        return f"{self.consumer}.{self.port}"


def default_queue(message: type[Message]) -> QueueSettings:
    """`latest` for an image (a field with two free dimensions): it is large, and an old one is useless; else DEPTH."""
    own = (shape for name, _, shape in array_fields(message) if "." not in name)  # not of a dataclass in a field
    is_image = any(sum(isinstance(d, str) for d in shape.dims) > 1 for shape in own)
    return QueueSettings("latest", 1) if is_image else QueueSettings("drop_oldest", DEPTH)


def read_edges(
    tree: Tree, nodes: Mapping[str, NodeSpec], spec: NodeSpec, left_out: Mapping[str, str]
) -> Iterator[Edge]:
    """The edges into one node. Wrong ones, and required ports without one, are errors in `tree`.

    `left_out`: nodes that the graph leaves out, with what each needs. An optional port drops its edge from such a node.
    """
    path = (spec.kind, spec.name, "inputs")
    ports = input_ports(spec.cls)
    declared: Any = tree.values[spec.kind][spec.name].get("inputs") or {}
    if not isinstance(declared, dict):
        tree.error(path, "must be a mapping of port: node.output.")
        return
    inputs = cast("dict[str, Any]", declared)
    wired = {port: declaration for port, declaration in inputs.items() if declaration is not None}  # null: unwired
    for port, declaration in wired.items():
        producer = _source(declaration)[1]
        if port in ports and producer in left_out:
            if port not in spec.cls.optional_inputs:
                needs = left_out[producer]
                why = f"'{producer}' is left out, because the configuration has no {needs}"
                tree.error((*path, port), f"{why}: add 'needs: {needs}' to this node too.")
        elif port in ports:
            yield from _edge(tree, nodes, spec, port, declaration)
        else:
            cls = spec.cls.__name__
            takes = f" {cls} takes {one_of(ports)}." if ports else f" {cls} takes no inputs."
            tree.error((*path, port), f"unknown port '{port}'.{did_you_mean(port, ports) or takes}")
    for port, wanted in ports.items():
        if port not in wired and port not in spec.cls.optional_inputs:
            tree.error(path, f"port '{port}' ({wanted.__name__}) is not wired.{_candidates(nodes, wanted)}")


def _source(declaration: Any) -> tuple[Any, str, str]:
    """What `node.output` or `{from: node.output, ...}` refers to: as written, node, output; else empty names."""
    source = cast("dict[str, Any]", declaration).get("from") if isinstance(declaration, dict) else declaration
    node, _, output = source.partition(".") if isinstance(source, str) else ("", "", "")
    return source, node, output


def _edge(tree: Tree, nodes: Mapping[str, NodeSpec], spec: NodeSpec, port: str, declaration: Any) -> Iterator[Edge]:
    """The edge that an input declares; none when it is wrong."""
    here = (spec.kind, spec.name, "inputs", port)
    queue = cast("dict[str, Any]", declaration) if isinstance(declaration, dict) else {}
    source, node, output = _source(declaration)
    if not (node and output):
        form = "have 'from: node.output'" if queue else "read node.output"
        tree.error(here, f"must {form}, got {source!r}.")
        return
    if node not in nodes:
        if not any(node in (tree.values.get(kind) or {}) for kind in KINDS):  # else it has an error of its own
            tree.error(here, f"no stage or link '{node}'.{did_you_mean(node, nodes)}")
        return
    outputs, wanted = output_ports(nodes[node].cls), input_ports(spec.cls)[port]
    message = outputs.get(output)
    if message is None:
        gives = f" {node} gives {one_of(outputs)}." if outputs else f" {node} gives nothing."
        tree.error(here, f"'{node}' has no output '{output}'.{did_you_mean(output, outputs) or gives}")
    elif not issubclass(message, wanted):
        has, wants = message.__name__, wanted.__name__
        tree.error(here, f"type mismatch: {node}.{output} is {has}, {spec.name}.{port} takes {wants}.")
    else:
        yield Edge(node, output, spec.name, port, message, _queue(tree, here, queue, default_queue(message)))


def _candidates(nodes: Mapping[str, NodeSpec], wanted: type[Message]) -> str:
    """The outputs of the graph that an unwired port could take, as a sentence."""
    fits = [f"{n.name}.{o}" for n in nodes.values() for o, m in output_ports(n.cls).items() if issubclass(m, wanted)]
    return f" Of that type there is {one_of(fits)}." if fits else f" Nothing in the graph gives {wanted.__name__}."


def _queue(tree: Tree, path: KeyPath, declared: dict[str, Any], default: QueueSettings) -> QueueSettings:
    """The queue that an input's mapping declares over `default`, which holds when the mapping has errors."""
    errors = list(_queue_errors(declared))
    for key, text in errors:
        tree.error((*path, key), text)
    if errors:
        return default
    policy = cast(Policy, declared.get("policy", default.policy))
    depth = 1 if policy == "latest" else max(default.depth, DEPTH)
    deadline_ms = float(declared.get("deadline_ms", default.deadline_ms))
    return QueueSettings(policy, declared.get("depth", depth), deadline_ms)


def _queue_errors(declared: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """(key, text) of each error in an input's mapping."""
    for key in declared:
        if key not in KEYS:
            yield key, f"unknown key '{key}'; there is {one_of(KEYS)}.{did_you_mean(key, KEYS)}"
    policy = declared.get("policy")
    if policy is not None and policy not in POLICIES:
        near = did_you_mean(policy, POLICIES) if isinstance(policy, str) else ""
        yield "policy", f"must be {one_of(POLICIES)}, got {policy!r}.{near}"
    depth = declared.get("depth")
    if depth is not None and not (_is_number(depth) and isinstance(depth, int) and 1 <= depth <= MAX_DEPTH):
        yield "depth", f"must be a whole number from 1 to {MAX_DEPTH}, got {depth!r}."
    elif depth is not None and policy == "latest" and depth != 1:
        yield "depth", "'latest' keeps one message: leave depth out, or take 'drop_oldest'."
    deadline_ms = declared.get("deadline_ms")
    if deadline_ms is not None and not (_is_number(deadline_ms) and 0 < deadline_ms <= MAX_DEADLINE_MS):
        yield "deadline_ms", f"must be a number above 0, up to {MAX_DEADLINE_MS:g}, got {deadline_ms!r}."


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
