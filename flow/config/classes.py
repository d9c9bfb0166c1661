"""The classes that a configuration may name, by kind: stages and links.

A module is imported only when its source is known to define the class: importing one executes it.

Source: ours.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import pkgutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, cast

from flow.config.tree import KeyPath, Tree
from flow.config_error import did_you_mean, one_of
from flow.link import Link, Tap
from flow.stage import Node, PortError, Stage, input_ports, output_ports

KINDS: dict[str, type[Node[Any]]] = {"stages": Stage, "links": Link}
EXTRAS = {"sklearn": "baseline", "stonesoup": "baseline"}  # libraries that a class imports, by extra of pyproject.toml
PACKAGES = {"stages": "stages", "links": "links"}  # packages whose classes are suggested, by kind


def named_class(tree: Tree, kind: str, path: KeyPath, use: Any) -> type[Node[Any]] | None:
    """The class that `use:` of the node at `path` names; None, and an error in `tree`, when it names none."""
    here = (*path, "use")
    node_kind = kind.removesuffix("s")
    if not isinstance(use, str) or "." not in use:
        tree.error(here, f"must name a class as module.Class, got {use!r}." if use is not None else "is missing.")
        return None
    module_name, _, class_name = use.rpartition(".")
    if tree.packages is not None and use.partition(".")[0] not in tree.packages:
        allowed = one_of(f"{package}." for package in tree.packages)
        tree.error(here, f"'{use}' is not of grd ({allowed}), so it is not imported; --trust if it is your own.")
        return None
    if not all(part.isidentifier() for part in use.split(".")) or not _defines(module_name, class_name):
        tree.error(here, f"unknown {node_kind} '{use}'.{did_you_mean(use, known_classes(kind))}")
        return None
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        extra = EXTRAS.get((error.name or "").partition(".")[0])
        how = f": pip install -e '.[{extra}]'" if extra else "."
        tree.error(here, f"'{module_name}' cannot be imported: {error}{how}")
        return None
    cls: Any = getattr(module, class_name, None)
    if cls is None:
        tree.error(here, f"unknown {node_kind} '{use}'.{did_you_mean(use, known_classes(kind))}")
    elif not (isinstance(cls, type) and issubclass(cls, KINDS[kind])):
        section = next((k for k, base in KINDS.items() if isinstance(cls, type) and issubclass(cls, base)), None)
        hint = f"; it belongs under '{section}:'" if section else ""
        tree.error(here, f"'{use}' is no {node_kind}{hint}.")
    else:
        node = cast("type[Node[Any]]", cls)
        try:
            input_ports(node)
            output_ports(node)
        except PortError as error:
            tree.error(here, f"'{use}' is not written as a {node_kind} must be: {error}.")
        else:
            return node
    return None


def _defines(module_name: str, name: str) -> bool:
    """Whether a module binds a name at its top level, by its source, without importing it or its packages."""
    if module_name in sys.modules:
        return hasattr(sys.modules[module_name], name)
    source = _source(module_name)
    if source is None:
        return False
    try:
        body = ast.parse(source.read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return False
    return any(name in names or "*" in names for names in map(_bound, body))


def _source(module_name: str) -> Path | None:
    """The source file of a module. `importlib.util.find_spec` would import the packages around it."""
    top, *inner = module_name.split(".")
    try:
        spec = importlib.util.find_spec(top)
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    if not inner:
        return Path(spec.origin) if spec.origin is not None and spec.origin.endswith(".py") else None
    for folder in spec.submodule_search_locations or ():
        path = Path(folder, *inner)
        for file in (path / "__init__.py", path.with_suffix(".py")):
            if file.is_file():
                return file
    return None


def _bound(statement: ast.stmt) -> list[str]:
    """Names that a statement of a module binds; `*`: not known."""
    if isinstance(statement, ast.ClassDef):
        return [statement.name]
    if isinstance(statement, ast.Import | ast.ImportFrom):
        return [alias.asname or alias.name for alias in statement.names]
    if isinstance(statement, ast.Assign):
        return [target.id for target in statement.targets if isinstance(target, ast.Name)]
    return ["*"] if isinstance(statement, ast.If | ast.Try) else []


def known_classes(kind: str) -> dict[str, type[Node[Any]]]:
    """Usable classes of a kind by import path, in alphabetical order: for suggestions and the schema.

    A package within PACKAGES offers its own classes that `__all__` names, or without that those that its `__init__`
    imports or defines; `stages/x.py` offers the classes that it defines. What cannot be imported (a driver without its
    library) is left out.
    """
    found: dict[type[Node[Any]], str] = {}
    for module in _public_modules(PACKAGES[kind]):
        names: list[str] = getattr(module, "__all__", None) or [name for name in vars(module) if name[0] != "_"]
        for name in names:
            value: Any = getattr(module, name, None)
            if isinstance(value, type) and issubclass(value, KINDS[kind]):
                cls = cast("type[Node[Any]]", value)
                if f"{cls.__module__}.".startswith(f"{module.__name__}.") and _is_usable(cls):
                    found.setdefault(cls, f"{module.__name__}.{name}")
    return {path: cls for cls, path in sorted(found.items(), key=lambda item: item[1])}


def _public_modules(package: str) -> Iterator[ModuleType]:
    """A package's modules from which configurations may take classes: the packages within, and stages/x.py."""
    parent = _imported(package)
    for info in pkgutil.iter_modules(parent.__path__, f"{package}.") if parent else ():
        if not info.ispkg and package != "stages":
            continue
        module = _imported(info.name)
        if module is not None:
            yield module
        if info.ispkg:
            yield from _public_modules(info.name)


def _imported(name: str) -> ModuleType | None:
    try:
        return importlib.import_module(name)
    except Exception:  # noqa: BLE001 - whatever a driver's library raises
        return None


def _is_usable(cls: type[Node[Any]]) -> bool:
    """Whether a node of this class does anything as it is: a base class of others has no ports."""
    try:
        return bool(issubclass(cls, Tap) or input_ports(cls) or output_ports(cls))
    except PortError:
        return False
