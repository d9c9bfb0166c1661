"""The classes that a configuration may name, by kind: stages and links.

Source: ours.
"""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
import re
from pathlib import Path
from typing import Any, cast

from flow.link import Link
from flow.problem import did_you_mean
from flow.stage import Node, PortError, Stage, input_ports, output_ports
from flow.tree import Path_, Tree

KINDS: dict[str, type[Node[Any]]] = {"stages": Stage, "links": Link}
HOMES = {"stages": "stages", "links": "links"}  # package in which classes of a kind are looked for when suggesting


def named_class(tree: Tree, kind: str, path: Path_, use: Any) -> type[Node[Any]] | None:
    """The class an import path (`use:` of the node at `path`) names, or None with the problem noted in `tree`."""
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
        node = cast("type[Node[Any]]", cls)
        try:
            input_ports(node)
            output_ports(node)
        except PortError as error:
            tree.problem(here, f"'{use}' is written wrongly: {error}.")
        else:
            return node
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
            if home.count(".") > 1 and not module.ispkg:  # a folder of a package: the package exports it
                home, door = home.rpartition(".")[0], (file.parents[1] / "__init__.py").read_text("utf-8")
            found += [f"{home}.{name}" for name in classes if re.search(rf"\b{name}\b", door)]
    return sorted(dict.fromkeys(found))
