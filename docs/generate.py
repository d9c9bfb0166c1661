"""MkDocs hook: pages that are made from the code and from documents outside docs.

`reference/settings.md` comes from `configs/grd.schema.json`, `reference/commands.md` from the commands' own help. The
operator's page, the recording format, the README of `links/zenoh`, CONTRIBUTING and the changelog are
included unchanged.
"""

from __future__ import annotations

import json
import posixpath
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
SHOWN = {
    "deploy/OPERATOR.md": "how-to/operate.md",
    "links/zenoh/README.md": "how-to/hosts.md",
    "CONTRIBUTING.md": "how-to/contribute.md",
    "recordings/README.md": "reference/recordings.md",
    "CHANGELOG.md": "changelog.md",
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    for source, page in SHOWN.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=_relinked(text, source, page)))
    files.append(File.generated(config, "reference/settings.md", content=settings_page()))
    files.append(File.generated(config, "reference/commands.md", content=commands_page()))
    return files


def _relinked(text: str, source: str, page: str) -> str:
    """A document with its relative links changed to pages of the site; links to other files become plain code."""

    def link(match: re.Match[str]) -> str:
        label, target = match.groups()
        if "://" in target or target.startswith("#"):
            return match.group(0)
        name = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if name in SHOWN:
            return f"[{label}]({posixpath.relpath(SHOWN[name], posixpath.dirname(page) or '.')})"
        return f"{label} (`{name}`)"

    return re.sub(r"(?<!!)\[([^\]]+)\]\(([^)\s]+)\)", link, text)


def settings_page() -> str:
    """Every stage and link with its settings, types, ranges, defaults and inputs."""
    schema: dict[str, Any] = json.loads((ROOT / "configs" / "grd.schema.json").read_text(encoding="utf-8"))
    lines = [
        "# Settings",
        "",
        "Generated from `configs/grd.schema.json`. YAML key: `config:` of the stage or link.",
        "",
    ]
    for name, entry in sorted(_entries(schema).items()):
        lines += [f"## `{name}`", ""]
        config = _resolved(schema, entry["properties"].get("config", {}))
        if text := config.get("description"):
            lines += [text.split("\n\n")[0].replace("\n", " "), ""]
        properties: dict[str, Any] = config.get("properties", {})
        if properties:
            lines += ["| setting | type | default |", "| --- | --- | --- |"]
            lines += [f"| `{key}` | {_type(schema, value)} | {_default(value)} |" for key, value in properties.items()]
            lines.append("")
    return "\n".join(lines)


def _entries(schema: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """`use:` path -> schema of the entry, for all stages and links."""
    found: dict[str, dict[str, Any]] = {}

    def visit(value: Any) -> None:
        if isinstance(value, dict):
            properties = value.get("properties")
            use = properties.get("use") if isinstance(properties, dict) else None
            if isinstance(use, dict) and isinstance(use.get("const"), str):
                found[use["const"]] = value
            for item in value.values():
                visit(item)
        elif isinstance(value, list):
            for item in value:
                visit(item)

    visit(schema)
    return found


def _resolved(schema: dict[str, Any], value: dict[str, Any]) -> dict[str, Any]:
    """A schema part with its first reference followed."""
    if "$ref" in value:
        part: Any = schema
        for key in value["$ref"].removeprefix("#/").split("/"):
            part = part[key]
        return {**part, **{k: v for k, v in value.items() if k != "$ref"}}
    for key in ("anyOf", "allOf", "oneOf"):
        for item in value.get(key, ()):
            if "$ref" in item or "properties" in item:
                return _resolved(schema, item)
    return value


def _type(schema: dict[str, Any], value: dict[str, Any]) -> str:
    """A setting's type and range in words."""
    options = [o for o in value.get("anyOf", [value]) if not str(o.get("description", "")).startswith("a reference")]
    return " or ".join(dict.fromkeys(_one_type(option) for option in options)) or "any"


def _one_type(option: dict[str, Any]) -> str:
    if "$ref" in option:
        return f"`{option['$ref'].rpartition('/')[2]}`"
    if "enum" in option:
        return ", ".join(f"`{item}`" for item in option["enum"])
    if "const" in option:
        return f"`{option['const']}`"
    limits = [
        f"{sign} {option[key]}"
        for key, sign in (("exclusiveMinimum", ">"), ("minimum", ">="), ("exclusiveMaximum", "<"), ("maximum", "<="))
        if key in option
    ]
    name = str(option.get("type", "any"))
    if "anyOf" in option:
        return " or ".join(dict.fromkeys(_one_type(item) for item in option["anyOf"]))
    return f"{name} ({', '.join(limits)})" if limits else name


def _default(value: dict[str, Any]) -> str:
    for option in (value, *value.get("anyOf", ())):
        if "default" in option:
            text = json.dumps(option["default"])
            return f"`{text if len(text) <= 60 else text[:57] + '...'}`"
    return "required"


def commands_page() -> str:
    """The help text of every command."""
    sys.path.insert(0, str(ROOT))
    from links.cli.app import COMMANDS, command

    lines = [
        "# Commands",
        "",
        "Exit codes: 0 success, 1 a finding, 2 wrong use. `grd COMMAND --help` prints the same.",
        "",
    ]
    for name in sorted(COMMANDS):
        shown: Any = command(name)
        help_text = re.sub(r"\n(?!\n)\s*", " ", (shown.help or "").replace("\n\n", "\0")).replace("\0", "\n\n")
        lines += [f"## `grd {name}`", "", help_text.replace("Example: ", "Example:\n\n    "), ""]
        lines += ["| parameter | meaning |", "| --- | --- |"]
        for parameter in shown.params:
            flags = ", ".join(getattr(parameter, "opts", [parameter.name]))
            meaning = (
                (getattr(parameter, "help", None) or "")
                .replace("|", "\\|")
                .replace("[default:", "(default:")
                .replace("]", ")")
            )
            if meaning or parameter.param_type_name == "argument":
                lines.append(f"| `{flags}` | {meaning} |")
        lines.append("")
    return "\n".join(lines)
