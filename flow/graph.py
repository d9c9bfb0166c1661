"""The graph: a checked tree of stages and links with typed edges, or all its errors at once, each at file:line.

    stages:
      track:
        use: stages.track.Track            # module.Class
        config: {radius_m: 0.8}            # the class's settings
        inputs: {points: sweep.swept_points}  # how messages wait in a live run: flow/edge.py
        on_error: restart                  # live, when it raises: a fresh one takes over; or skip; or stop the run
        thread: lidar                      # live: shared with others that say so; without it, it has its own
        process: pictures                  # in that, live (flow/stage_process.py) and replayed (flow/apart.py)
        yields: true                       # live: takes fewer pictures while others' queues run over (flow/yielding.py)
    links:
      lidar: {use: links.velodyne.Lidar}   # sources and sinks; the first three keys

Source: ours.
"""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

import yaml
from pydantic import ValidationError

from flow.codec import plan_of
from flow.edge import Edge, Waiting, read_waiting, usual_waiting
from flow.link import RUN_TOPICS, TRUTH_TOPICS, Link, Source
from flow.message import Message
from flow.problem import ConfigError, did_you_mean, one_of
from flow.stage import Node, PortError, Stage, input_ports, output_ports
from flow.tree import Path_, Section, Tree, load_tree, resolve

TOP_LEVEL = ("include", "replay", "rig", "stages", "links")
KINDS: dict[str, type[Node]] = {"stages": Stage, "links": Link}
HOMES = {"stages": "stages", "links": "links"}  # package in which classes of a kind are looked for when suggesting
OnError = Literal["restart", "skip", "stop"]
ON_ERROR: tuple[str, ...] = get_args(OnError)
NODE_KEYS = {
    "stages": ("use", "config", "inputs", "on_error", "thread", "process", "yields"),
    "links": ("use", "config", "inputs"),
}
_NAME = re.compile(r"[a-z][a-z0-9_]*\Z")


@dataclass(frozen=True, slots=True)
class NodeSpec:
    """One stage or link as declared: its class and checked settings."""

    name: str
    kind: str  # "stages" or "links"
    use: str  # import path as declared
    cls: type[Node]
    config: dict[str, Any]
    on_error: OnError = "restart"  # of a stage that raises in a live run
    thread: str = ""  # of a stage in a live run; stages of one name share it
    process: str = ""  # of a stage, not the run's own; stages of one name share it
    yields: bool = False  # of a stage in a live run, to others that do not keep up

    def build(self) -> Node:
        """A fresh instance with empty memory."""
        return self.cls.model_validate(self.config)


@dataclass(frozen=True, slots=True)
class Graph:
    """A graph without errors, ready to run. `nodes` stand in rank order: producers before consumers."""

    nodes: dict[str, NodeSpec]
    edges: tuple[Edge, ...]
    replay: Path | None  # recording named by the configuration
    values: dict[str, Any]  # the merged configuration

    def settings_yaml(self) -> str:
        """The merged configuration as YAML text: includes, overlays and --set applied."""
        return yaml.safe_dump(self.values, sort_keys=False, width=120)

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
    nodes = {spec.name: spec for kind in KINDS for spec in _nodes(tree, kind)}
    if not tree.values.get("stages"):
        tree.problem(("stages",), "no stages: a graph needs at least one.")
    edges = tuple(edge for spec in nodes.values() for edge in _edges(tree, nodes, spec))
    _check_threads(tree, nodes, edges)
    _check_processes(tree, nodes)
    _check_topics(tree, nodes)
    order = _rank(tree, nodes, edges)
    return Graph({name: nodes[name] for name in order}, edges, _recording(tree, file), tree.values)


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


def _nodes(tree: Tree, kind: str) -> Iterator[NodeSpec]:
    section = tree.values.get(kind)
    if section is None:
        return
    if not isinstance(section, dict):
        tree.problem((kind,), "must be a mapping of names.")
        return
    for name, raw in cast("dict[str, Any]", section).items():
        path = (kind, name)
        if not _NAME.match(name):
            tree.problem(path, f"'{name}' is no name: use small letters, digits and '_', starting with a letter.")
            continue
        if kind == "links" and name in (tree.values.get("stages") or {}):
            tree.problem(path, f"a stage is called '{name}' already; an edge could not tell them apart.")
            continue
        if not isinstance(raw, dict):
            tree.problem(path, "must be a mapping with 'use:', and 'config:' and 'inputs:' where needed.")
            continue
        declared = cast("dict[str, Any]", raw)
        for key in declared:
            if key not in NODE_KEYS[kind]:
                known = NODE_KEYS[kind]
                tree.problem((*path, key), f"unknown key '{key}'; there is {one_of(known)}.{did_you_mean(key, known)}")
        on_error: Any = declared.get("on_error", "restart")
        if on_error not in ON_ERROR:
            near = did_you_mean(on_error, ON_ERROR) if isinstance(on_error, str) else ""
            tree.problem((*path, "on_error"), f"must be {one_of(ON_ERROR)}, got {on_error!r}.{near}")
        thread: Any = declared.get("thread", name)
        if not (isinstance(thread, str) and _NAME.match(thread)):
            tree.problem((*path, "thread"), f"must be a name as stages have, got {thread!r}.")
        process: Any = declared.get("process", "")
        if not (isinstance(process, str) and (process == "" or _NAME.match(process))):
            tree.problem((*path, "process"), f"must be a name as stages have, got {process!r}.")
        elif process and "thread" in declared:
            tree.problem((*path, "process"), "in a process each stage has a thread of its own: leave 'thread' out.")
        yields: Any = declared.get("yields", False)
        if not isinstance(yields, bool):
            tree.problem((*path, "yields"), f"must be true or false, got {yields!r}.")
        cls = _class(tree, kind, path, declared.get("use"))
        if cls is not None:
            before = len(tree.problems)
            config = resolve(tree, (*path, "config"), declared.get("config") or {})
            if len(tree.problems) == before:  # a reference to nothing is said already
                config = _settings(tree, path, cls, config)
            error: OnError = cast(OnError, on_error)
            use = declared["use"]
            yield NodeSpec(name, kind, use, cls, config, error, str(thread), str(process), yields is True)


def _class(tree: Tree, kind: str, path: Path_, use: Any) -> type[Node] | None:
    """The class an import path names, or None with the problem noted."""
    here = (*path, "use")
    word = kind.removesuffix("s")
    if not isinstance(use, str) or "." not in use:
        tree.problem(here, f"must name a class as module.Class, got {use!r}." if use is not None else "is missing.")
        return None
    module_name, _, class_name = use.rpartition(".")
    if not all(part.isidentifier() for part in use.split(".")) or not _exists(module_name):
        tree.problem(here, f"unknown {word} '{use}'.{did_you_mean(use, known_classes(kind))}")
        return None
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        tree.problem(here, f"'{module_name}' cannot be imported: {error}.")
        return None
    cls: Any = getattr(module, class_name, None)
    if cls is None:
        tree.problem(here, f"unknown {word} '{use}'.{did_you_mean(use, known_classes(kind))}")
    elif not (isinstance(cls, type) and issubclass(cls, KINDS[kind])):
        right = next((k for k, base in KINDS.items() if isinstance(cls, type) and issubclass(cls, base)), None)
        hint = f"; it belongs under '{right}:'" if right else ""
        tree.problem(here, f"'{use}' is no {word}{hint}.")
    else:
        try:
            input_ports(cls)
            output_ports(cls)
        except PortError as error:
            tree.problem(here, f"'{use}' is written wrongly: {error}.")
        else:
            return cls
    return None


def _exists(module_name: str) -> bool:
    try:
        return importlib.util.find_spec(module_name) is not None
    except (ImportError, ValueError):
        return False


def known_classes(kind: str) -> list[str]:
    """Import paths of the usable classes of a kind, for suggestions and the schema.

    The text of the home package is read, not run: a suggestion must not import every driver.
    """
    spec = importlib.util.find_spec(HOMES[kind])
    found: list[str] = []
    for folder in (spec.submodule_search_locations or []) if spec else []:
        for module in pkgutil.walk_packages([folder], f"{HOMES[kind]}."):
            file = Path(folder, *module.name.split(".")[1:])
            source = file / "__init__.py" if module.ispkg else file.with_suffix(".py")
            classes = re.findall(
                r"^class (\w+)\((?:\w+, )*(?:Stage|Source|Link|Tap)\b", source.read_text("utf-8"), re.M
            )
            # a class in a private room of a package is used through the front door, a stages/x.py as it is
            private = not module.ispkg and (kind != "stages" or module.name.count(".") > 1)
            home = module.name.rpartition(".")[0] if private else module.name
            door = (file.parent / "__init__.py").read_text("utf-8") if private else source.read_text("utf-8")
            found += [f"{home}.{name}" for name in classes if re.search(rf"\b{name}\b", door)]
    return sorted(dict.fromkeys(found))


def _settings(tree: Tree, path: Path_, cls: type[Node], config: Any) -> dict[str, Any]:
    here = (*path, "config")
    if not isinstance(config, dict):
        tree.problem(here, "must be a mapping of settings.")
        return {}
    settings = cast("dict[str, Any]", config)
    try:
        cls.model_validate(settings)
    except ValidationError as errors:
        for error in errors.errors(include_url=False):
            where = (*here, *(str(part) for part in error["loc"]))
            known = cls.model_fields if len(error["loc"]) == 1 else ()
            tree.problem(where, _said(error, cls.__name__, known))
    return settings


def _said(error: Any, class_name: str, known: Any) -> str:
    """A pydantic error in the words of a person."""
    name = str(error["loc"][-1]) if error["loc"] else ""
    if error["type"] == "extra_forbidden":
        has = f" {class_name} has {one_of(known)}." if known else ""
        return f"unknown setting '{name}'.{did_you_mean(name, known) or has}"
    if error["type"] == "missing":
        return "is missing and has no default."
    text = str(error["msg"]).removeprefix("Value error, ").removeprefix("Input should be ").removesuffix(".")
    text = text if error["type"] == "value_error" else f"must be {text}"
    return f"{text}, got {error['input']!r}." if not isinstance(error["input"], dict) else f"{text}."


def _edges(tree: Tree, nodes: dict[str, NodeSpec], spec: NodeSpec) -> Iterator[Edge]:
    path = (spec.kind, spec.name, "inputs")
    ports = input_ports(spec.cls)
    declared: Any = tree.values[spec.kind][spec.name].get("inputs") or {}
    if not isinstance(declared, dict):
        tree.problem(path, "must be a mapping of port: node.output.")
        return
    wires = {port: wire for port, wire in cast("dict[str, Any]", declared).items() if wire is not None}  # null: unwired
    for port, declaration in wires.items():
        here = (*path, port)
        waiting = cast("dict[str, Any]", declaration) if isinstance(declaration, dict) else {}
        source = waiting.get("from") if isinstance(declaration, dict) else declaration
        if port not in ports:
            takes = (
                f" {spec.cls.__name__} takes {one_of(ports)}." if ports else f" {spec.cls.__name__} takes no inputs."
            )
            tree.problem(here, f"unknown port '{port}'.{did_you_mean(port, ports) or takes}")
            continue
        node, dot, output = source.partition(".") if isinstance(source, str) else ("", "", "")
        if not (node and dot and output):
            form = "say 'from: node.output'" if waiting else "read node.output"
            tree.problem(here, f"must {form}, got {source!r}.")
        elif node not in nodes:
            if not any(node in (tree.values.get(kind) or {}) for kind in KINDS):  # else its own problem is said already
                tree.problem(here, f"no stage or link '{node}'.{did_you_mean(node, nodes)}")
        else:
            outputs = output_ports(nodes[node].cls)
            if output not in outputs:
                gives = f" {node} gives {one_of(outputs)}." if outputs else f" {node} gives nothing."
                tree.problem(here, f"'{node}' has no output '{output}'.{did_you_mean(output, outputs) or gives}")
            elif not issubclass(outputs[output], ports[port]):
                has, wants = outputs[output].__name__, ports[port].__name__
                tree.problem(here, f"type mismatch: {node}.{output} is {has}, {spec.name}.{port} takes {wants}.")
            else:
                message = outputs[output]
                yield Edge(node, output, spec.name, port, message, _waiting(tree, here, message, waiting))
    for port, wanted in ports.items():
        if port not in wires and port not in spec.cls.optional_inputs:
            fits = [
                f"{n.name}.{o}" for n in nodes.values() for o, m in output_ports(n.cls).items() if issubclass(m, wanted)
            ]
            hint = (
                f" Of that type there is {one_of(fits)}." if fits else f" Nothing in the graph gives {wanted.__name__}."
            )
            tree.problem(path, f"port '{port}' ({wanted.__name__}) is not wired.{hint}")


def _waiting(tree: Tree, path: Path_, message: type[Message], declared: dict[str, Any]) -> Waiting:
    waiting, problems = read_waiting(declared, usual_waiting(message))
    for key, text in problems:
        tree.problem((*path, key), text)
    return waiting


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
            topic = str(spec.config.get("topic", spec.cls.model_fields["topic"].default))
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
