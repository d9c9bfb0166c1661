"""YAML text as plain values, within bounds: a configuration, or the attachment of a recording, may come from anybody.

Size, depth, and the number of values after aliases are expanded are bounded; so is the length of a number, because
PyYAML converts base 60 (`1:1:1:...`) in quadratic time. Keys are words, each once.

Source: ours. YAML 1.1 by PyYAML's safe loader, which constructs no objects.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import yaml

MAX_FILE_BYTES = 1_000_000
MAX_VALUES = 100_000  # after aliases are expanded
MAX_DEPTH = 40
MAX_NUMBER_CHARACTERS = 100
TEXT_TAG, MERGE_TAG = "tag:yaml.org,2002:str", "tag:yaml.org,2002:merge"

# What PyYAML's constructors raise for a tag that does not fit its text: `!!bool 7`, `!!timestamp 7`, `!!int ""`.
UNREADABLE = (yaml.YAMLError, ArithmeticError, AttributeError, LookupError, TypeError, ValueError)

KeyPath = tuple[str, ...]


class YamlTextError(ValueError):
    """The text is no YAML within the bounds; `line` from 1, 0: the whole text."""

    def __init__(self, text: str, line: int = 0) -> None:
        super().__init__(text)
        self.line = line


@dataclass(slots=True)
class YamlText:
    """The values of a text, the line of each, and errors (path, text, line) of single values."""

    values: Any = None  # None: the text is empty
    lines: dict[KeyPath, int] = field(default_factory=dict[KeyPath, int])
    errors: list[tuple[KeyPath, str, int]] = field(default_factory=list[tuple[KeyPath, str, int]])


def read_yaml(data: bytes | str) -> YamlText:
    """The values of a text with their lines. Raises YamlTextError when it is no YAML, or too large."""
    if len(data) > MAX_FILE_BYTES:
        raise YamlTextError(f"larger than {MAX_FILE_BYTES} bytes: that is no configuration.")
    try:
        text = data if isinstance(data, str) else data.decode("utf-8")
        node = cast("yaml.Node | None", yaml.compose(text, Loader=yaml.SafeLoader))  # pyright: ignore[reportUnknownMemberType]
        found = YamlText()
        if node is not None:
            found.values = _plain(node, (), found, [MAX_VALUES])
    except UnicodeDecodeError as error:
        raise YamlTextError(f"is not UTF-8 text (byte {error.start}).") from None
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 0
        raise YamlTextError(f"is not YAML: {error.problem}.", line) from None
    except (yaml.YAMLError, RecursionError) as error:
        raise YamlTextError(f"is not YAML: {str(error).splitlines()[0]}.") from None
    return found


def yaml_values(data: bytes | str) -> Any:
    """The values of a text. Raises YamlTextError, also for the first value that cannot be read."""
    found = read_yaml(data)
    for path, text, line in found.errors:
        raise YamlTextError(f"{'.'.join(path)}: {text}", line)
    return found.values


def _plain(node: yaml.Node, path: KeyPath, found: YamlText, budget: list[int]) -> Any:
    """YAML nodes to plain values; lines and errors go to `found`."""
    budget[0] -= 1
    if budget[0] < 0 or len(path) > MAX_DEPTH:
        raise YamlTextError("is too large or too deep: that is no configuration.")
    line = node.start_mark.line + 1
    found.lines.setdefault(path, line)
    if isinstance(node, yaml.SequenceNode):
        items = cast("list[yaml.Node]", node.value)
        return [_plain(item, (*path, str(i)), found, budget) for i, item in enumerate(items)]
    if isinstance(node, yaml.MappingNode):
        return _mapping(node, path, found, budget)
    try:
        return _scalar(node)
    except UNREADABLE as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        found.errors.append((path, f"has a value that cannot be read: {reason}.", line))
        return None


def _mapping(node: yaml.MappingNode, path: KeyPath, found: YamlText, budget: list[int]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key_node, value_node in cast("list[tuple[yaml.Node, yaml.Node]]", node.value):
        key = str(key_node.value) if isinstance(key_node, yaml.ScalarNode) else "?"
        line = key_node.start_mark.line + 1
        if not isinstance(key_node, yaml.ScalarNode) or key_node.tag == MERGE_TAG:
            found.errors.append((path, "a key must be a plain word.", line))
            continue
        if key in result:
            text = f"is written twice (first on line {found.lines[(*path, key)]})."
            found.errors.append(((*path, key), text, line))
            continue
        found.lines[(*path, key)] = line
        result[key] = _plain(value_node, (*path, key), found, budget)
    return result


def _scalar(node: yaml.Node) -> Any:
    if node.tag != TEXT_TAG and len(node.value) > MAX_NUMBER_CHARACTERS:
        raise ValueError(f"a number of {len(node.value)} characters")
    loader = yaml.SafeLoader("")
    try:
        return cast(Any, loader.construct_object(node, deep=True))  # pyright: ignore[reportUnknownMemberType]
    finally:
        loader.dispose()  # pyright: ignore[reportUnknownMemberType]
