"""What a configuration declares of each stage and link: class, settings, thread and process; errors go to the tree.

Source: ours.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

from flow.config.classes import named_class
from flow.config.setting_errors import check_values
from flow.config.tree import KeyPath, Tree, resolve
from flow.config_error import did_you_mean, one_of
from flow.stage import Node

NODE_KEYS = {
    "stages": ("use", "config", "inputs", "needs", "thread", "process", "low_priority"),
    "links": ("use", "config", "inputs", "needs", "thread"),
}
_NAME = re.compile(r"[a-z][a-z0-9_]*\Z")
_OF_RIG = re.compile(r"\$rig\b")
NEEDED = r"^\$[^\s$]+$"  # a reference without a default


@dataclass(frozen=True, slots=True)
class NodeSpec:
    """One stage or link as declared: its class and checked settings."""

    name: str
    kind: str  # "stages" or "links"
    use: str  # import path as declared
    cls: type[Node[Any]]
    config: dict[str, Any]
    thread: str = ""  # in a live run; stages and sources of one name share it; empty: a link's own
    process: str = ""  # of a stage, the worker process; stages of one name share it; empty: the run's own process
    low_priority: bool = False  # of a stage in a live run: it takes fewer images while others do not keep up

    def build(self) -> Node[Any]:
        """A new instance, without state of any other."""
        return self.cls(self.cls.settings_type.model_validate(self.config))


def read_nodes(tree: Tree, kind: str, left_out: dict[str, str]) -> Iterator[NodeSpec]:
    """Every node of a kind ("stages", "links") that has a class; a wrong setting is an error in `tree`.

    A node is left out when the configuration does not have what its `needs:` names; `left_out` receives both.
    """
    for name, declared in _declared(tree, kind):
        path = (kind, name)
        _check_keys(tree, path, declared)
        low_priority = _low_priority(tree, path, declared)
        thread, process = _thread(tree, path, declared), _process(tree, path, declared)
        cls = named_class(tree, kind, path, declared.get("use"))
        if unmet := _unmet(tree, path, declared):
            left_out[name] = unmet
        elif cls is not None:
            config = _config(tree, (*path, "config"), cls, declared.get("config") or {})
            yield NodeSpec(name, kind, declared["use"], cls, config, thread, process, low_priority)


def _declared(tree: Tree, kind: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Name and mapping of each well-formed entry of a section; another one is an error in `tree`."""
    section = tree.values.get(kind)
    if section is None:
        return
    if not isinstance(section, dict):
        tree.error((kind,), "must be a mapping of names.")
        return
    for name, declared in cast("dict[str, Any]", section).items():
        path = (kind, name)
        if not _NAME.match(name):
            tree.error(path, f"'{name}' is no name: use small letters, digits and '_', starting with a letter.")
        elif kind == "links" and name in (tree.values.get("stages") or {}):
            tree.error(path, f"a stage has the name '{name}' already; an edge could not distinguish them.")
        elif not isinstance(declared, dict):
            tree.error(path, "must be a mapping with 'use:', and 'config:' and 'inputs:' where needed.")
        else:
            yield name, cast("dict[str, Any]", declared)


def _config(tree: Tree, path: KeyPath, cls: type[Node[Any]], declared: Any) -> dict[str, Any]:
    """The settings of a node, checked; as declared where they take a value of a rig that has errors."""
    config = declared
    if not (rig_failed(tree) and _takes_rig(declared)):
        before = len(tree.errors)
        config = resolve(tree, path, declared)
        if len(tree.errors) == before:  # a reference to nothing is an error already
            check_values(tree, path, cls.settings_type, config, cls.__name__)
    return cast("dict[str, Any]", config) if isinstance(config, dict) else {}


def _takes_rig(declared: Any) -> bool:
    """Whether settings refer to the rig."""
    if isinstance(declared, dict):
        return any(map(_takes_rig, cast("dict[str, Any]", declared).values()))
    if isinstance(declared, list):
        return any(map(_takes_rig, cast("list[Any]", declared)))
    return isinstance(declared, str) and bool(_OF_RIG.match(declared))


def rig_failed(tree: Tree) -> bool:
    """Whether the `rig` section has errors: then those of what takes its values are consequences."""
    return any(error.path.partition(".")[0] == "rig" for error in tree.errors)


def _unmet(tree: Tree, path: KeyPath, declared: dict[str, Any]) -> str:
    """What a node `needs:` and the configuration does not have; empty when it needs nothing, or has it."""
    needs: Any = declared.get("needs")
    if needs is None:
        return ""
    if not (isinstance(needs, str) and re.fullmatch(NEEDED, needs)):
        tree.error((*path, "needs"), f"must name a value of the configuration, as $rig.cameras, got {needs!r}.")
        return ""
    if rig_failed(tree) and _takes_rig(needs):
        return ""
    return needs if resolve(tree, (*path, "needs"), f"{needs} or null") is None else ""


def _check_keys(tree: Tree, path: KeyPath, declared: dict[str, Any]) -> None:
    known = NODE_KEYS[path[0]]
    for key in declared:
        if key not in known:
            tree.error((*path, key), f"unknown key '{key}'; there is {one_of(known)}.{did_you_mean(key, known)}")


def _thread(tree: Tree, path: KeyPath, declared: dict[str, Any]) -> str:
    thread: Any = declared.get("thread")
    if thread is None:
        return path[1] if path[0] == "stages" else ""
    if not (isinstance(thread, str) and _NAME.match(thread)):
        tree.error((*path, "thread"), f"must be a name as stages have, got {thread!r}.")
    return str(thread)


def _process(tree: Tree, path: KeyPath, declared: dict[str, Any]) -> str:
    process: Any = declared.get("process")
    if process is None:
        return ""
    if not (isinstance(process, str) and _NAME.match(process)):
        tree.error((*path, "process"), f"must be a name as stages have, got {process!r}.")
    elif declared.get("thread") is not None:
        text = "in a worker process each stage has its own thread: leave 'thread' out, or write 'thread: null'."
        tree.error((*path, "process"), text)
    return str(process)


def _low_priority(tree: Tree, path: KeyPath, declared: dict[str, Any]) -> bool:
    low_priority: Any = declared.get("low_priority", False)
    if not isinstance(low_priority, bool):
        tree.error((*path, "low_priority"), f"must be true or false, got {low_priority!r}.")
    return low_priority is True
