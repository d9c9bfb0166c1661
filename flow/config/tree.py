"""Configuration files as one tree that keeps where each value was written.

- `include:` composes files: included files come first, the including file on top. A file is looked for next to the
  including one, then among those that come with the program.
- An include may take some stages and links of a file alone, under other names: see `_copied`.
- Overlay files and `--set detect.accept_probability=0.9` change values.
- `$rig.lidar.mount` is replaced by another value of the tree. `$rig.cameras.drone.readout_ms or 0` is 0 where the tree
  has no such value.

Mappings merge; everything else is replaced. `null` removes a stage or link. A stage whose `use` changes starts with an
empty `config`. A lens whose `model` changes is replaced, because its numbers belong to the model.

Source: ours. The bounds of a file are those of `yaml_text`; those of all references together are here.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from flow.config.yaml_text import (
    MAX_DEPTH,
    MAX_FILE_BYTES,
    MAX_VALUES,
    KeyPath,
    YamlText,
    YamlTextError,
    read_yaml,
    yaml_values,
)
from flow.config_error import ConfigError, ErrorDetail, Location, did_you_mean

SHIPPED = Path(__file__).resolve().parents[2] / "configs"  # the configurations that come with the program
COPY_FORM = "{file: ..., nodes: [...], suffix: ...}"
SET_FORMS = (("KEY", "autopilot.imu_hz=25"), ("NAME.SETTING", "detect.accept_probability=0.9"))  # scenario, graph
Section = tuple[str, str]  # YAML text, and where it is from, for errors


@dataclass
class Tree:
    """A merged configuration: plain values, the location of each, and the errors found so far."""

    values: dict[str, Any] = field(default_factory=dict[str, Any])
    locations: dict[KeyPath, Location] = field(default_factory=dict[KeyPath, Location])
    errors: list[ErrorDetail] = field(default_factory=list[ErrorDetail])
    root: Location = field(default_factory=lambda: Location("configuration", 0))
    references_left: int = MAX_VALUES  # values that references may still expand to
    packages: Collection[str] | None = None  # whose classes may be named; None: any

    def location(self, path: KeyPath) -> Location:
        """Where the value at `path`, or the nearest one above it, was written."""
        while path and path not in self.locations:
            path = path[:-1]
        return self.locations.get(path, self.root)

    def last_location(self, path: KeyPath) -> Location:
        """Where the mapping at `path` was written, or the file or option that changed it last."""
        first = self.location(path)
        *_, last = (first, *(at for key, at in self.locations.items() if key[: len(path)] == path))
        return first if last.file == first.file else last

    def error(self, path: KeyPath, text: str, location: Location | None = None) -> None:
        """Add an error at `path`."""
        self.errors.append(ErrorDetail(location or self.location(path), ".".join(path), text))


def load_tree(
    file: Path, overlays: Sequence[Path] = (), sets: Sequence[str] = (), sections: Mapping[str, Section] | None = None
) -> Tree:
    """Read `file` with its includes, then merge `overlays` and `sets` ("detect.accept_probability=0.9") over it.

    `sections` replace whole sections of the file itself, below the overlays: a recording has its own `rig`, as text.

    Errors of form are in `tree.errors`. ConfigError: the main file cannot be read at all.
    """
    tree = Tree(root=Location(str(file), 0))
    _merge(tree, _read(file, tree, ()))
    for key, (text, source) in (sections or {}).items():
        tree.values.pop(key, None)
        _merge(tree, _section(key, text, source))
    for path in overlays:
        _merge(tree, _read(path, tree, ()))
    for text in sets:
        _set(tree, text)
    if not tree.values and tree.errors:
        raise ConfigError(tree.errors)
    return tree


def resolve(tree: Tree, path: KeyPath, value: Any) -> Any:
    """`value` with every reference such as `$rig.lidar.mount` replaced; one to nothing is an error in `tree`."""
    return _resolve(tree, path, value, ())


def _resolve(tree: Tree, path: KeyPath, value: Any, within: tuple[str, ...]) -> Any:
    tree.references_left -= len(within) > 0
    if tree.references_left <= 0:
        if tree.references_left == 0:
            tree.error(path, f"references expand to more than {MAX_VALUES} values.")
            tree.references_left -= 1
        return None
    if isinstance(value, dict):
        items = cast("dict[str, Any]", value)
        return {k: _resolve(tree, (*path, k), v, within) for k, v in items.items()}
    if isinstance(value, list):
        return [_resolve(tree, (*path, str(i)), v, within) for i, v in enumerate(cast("list[Any]", value))]
    if not (isinstance(value, str) and value.startswith("$")):
        return value
    if value in within:
        tree.error(path, f"'{value}' refers to itself.")
        return None
    if len(within) > MAX_DEPTH:
        tree.error(path, f"'{value}' refers through more than {MAX_DEPTH} others.")
        return None
    here: Any = tree.values
    named, _, default = value[1:].partition(" or ")
    for i, part in enumerate(parts := named.split(".")):
        known = cast("dict[str, Any]", here) if isinstance(here, dict) else {}
        if part not in known:
            if default and not did_you_mean(part, known):  # a mistyped name is an error, not a missing value
                return _scalar(tree, path, default)
            above = ".".join(parts[:i]) or "the configuration"
            tree.error(path, f"'{value}' refers to nothing: {above} has no '{part}'.{did_you_mean(part, known)}")
            return None
        here = known[part]
    return _resolve(tree, path, here, (*within, value))


def _scalar(tree: Tree, path: KeyPath, text: str) -> str | int | float | bool | None:
    """A plain value written after `or`."""
    try:
        value = yaml_values(text)
    except YamlTextError:
        value = ()
    if value is None or (isinstance(value, str | int | float | bool) and not text.startswith("$")):
        return value
    tree.error(path, f"'{text}' after 'or' is no plain value: write a number, a word, true, false or null.")
    return None


def _read(file: Path, tree: Tree, including: tuple[Path, ...]) -> Tree:
    """One file with its includes merged below it, as a tree of its own; errors go to `tree`."""
    own = Tree(root=Location(str(file), 0))

    def failed(text: str, line: int = 0) -> Tree:
        tree.errors.append(ErrorDetail(Location(str(file), line), "", text))
        return own

    try:
        with file.open("rb") as stream:
            data = stream.read(MAX_FILE_BYTES + 1)
    except FileNotFoundError:
        return failed(f"no such file.{_similar_file(file)}")
    except OSError as error:
        return failed(f"cannot be read: {error.strerror}.")
    try:
        text = read_yaml(data)
    except YamlTextError as error:
        return failed(str(error), error.line)
    if text.values is None:
        return failed("is empty.")
    if not isinstance(text.values, dict):
        return failed("must be a mapping at the top, as in 'name: value'.", 1)
    own = _tree_of_text(text, str(file))
    tree.errors += own.errors
    own.errors = []

    includes = own.values.pop("include", [])
    below = Tree(root=own.root)
    for entry in cast("list[Any]", includes if isinstance(includes, list) else [includes]):
        location = own.location(("include",))
        copied = cast("dict[str, Any]", entry) if isinstance(entry, dict) else {}
        name = copied.get("file", entry)
        if not isinstance(name, str) or (copied and not _is_copy(copied)):
            text = f"must be a file name, {COPY_FORM}, or a list of them, got {entry!r}."
            tree.errors.append(ErrorDetail(location, "include", text))
            continue
        target = file.parent / name
        if not target.is_file() and (SHIPPED / name).is_file():
            target = SHIPPED / name
        chain = (*including, file.resolve())
        if target.resolve() in chain:
            tree.errors.append(ErrorDetail(location, "include", f"'{name}' includes itself."))
        elif not target.is_file():
            near = _similar_file(target)
            tree.errors.append(ErrorDetail(location, "include", f"no such file '{name}'.{near}"))
        else:
            included = _read(target, tree, chain)
            _merge(below, _copied(included, copied, tree, location) if copied else included)
    _merge(below, own)
    return below


def _is_copy(entry: dict[str, Any]) -> bool:
    """Whether an include has the form COPY_FORM."""
    nodes, suffix = entry.get("nodes"), entry.get("suffix")
    names = isinstance(nodes, list) and all(isinstance(n, str) for n in cast("list[Any]", nodes))
    return entry.keys() == {"file", "nodes", "suffix"} and names and isinstance(suffix, str) and suffix != ""


def _copied(included: Tree, entry: dict[str, Any], tree: Tree, location: Location) -> Tree:
    """Some stages and links of an included file, each name with the suffix; the edges among them lead to the copies.

    `{file: estimate.yaml, nodes: [detect, track], suffix: _2}` gives detect_2 and track_2; track_2 takes the detections
    of detect_2 and, as track does, the pulses of sweep.
    """
    suffix: str = entry["suffix"]
    names: dict[str, str] = {name: name + suffix for name in entry["nodes"]}
    own = Tree(root=included.root)
    known: list[str] = []
    for kind in ("stages", "links"):
        section = included.values.get(kind)
        nodes = cast("dict[str, Any]", section) if isinstance(section, dict) else {}
        known += nodes
        own.values[kind] = {names[name]: _with_inputs(node, names) for name, node in nodes.items() if name in names}
    for path, at in included.locations.items():
        if len(path) > 1 and path[0] in own.values and path[1] in names:
            own.locations[(path[0], names[path[1]], *path[2:])] = at
    for name in names:
        if name not in known:
            text = f"'{entry['file']}' has no stage or link '{name}'.{did_you_mean(name, known)}"
            tree.errors.append(ErrorDetail(location, "include", text))
    return own


def _with_inputs(node: Any, names: dict[str, str]) -> Any:
    """A stage or link whose inputs name the renamed nodes."""
    own = cast("dict[str, Any]", node) if isinstance(node, dict) else {}
    inputs = own.get("inputs")
    if not isinstance(inputs, dict):
        return cast(Any, node)
    sources = cast("dict[str, Any]", inputs)
    return own | {"inputs": {port: _renamed(source, names) for port, source in sources.items()}}


def _renamed(source: Any, names: dict[str, str]) -> Any:
    """An input's declaration, `node.output` or `{from: node.output, ...}`, with the node renamed."""
    if isinstance(source, dict):
        queue = cast("dict[str, Any]", source)
        return queue | {"from": _renamed(queue.get("from"), names)}
    node, dot, output = source.partition(".") if isinstance(source, str) else (source, "", "")
    return f"{names[node]}{dot}{output}" if node in names else source


def _similar_file(file: Path) -> str:
    """` Did you mean 'x.yaml'?` for the YAML file next to `file` whose name is the most similar, or nothing."""
    names = {p.stem: p.name for p in file.parent.glob("*.y*ml")} if file.parent.is_dir() else {}
    found = difflib.get_close_matches(file.stem, names, n=1)
    return f" Did you mean '{names[found[0]]}'?" if found else ""


def _tree_of_text(text: YamlText, file: str, above: KeyPath = ()) -> Tree:
    """The tree of a text whose top is the value at `above`."""
    tree = Tree(values=text.values, root=Location(file, 0))
    for key in reversed(above):
        tree.values = {key: tree.values}
    tree.locations = {(*above, *path): Location(file, line) for path, line in text.lines.items()}
    tree.errors = [
        ErrorDetail(Location(file, line), ".".join((*above, *path)), error) for path, error, line in text.errors
    ]
    return tree


def _section(key: str, text: str, source: str) -> Tree:
    """The tree of one section that is a text of its own."""
    try:
        return _tree_of_text(read_yaml(text), source, (key,))
    except YamlTextError as error:
        return Tree(errors=[ErrorDetail(Location(source, error.line), key, str(error))])


def _tree_of(values: dict[str, Any], location: Location) -> Tree:
    """A tree whose values all have one location."""
    tree = Tree(values=values, root=location)
    _locate_all(tree, (), values, location)
    return tree


def _locate_all(tree: Tree, path: KeyPath, value: Any, location: Location) -> None:
    tree.locations[path] = location
    if isinstance(value, dict):
        for key, item in cast("dict[str, Any]", value).items():
            _locate_all(tree, (*path, key), item, location)


def _merge(base: Tree, top: Tree) -> None:
    """Merge `top` over `base`, which changes."""
    base.errors += top.errors
    _merge_mapping(base, top, (), base.values, top.values)


def _forget(tree: Tree, path: KeyPath) -> None:
    for known in [p for p in tree.locations if p[: len(path)] == path]:
        del tree.locations[known]


def _merge_mapping(base: Tree, top: Tree, path: KeyPath, below: dict[str, Any], above: dict[str, Any]) -> None:
    is_node = len(path) == 2 and path[0] in ("stages", "links")
    if is_node and "use" in above and "use" in below and above["use"] != below["use"]:
        below.pop("config", None)  # settings of the replaced class
        _forget(base, (*path, "config"))
    for key, value in above.items():
        here = (*path, key)
        if isinstance(value, dict) and isinstance(below.get(key), dict):
            values = cast("dict[str, Any]", value)
            if key != "lens" or values.get("model") in (None, below[key].get("model")):
                _merge_mapping(base, top, here, below[key], values)
                continue
        _forget(base, here)
        if value is None and len(here) == 2 and here[0] in ("stages", "links"):
            if below.pop(key, None) is None:
                base.error(here, "removes what does not exist.", top.location(here))
            continue
        below[key] = value
        base.locations.update({p: q for p, q in top.locations.items() if p[: len(here)] == here})


def _set(tree: Tree, text: str) -> None:
    """Apply a changed setting: a stage's or link's name and the setting (`detect.accept_probability=0.9`), or a path.

    A path begins with a section (`rig.drone.span_m=0.35`). In a file without stages and links, such as a scenario,
    every key is a path.
    """
    location = Location(f"--set {text}", 0)
    key, equals, raw = text.partition("=")
    parts = tuple(key.strip().split("."))
    of_graph = bool(tree.values.keys() & {"stages", "links"})
    if not equals or len(parts) < 1 + of_graph or not all(parts):
        form, example = SET_FORMS[of_graph]
        tree.error((), f"must read {form}=VALUE, as in --set {example}.", location)
        return
    if of_graph and parts[0] not in ("stages", "links", "rig"):
        kinds = [kind for kind in ("stages", "links") if parts[0] in (tree.values.get(kind) or {})]
        if not kinds:
            names: list[str] = [*(tree.values.get("stages") or {}), *(tree.values.get("links") or {}), "rig"]
            tree.error((), f"no stage or link '{parts[0]}'.{did_you_mean(parts[0], names)}", location)
            return
        parts = (kinds[0], parts[0], "config", *parts[1:])
    try:
        value = yaml_values(raw)
    except YamlTextError as error:
        tree.error((), f"the value {error}", location)
        return
    for part in reversed(parts):
        value = {part: value}
    _merge(tree, _tree_of(cast("dict[str, Any]", value), location))
