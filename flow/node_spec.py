"""What a configuration declares of each stage and link: class, settings, how it works; whatever is wrong is noted.

Source: ours.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

from pydantic import ValidationError

from flow.classes import named_class
from flow.problem import did_you_mean, one_of
from flow.stage import Node
from flow.tree import Path_, Tree, resolve

OnError = Literal["restart", "skip", "stop"]
ON_ERROR: tuple[str, ...] = get_args(OnError)
NODE_KEYS = {
    "stages": ("use", "config", "inputs", "needs", "on_error", "thread", "process", "yields"),
    "links": ("use", "config", "inputs", "needs"),
}
_NAME = re.compile(r"[a-z][a-z0-9_]*\Z")
NEEDED = r"^\$[^\s$]+$"  # a reference, without what would hold where nothing stands


@dataclass(frozen=True, slots=True)
class NodeSpec:
    """One stage or link as declared: its class and checked settings."""

    name: str
    kind: str  # "stages" or "links"
    use: str  # import path as declared
    cls: type[Node[Any]]
    config: dict[str, Any]
    on_error: OnError = "restart"  # of a stage that raises in a live run
    thread: str = ""  # of a stage in a live run; stages of one name share it
    process: str = ""  # of a stage, not the run's own; stages of one name share it
    yields: bool = False  # of a stage in a live run, to others that do not keep up

    def build(self) -> Node[Any]:
        """A fresh instance with empty memory."""
        return self.cls(self.cls.settings_type.model_validate(self.config))


def read_nodes(tree: Tree, kind: str, left: dict[str, str]) -> Iterator[NodeSpec]:
    """Every node of a kind ("stages", "links") that has a class; a setting that is wrong is a problem in `tree`.

    A node whose `needs:` the configuration does not have is noted in `left`, with what it needs, and left out.
    """
    for name, declared in _declared(tree, kind):
        path = (kind, name)
        _check_keys(tree, path, declared)
        on_error, yields = _on_error(tree, path, declared), _yields(tree, path, declared)
        thread, process = _thread(tree, path, declared), _process(tree, path, declared)
        cls = named_class(tree, kind, path, declared.get("use"))
        if unmet := _unmet(tree, path, declared):
            left[name] = unmet
        elif cls is not None:
            before = len(tree.problems)
            config = resolve(tree, (*path, "config"), declared.get("config") or {})
            if len(tree.problems) == before:  # a reference to nothing is said already
                config = _settings(tree, path, cls, config)
            yield NodeSpec(name, kind, declared["use"], cls, config, on_error, thread, process, yields)


def _declared(tree: Tree, kind: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Name and mapping of each entry of a section that is well formed; what is not is a problem in `tree`."""
    section = tree.values.get(kind)
    if section is None:
        return
    if not isinstance(section, dict):
        tree.problem((kind,), "must be a mapping of names.")
        return
    for name, declared in cast("dict[str, Any]", section).items():
        path = (kind, name)
        if not _NAME.match(name):
            tree.problem(path, f"'{name}' is no name: use small letters, digits and '_', starting with a letter.")
        elif kind == "links" and name in (tree.values.get("stages") or {}):
            tree.problem(path, f"a stage is called '{name}' already; an edge could not tell them apart.")
        elif not isinstance(declared, dict):
            tree.problem(path, "must be a mapping with 'use:', and 'config:' and 'inputs:' where needed.")
        else:
            yield name, cast("dict[str, Any]", declared)


def _unmet(tree: Tree, path: Path_, declared: dict[str, Any]) -> str:
    """What a node `needs:` that the configuration does not have; empty where it needs nothing, or has it."""
    needs: Any = declared.get("needs")
    if needs is None:
        return ""
    if not (isinstance(needs, str) and re.fullmatch(NEEDED, needs)):
        tree.problem((*path, "needs"), f"must name a value of the configuration, as $rig.cameras, got {needs!r}.")
        return ""
    return needs if resolve(tree, (*path, "needs"), f"{needs} or null") is None else ""


def _check_keys(tree: Tree, path: Path_, declared: dict[str, Any]) -> None:
    known = NODE_KEYS[path[0]]
    for key in declared:
        if key not in known:
            tree.problem((*path, key), f"unknown key '{key}'; there is {one_of(known)}.{did_you_mean(key, known)}")


def _on_error(tree: Tree, path: Path_, declared: dict[str, Any]) -> OnError:
    on_error: Any = declared.get("on_error", "restart")
    if on_error not in ON_ERROR:
        near = did_you_mean(on_error, ON_ERROR) if isinstance(on_error, str) else ""
        tree.problem((*path, "on_error"), f"must be {one_of(ON_ERROR)}, got {on_error!r}.{near}")
    return cast(OnError, on_error)


def _thread(tree: Tree, path: Path_, declared: dict[str, Any]) -> str:
    thread: Any = declared.get("thread", path[1])
    if not (isinstance(thread, str) and _NAME.match(thread)):
        tree.problem((*path, "thread"), f"must be a name as stages have, got {thread!r}.")
    return str(thread)


def _process(tree: Tree, path: Path_, declared: dict[str, Any]) -> str:
    process: Any = declared.get("process", "")
    if not (isinstance(process, str) and (process == "" or _NAME.match(process))):
        tree.problem((*path, "process"), f"must be a name as stages have, got {process!r}.")
    elif process and "thread" in declared:
        tree.problem((*path, "process"), "in a process each stage has a thread of its own: leave 'thread' out.")
    return str(process)


def _yields(tree: Tree, path: Path_, declared: dict[str, Any]) -> bool:
    yields: Any = declared.get("yields", False)
    if not isinstance(yields, bool):
        tree.problem((*path, "yields"), f"must be true or false, got {yields!r}.")
    return yields is True


def _settings(tree: Tree, path: Path_, cls: type[Node], config: Any) -> dict[str, Any]:
    here = (*path, "config")
    if not isinstance(config, dict):
        tree.problem(here, "must be a mapping of settings.")
        return {}
    settings = cast("dict[str, Any]", config)
    try:
        cls.settings_type.model_validate(settings)
    except ValidationError as errors:
        for error in errors.errors(include_url=False):
            where = (*here, *(str(part) for part in error["loc"]))
            known = cls.settings_type.model_fields if len(error["loc"]) == 1 else ()
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
