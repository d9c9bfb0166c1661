"""JSON Schema of the YAML files, for editors: completes and checks `use`, settings and ports as one types.

A file names it in its first line: `# yaml-language-server: $schema=grd.schema.json`. Editors see one file at a time,
so nothing is required that an include may hold; `grd check` is the judge.

Source: ours; JSON Schema draft 2020-12.
"""

from __future__ import annotations

import importlib
from typing import Any

from flow.classes import HOMES, KINDS, known_classes
from flow.edge import MAX_DEADLINE_MS, MAX_DEPTH, POLICIES
from flow.graph import TOP_LEVEL
from flow.node_spec import NEEDED, ON_ERROR
from flow.stage import Node, input_ports, output_ports

_REFERENCE = {
    "type": "string",
    "pattern": r"^\$",
    "description": "the value that stands there in the merged configuration",
}
_OUTPUT = {"type": "string", "pattern": r"^[a-z][a-z0-9_]*\.[a-z][a-z0-9_]*$", "description": "node.output"}
_WAITING = {
    "type": "object",
    "description": "an edge, and how messages wait on it in a live run",
    "additionalProperties": False,
    "properties": {
        "from": _OUTPUT,
        "policy": {"enum": list(POLICIES), "description": "what becomes of messages when the stage does not keep up"},
        "depth": {"type": "integer", "minimum": 1, "maximum": MAX_DEPTH, "description": "messages that wait at most"},
        "deadline_ms": {"type": "number", "exclusiveMinimum": 0, "maximum": MAX_DEADLINE_MS},
    },
}
_ANY_EDGE = {"anyOf": [_OUTPUT, _WAITING, {"type": "null", "description": "unwired, where an included file wires it"}]}
_EDGE = {"$ref": "#/$defs/edge"}
_THREAD = {"type": "string", "description": "live: stages of one name share a thread; else each has its own"}
_PROCESS = {"type": "string", "description": "it works in a process of this name, with others that say so"}
_YIELDS = {"type": "boolean", "description": "live: fewer pictures are taken while others' queues run over"}
_ON_ERROR = {"enum": list(ON_ERROR), "description": "live, when it raises: a fresh one, skip the message, or stop"}
_NEEDS = {
    "type": "string",
    "pattern": NEEDED,
    "description": "left out, and said so, where nothing stands there, as $rig.cameras",
}
_OF_STAGES = {"on_error": _ON_ERROR, "thread": _THREAD, "process": _PROCESS, "yields": _YIELDS}


def schema() -> dict[str, Any]:
    """The schema of a configuration file with all stages and links that the home packages hold."""
    definitions: dict[str, Any] = {"edge": _ANY_EDGE}
    sections = {kind: _section(kind, definitions) for kind in HOMES}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "grd configuration",
        "type": "object",
        "additionalProperties": False,
        "properties": {
            TOP_LEVEL[0]: {
                "description": "file or files below this one",
                "anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}}],
            },
            TOP_LEVEL[1]: {"description": "the recording to run on, as seen from this file", "type": "string"},
            TOP_LEVEL[2]: {"description": "values that settings refer to as $rig.name", "type": "object"},
            **sections,
        },
        "$defs": definitions,
    }


def _section(kind: str, definitions: dict[str, Any]) -> dict[str, Any]:
    classes: dict[str, type[Node]] = {}
    for use in known_classes(kind):
        module, _, name = use.rpartition(".")
        cls = getattr(importlib.import_module(module), name, None)
        if isinstance(cls, type) and issubclass(cls, KINDS[kind]):
            classes[use] = cls
    node: dict[str, Any] = {
        "type": ["object", "null"],
        "additionalProperties": False,
        "properties": {
            "use": {"type": "string", "examples": list(classes), "description": "module.Class"},
            "config": {"type": "object"},
            "inputs": {"type": "object", "additionalProperties": _EDGE},
            "needs": _NEEDS,
            **(_OF_STAGES if kind == "stages" else {}),
        },
        "allOf": [
            {"if": {"properties": {"use": {"const": use}}, "required": ["use"]}, "then": {"$ref": f"#/$defs/{use}"}}
            for use in classes
        ],
    }
    for use, cls in classes.items():
        definitions[use] = _node(cls, definitions)
    return {"type": "object", "propertyNames": {"pattern": "^[a-z][a-z0-9_]*$"}, "additionalProperties": node}


def _node(cls: type[Node], definitions: dict[str, Any]) -> dict[str, Any]:
    settings = cls.settings_type.model_json_schema(ref_template="#/$defs/{model}")
    definitions.update({name: _settings(part) for name, part in settings.pop("$defs", {}).items()})
    inputs = {port: {**_EDGE, "description": f"takes {message.__name__}"} for port, message in input_ports(cls).items()}
    gives = ", ".join(output_ports(cls)) or "nothing"
    return {
        "description": f"{(cls.__doc__ or '').strip().splitlines()[0]} Gives {gives}.",
        "properties": {
            "config": _settings(settings),
            "inputs": {"type": "object", "additionalProperties": False, "properties": inputs},
        },
    }


def _settings(model: dict[str, Any]) -> dict[str, Any]:
    """A pydantic model's schema where each value may also be a `$reference`, and nothing is required (see above)."""
    if model.get("type") != "object":
        return model
    properties = {name: {"anyOf": [_REFERENCE, part]} for name, part in model.get("properties", {}).items()}
    return {**{k: v for k, v in model.items() if k not in ("required", "title")}, "properties": properties}
