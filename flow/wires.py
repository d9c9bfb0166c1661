"""The edges that a configuration declares under `inputs:`, each with its type checked; whatever is wrong is noted.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, cast

from flow.classes import KINDS
from flow.edge import Edge, Waiting, read_waiting, usual_waiting
from flow.message import Message
from flow.node_spec import NodeSpec
from flow.problem import did_you_mean, one_of
from flow.stage import input_ports, output_ports
from flow.tree import Path_, Tree


def read_edges(tree: Tree, nodes: Mapping[str, NodeSpec], spec: NodeSpec, left: Mapping[str, str]) -> Iterator[Edge]:
    """The edges into one node; a port that must be wired and is not is a problem in `tree`.

    `left`: nodes left out, with what each of them needs. A port that need not be wired does without such a one.
    """
    path = (spec.kind, spec.name, "inputs")
    ports = input_ports(spec.cls)
    declared: Any = tree.values[spec.kind][spec.name].get("inputs") or {}
    if not isinstance(declared, dict):
        tree.problem(path, "must be a mapping of port: node.output.")
        return
    wires = {port: wire for port, wire in cast("dict[str, Any]", declared).items() if wire is not None}  # null: unwired
    for port, declaration in wires.items():
        producer = _source(declaration)[1]
        if port in ports and producer in left:
            if port not in spec.cls.optional_inputs:
                needs = left[producer]
                why = f"'{producer}' is left out, as nothing stands for {needs}"
                tree.problem((*path, port), f"{why}: say 'needs: {needs}' here, too.")
        elif port in ports:
            yield from _edge(tree, nodes, spec, port, declaration)
        else:
            cls = spec.cls.__name__
            takes = f" {cls} takes {one_of(ports)}." if ports else f" {cls} takes no inputs."
            tree.problem((*path, port), f"unknown port '{port}'.{did_you_mean(port, ports) or takes}")
    for port, wanted in ports.items():
        if port not in wires and port not in spec.cls.optional_inputs:
            tree.problem(path, f"port '{port}' ({wanted.__name__}) is not wired.{_whence(nodes, wanted)}")


def _source(declaration: Any) -> tuple[Any, str, str]:
    """What a wire, `node.output` or `{from: node.output, ...}`, says: as written, its node, its output; else empty."""
    source = cast("dict[str, Any]", declaration).get("from") if isinstance(declaration, dict) else declaration
    node, _, output = source.partition(".") if isinstance(source, str) else ("", "", "")
    return source, node, output


def _edge(tree: Tree, nodes: Mapping[str, NodeSpec], spec: NodeSpec, port: str, declaration: Any) -> Iterator[Edge]:
    """The edge that `node.output`, or `{from: node.output, ...}`, declares; none where it is wrong."""
    here = (spec.kind, spec.name, "inputs", port)
    waiting = cast("dict[str, Any]", declaration) if isinstance(declaration, dict) else {}
    source, node, output = _source(declaration)
    if not (node and output):
        form = "say 'from: node.output'" if waiting else "read node.output"
        tree.problem(here, f"must {form}, got {source!r}.")
        return
    if node not in nodes:
        if not any(node in (tree.values.get(kind) or {}) for kind in KINDS):  # else its own problem is said already
            tree.problem(here, f"no stage or link '{node}'.{did_you_mean(node, nodes)}")
        return
    outputs, wanted = output_ports(nodes[node].cls), input_ports(spec.cls)[port]
    message = outputs.get(output)
    if message is None:
        gives = f" {node} gives {one_of(outputs)}." if outputs else f" {node} gives nothing."
        tree.problem(here, f"'{node}' has no output '{output}'.{did_you_mean(output, outputs) or gives}")
    elif not issubclass(message, wanted):
        has, wants = message.__name__, wanted.__name__
        tree.problem(here, f"type mismatch: {node}.{output} is {has}, {spec.name}.{port} takes {wants}.")
    else:
        yield Edge(node, output, spec.name, port, message, _waiting(tree, here, message, waiting))


def _whence(nodes: Mapping[str, NodeSpec], wanted: type[Message]) -> str:
    """Which outputs of the graph an open port could be wired to."""
    fits = [f"{n.name}.{o}" for n in nodes.values() for o, m in output_ports(n.cls).items() if issubclass(m, wanted)]
    return f" Of that type there is {one_of(fits)}." if fits else f" Nothing in the graph gives {wanted.__name__}."


def _waiting(tree: Tree, path: Path_, message: type[Message], declared: dict[str, Any]) -> Waiting:
    waiting, problems = read_waiting(declared, usual_waiting(message))
    for key, text in problems:
        tree.problem((*path, key), text)
    return waiting
