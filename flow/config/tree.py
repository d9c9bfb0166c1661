"""Configuration files as one tree that keeps where each value was written.

- `include:` composes files: included files come first, the including file on top.
- Overlay files and `--set track.radius_m=0.8` change values.
- `$rig.lidar.mount` is replaced by another value of the tree. `$rig.cameras.drone.readout_ms or 0` is 0 where the tree
  has no such value.

Mappings merge; everything else is replaced. `null` removes a stage or link. A stage whose `use` changes starts with an
empty `config`. A lens whose `model` changes is replaced, because its numbers belong to the model.

Source: ours. YAML 1.1 by PyYAML's safe loader: it constructs no objects, and sizes are bounded here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import yaml

from flow.config_error import ConfigError, ErrorDetail, Location, did_you_mean

MAX_FILE_BYTES = 1_000_000
MAX_VALUES = 100_000  # after aliases are expanded
MAX_DEPTH = 40

KeyPath = tuple[str, ...]
Section = tuple[Any, Location]


@dataclass
class Tree:
    """A merged configuration: plain values, the location of each, and the errors found so far."""

    values: dict[str, Any] = field(default_factory=dict[str, Any])
    locations: dict[KeyPath, Location] = field(default_factory=dict[KeyPath, Location])
    errors: list[ErrorDetail] = field(default_factory=list[ErrorDetail])
    root: Location = field(default_factory=lambda: Location("configuration", 0))

    def location(self, path: KeyPath) -> Location:
        """Where the value at `path`, or the nearest one above it, was written."""
        while path and path not in self.locations:
            path = path[:-1]
        return self.locations.get(path, self.root)

    def error(self, path: KeyPath, text: str, location: Location | None = None) -> None:
        """Add an error at `path`."""
        self.errors.append(ErrorDetail(location or self.location(path), ".".join(path), text))


def load_tree(
    file: Path, overlays: Sequence[Path] = (), sets: Sequence[str] = (), sections: Mapping[str, Section] | None = None
) -> Tree:
    """Read `file` with its includes, then merge `overlays` and `sets` ("track.radius_m=0.8") over it.

    `sections` replace whole sections of the file itself, below the overlays: a recording has its own `rig`.

    Errors of form are in `tree.errors`. ConfigError: the main file cannot be read at all.
    """
    tree = Tree(root=Location(str(file), 0))
    _merge(tree, _read(file, tree, ()))
    for key, (value, location) in (sections or {}).items():
        tree.values.pop(key, None)
        _merge(tree, _tree_of({key: value}, location))
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
        value = yaml.safe_load(text)
    except yaml.YAMLError:
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
        near = did_you_mean(file.name, [p.name for p in file.parent.glob("*.y*ml")]) if file.parent.is_dir() else ""
        return failed(f"no such file.{near}")
    except OSError as error:
        return failed(f"cannot be read: {error.strerror}.")
    if len(data) > MAX_FILE_BYTES:
        return failed(f"larger than {MAX_FILE_BYTES} bytes: that is no configuration.")
    try:
        node = _compose(data.decode("utf-8"))
    except UnicodeDecodeError as error:
        return failed(f"is not UTF-8 text (byte {error.start}).")
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 0
        return failed(f"is not YAML: {error.problem}.", line)
    except (yaml.YAMLError, RecursionError) as error:
        return failed(f"is not YAML: {str(error).splitlines()[0]}.")
    if node is None:
        return failed("is empty.")
    if not isinstance(node, yaml.MappingNode):
        return failed("must be a mapping with 'stages:' and 'links:' at the top.", 1)

    try:
        own.values = _plain(node, (), str(file), own, [MAX_VALUES])
    except OverflowError as error:
        return failed(str(error))
    tree.errors += own.errors
    own.errors = []

    includes = own.values.pop("include", [])
    below = Tree(root=own.root)
    for name in cast("list[Any]", includes if isinstance(includes, list) else [includes]):
        location = own.location(("include",))
        if not isinstance(name, str):
            text = f"must be a file name or a list of them, got {name!r}."
            tree.errors.append(ErrorDetail(location, "include", text))
            continue
        target = file.parent / name
        chain = (*including, file.resolve())
        if target.resolve() in chain:
            tree.errors.append(ErrorDetail(location, "include", f"'{name}' includes itself."))
        elif not target.is_file():
            near = did_you_mean(name, [p.name for p in file.parent.glob("*.y*ml") if p != file])
            tree.errors.append(ErrorDetail(location, "include", f"no such file '{name}'.{near}"))
        else:
            _merge(below, _read(target, tree, chain))
    _merge(below, own)
    return below


def _plain(node: yaml.Node, path: KeyPath, file: str, tree: Tree, budget: list[int]) -> Any:
    """YAML nodes to plain values; locations and errors go to `tree`."""
    budget[0] -= 1
    if budget[0] < 0 or len(path) > MAX_DEPTH:
        raise OverflowError("is too large or too deep: that is no configuration.")
    location = Location(file, node.start_mark.line + 1)
    tree.locations.setdefault(path, location)
    if isinstance(node, yaml.SequenceNode):
        items = cast("list[yaml.Node]", node.value)
        return [_plain(item, (*path, str(i)), file, tree, budget) for i, item in enumerate(items)]
    if isinstance(node, yaml.MappingNode):
        result: dict[str, Any] = {}
        for key_node, value_node in cast("list[tuple[yaml.Node, yaml.Node]]", node.value):
            key = str(key_node.value) if isinstance(key_node, yaml.ScalarNode) else "?"
            here = Location(file, key_node.start_mark.line + 1)
            if not isinstance(key_node, yaml.ScalarNode) or key_node.tag == "tag:yaml.org,2002:merge":
                tree.error(path, "a key must be a plain word.", here)
                continue
            if key in result:
                tree.error((*path, key), f"is written twice (first on line {tree.locations[(*path, key)].line}).", here)
                continue
            tree.locations[(*path, key)] = here
            result[key] = _plain(value_node, (*path, key), file, tree, budget)
        return result
    try:
        return _construct(node)
    except (yaml.YAMLError, ValueError) as error:
        tree.error(path, f"has a value that cannot be read: {str(error).splitlines()[0]}.", location)
        return None


def _compose(text: str) -> yaml.Node | None:
    return cast("yaml.Node | None", yaml.compose(text, Loader=yaml.SafeLoader))  # pyright: ignore[reportUnknownMemberType]


def _construct(node: yaml.Node) -> Any:
    loader = yaml.SafeLoader("")
    try:
        return cast(Any, loader.construct_object(node, deep=True))  # pyright: ignore[reportUnknownMemberType]
    finally:
        loader.dispose()  # pyright: ignore[reportUnknownMemberType]


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
    """Apply `track.radius_m=0.8`: a stage's or link's name and a setting, or a whole path (`rig.drone.span_m=0.35`).

    In a file without stages and links, such as a scenario, every key is a whole path.
    """
    location = Location(f"--set {text}", 0)
    key, equals, raw = text.partition("=")
    parts = tuple(key.strip().split("."))
    of_graph = bool(tree.values.keys() & {"stages", "links"})
    if not equals or len(parts) < 1 + of_graph or not all(parts):
        tree.error((), "must read NAME.SETTING=VALUE, as in --set track.radius_m=0.8.", location)
        return
    if of_graph and parts[0] not in ("stages", "links", "rig"):
        kinds = [kind for kind in ("stages", "links") if parts[0] in (tree.values.get(kind) or {})]
        if not kinds:
            names: list[str] = [*(tree.values.get("stages") or {}), *(tree.values.get("links") or {}), "rig"]
            tree.error((), f"no stage or link '{parts[0]}'.{did_you_mean(parts[0], names)}", location)
            return
        parts = (kinds[0], parts[0], "config", *parts[1:])
    try:
        value = yaml.safe_load(raw)
    except yaml.YAMLError as error:
        tree.error((), f"the value is not YAML: {str(error).splitlines()[0]}.", location)
        return
    for part in reversed(parts):
        value = {part: value}
    _merge(tree, _tree_of(cast("dict[str, Any]", value), location))
