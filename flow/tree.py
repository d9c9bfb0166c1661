"""Configuration files as one tree that remembers where each value was written.

`include:` composes files (they come first, the including file on top), overlay files and `--set track.radius_m=0.8`
change what is there, `$rig.lidar.mount` stands for another value of the tree, and `$rig.cameras.drone.readout_ms or 0`
for 0 where there is none. Mappings merge, everything else is replaced, `null` removes a stage or link, a stage whose
`use` changes starts with an empty `config`, and a lens whose `model` changes is replaced: other numbers belong to it.

Source: ours. YAML 1.1 through PyYAML's safe loader: no object construction, bounded sizes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import yaml

from flow.problem import ConfigError, Place, Problem, did_you_mean

MAX_FILE_BYTES = 1_000_000
MAX_VALUES = 100_000  # after aliases are expanded
MAX_DEPTH = 40

Path_ = tuple[str, ...]
Section = tuple[Any, Place]


@dataclass
class Tree:
    """A merged configuration: plain values, the place of each, and the problems met so far."""

    values: dict[str, Any] = field(default_factory=dict[str, Any])
    places: dict[Path_, Place] = field(default_factory=dict[Path_, Place])
    problems: list[Problem] = field(default_factory=list[Problem])
    root: Place = field(default_factory=lambda: Place("configuration", 0))

    def place(self, path: Path_) -> Place:
        """Where `path`, or the nearest thing above it, was written."""
        while path and path not in self.places:
            path = path[:-1]
        return self.places.get(path, self.root)

    def problem(self, path: Path_, text: str, place: Place | None = None) -> None:
        """Note one thing wrong at `path`."""
        self.problems.append(Problem(place or self.place(path), ".".join(path), text))


def load_tree(
    file: Path, overlays: Sequence[Path] = (), sets: Sequence[str] = (), sections: Mapping[str, Section] | None = None
) -> Tree:
    """Read `file` with its includes, lay `overlays` and then `sets` ("track.radius_m=0.8") over it.

    `sections` stand in for whole sections of the file itself (a recording brings its own `rig`), below the overlays.

    What is wrong with the files' form is in `tree.problems`; only an unreadable main file raises at once (ConfigError).
    """
    tree = Tree(root=Place(str(file), 0))
    _merge(tree, _read(file, tree, ()))
    for key, (value, place) in (sections or {}).items():
        tree.values.pop(key, None)
        _merge(tree, _tree_of({key: value}, place))
    for path in overlays:
        _merge(tree, _read(path, tree, ()))
    for text in sets:
        _set(tree, text)
    if not tree.values and tree.problems:
        raise ConfigError(tree.problems)
    return tree


def resolve(tree: Tree, path: Path_, value: Any) -> Any:
    """`value` with every `$rig.lidar.mount` in it replaced by what stands there; unknown ones are noted as problems."""
    return _resolve(tree, path, value, ())


def _resolve(tree: Tree, path: Path_, value: Any, within: tuple[str, ...]) -> Any:
    if isinstance(value, dict):
        items = cast("dict[str, Any]", value)
        return {k: _resolve(tree, (*path, k), v, within) for k, v in items.items()}
    if isinstance(value, list):
        return [_resolve(tree, (*path, str(i)), v, within) for i, v in enumerate(cast("list[Any]", value))]
    if not (isinstance(value, str) and value.startswith("$")):
        return value
    if value in within:
        tree.problem(path, f"'{value}' stands for itself.")
        return None
    here: Any = tree.values
    named, _, default = value[1:].partition(" or ")
    for i, part in enumerate(parts := named.split(".")):
        known = cast("dict[str, Any]", here) if isinstance(here, dict) else {}
        if part not in known:
            if default and not did_you_mean(part, known):  # a mistyped name is none that may be missing
                return _scalar(tree, path, default)
            above = ".".join(parts[:i]) or "the configuration"
            tree.problem(path, f"'{value}' stands for nothing: {above} has no '{part}'.{did_you_mean(part, known)}")
            return None
        here = known[part]
    return _resolve(tree, path, here, (*within, value))


def _scalar(tree: Tree, path: Path_, text: str) -> str | int | float | bool | None:
    """A plain value written after `or`."""
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        value = ()
    if value is None or (isinstance(value, str | int | float | bool) and not text.startswith("$")):
        return value
    tree.problem(path, f"'{text}' after 'or' is no plain value: write a number, a word, true, false or null.")
    return None


def _read(file: Path, tree: Tree, including: tuple[Path, ...]) -> Tree:
    """One file with its includes merged below it, as a tree of its own; problems go to `tree`."""
    own = Tree(root=Place(str(file), 0))

    def wrong(text: str, line: int = 0) -> Tree:
        tree.problems.append(Problem(Place(str(file), line), "", text))
        return own

    try:
        with file.open("rb") as stream:
            data = stream.read(MAX_FILE_BYTES + 1)
    except FileNotFoundError:
        near = did_you_mean(file.name, [p.name for p in file.parent.glob("*.y*ml")]) if file.parent.is_dir() else ""
        return wrong(f"no such file.{near}")
    except OSError as error:
        return wrong(f"cannot be read: {error.strerror}.")
    if len(data) > MAX_FILE_BYTES:
        return wrong(f"larger than {MAX_FILE_BYTES} bytes: that is no configuration.")
    try:
        node = _compose(data.decode("utf-8"))
    except UnicodeDecodeError as error:
        return wrong(f"is not UTF-8 text (byte {error.start}).")
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 0
        return wrong(f"is not YAML: {error.problem}.", line)
    except (yaml.YAMLError, RecursionError) as error:
        return wrong(f"is not YAML: {str(error).splitlines()[0]}.")
    if node is None:
        return wrong("is empty.")
    if not isinstance(node, yaml.MappingNode):
        return wrong("must be a mapping with 'stages:' and 'links:' at the top.", 1)

    try:
        own.values = _plain(node, (), str(file), own, [MAX_VALUES])
    except OverflowError as error:
        return wrong(str(error))
    tree.problems += own.problems
    own.problems = []

    includes = own.values.pop("include", [])
    below = Tree(root=own.root)
    for name in cast("list[Any]", includes if isinstance(includes, list) else [includes]):
        place = own.place(("include",))
        if not isinstance(name, str):
            tree.problems.append(Problem(place, "include", f"must be a file name or a list of them, got {name!r}."))
            continue
        target = file.parent / name
        chain = (*including, file.resolve())
        if target.resolve() in chain:
            tree.problems.append(Problem(place, "include", f"'{name}' includes itself."))
        elif not target.is_file():
            near = did_you_mean(name, [p.name for p in file.parent.glob("*.y*ml") if p != file])
            tree.problems.append(Problem(place, "include", f"no such file '{name}'.{near}"))
        else:
            _merge(below, _read(target, tree, chain))
    _merge(below, own)
    return below


def _plain(node: yaml.Node, path: Path_, file: str, tree: Tree, budget: list[int]) -> Any:
    """YAML nodes to plain values; places and problems go to `tree`."""
    budget[0] -= 1
    if budget[0] < 0 or len(path) > MAX_DEPTH:
        raise OverflowError("is too large or too deep: that is no configuration.")
    place = Place(file, node.start_mark.line + 1)
    tree.places.setdefault(path, place)
    if isinstance(node, yaml.SequenceNode):
        items = cast("list[yaml.Node]", node.value)
        return [_plain(item, (*path, str(i)), file, tree, budget) for i, item in enumerate(items)]
    if isinstance(node, yaml.MappingNode):
        result: dict[str, Any] = {}
        for key_node, value_node in cast("list[tuple[yaml.Node, yaml.Node]]", node.value):
            key = str(key_node.value) if isinstance(key_node, yaml.ScalarNode) else "?"
            here = Place(file, key_node.start_mark.line + 1)
            if not isinstance(key_node, yaml.ScalarNode) or key_node.tag == "tag:yaml.org,2002:merge":
                tree.problem(path, "a key must be a plain word.", here)
                continue
            if key in result:
                tree.problem((*path, key), f"is written twice (first on line {tree.places[(*path, key)].line}).", here)
                continue
            tree.places[(*path, key)] = here
            result[key] = _plain(value_node, (*path, key), file, tree, budget)
        return result
    try:
        return _construct(node)
    except (yaml.YAMLError, ValueError) as error:
        tree.problem(path, f"has a value that cannot be read: {str(error).splitlines()[0]}.", place)
        return None


def _compose(text: str) -> yaml.Node | None:
    return cast("yaml.Node | None", yaml.compose(text, Loader=yaml.SafeLoader))  # pyright: ignore[reportUnknownMemberType]


def _construct(node: yaml.Node) -> Any:
    loader = yaml.SafeLoader("")
    try:
        return cast(Any, loader.construct_object(node, deep=True))  # pyright: ignore[reportUnknownMemberType]
    finally:
        loader.dispose()  # pyright: ignore[reportUnknownMemberType]


def _tree_of(values: dict[str, Any], place: Place) -> Tree:
    """A tree whose values all come from one place."""
    tree = Tree(values=values, root=place)
    _place_all(tree, (), values, place)
    return tree


def _place_all(tree: Tree, path: Path_, value: Any, place: Place) -> None:
    tree.places[path] = place
    if isinstance(value, dict):
        for key, item in cast("dict[str, Any]", value).items():
            _place_all(tree, (*path, key), item, place)


def _merge(base: Tree, top: Tree) -> None:
    """Lay `top` over `base`, in place."""
    base.problems += top.problems
    _merge_mapping(base, top, (), base.values, top.values)


def _forget(tree: Tree, path: Path_) -> None:
    for known in [p for p in tree.places if p[: len(path)] == path]:
        del tree.places[known]


def _merge_mapping(base: Tree, top: Tree, path: Path_, below: dict[str, Any], above: dict[str, Any]) -> None:
    is_node = len(path) == 2 and path[0] in ("stages", "links")
    if is_node and "use" in above and "use" in below and above["use"] != below["use"]:
        below.pop("config", None)  # settings of the class that is no longer used
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
                base.problem(here, "removes what is not there.", top.place(here))
            continue
        below[key] = value
        base.places.update({p: q for p, q in top.places.items() if p[: len(here)] == here})


def _set(tree: Tree, text: str) -> None:
    """Apply `track.radius_m=0.8`: a stage's or link's name and a setting, or a whole path (`rig.drone.span_m=0.35`)."""
    place = Place(f"--set {text}", 0)
    key, equals, raw = text.partition("=")
    parts = tuple(key.strip().split("."))
    if not equals or len(parts) < 2 or not all(parts):
        tree.problem((), "must read NAME.SETTING=VALUE, as in --set track.radius_m=0.8.", place)
        return
    if parts[0] not in ("stages", "links", "rig"):
        kinds = [kind for kind in ("stages", "links") if parts[0] in (tree.values.get(kind) or {})]
        if not kinds:
            names: list[str] = [*(tree.values.get("stages") or {}), *(tree.values.get("links") or {}), "rig"]
            tree.problem((), f"no stage or link '{parts[0]}'.{did_you_mean(parts[0], names)}", place)
            return
        parts = (kinds[0], parts[0], "config", *parts[1:])
    try:
        value = yaml.safe_load(raw)
    except yaml.YAMLError as error:
        tree.problem((), f"the value is not YAML: {str(error).splitlines()[0]}.", place)
        return
    for part in reversed(parts):
        value = {part: value}
    _merge(tree, _tree_of(cast("dict[str, Any]", value), place))
