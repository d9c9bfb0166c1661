"""JSON Schema of the configuration files: an editor completes and checks `use`, settings and ports with it.

A file names it in its first line: `# yaml-language-server: $schema=grd.schema.json`. An editor reads one file at a
time, so the schema requires nothing that an included file may have; `grd check` checks the whole.

Source: ours; JSON Schema draft 2020-12.
"""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel

from flow.config.classes import KINDS, known_classes
from flow.config.edge import MAX_DEADLINE_MS, MAX_DEPTH, POLICIES
from flow.config.node_spec import NEEDED
from flow.graph import TOP_LEVEL
from flow.stage import Node, input_ports, output_ports

_REFERENCE = {
    "type": "string",
    "pattern": r"^\$",
    "description": "a reference: the value at this path of the merged configuration",
}
_OUTPUT = {"type": "string", "pattern": r"^[a-z][a-z0-9_]*\.[a-z][a-z0-9_]*$", "description": "node.output"}
_QUEUE = {
    "type": "object",
    "description": "an edge, and its queue in a live run",
    "additionalProperties": False,
    "properties": {
        "from": _OUTPUT,
        "policy": {"enum": list(POLICIES), "description": "what is dropped when the consumer does not keep up"},
        "depth": {"type": "integer", "minimum": 1, "maximum": MAX_DEPTH, "description": "maximum queue length"},
        "deadline_ms": {"type": "number", "exclusiveMinimum": 0, "maximum": MAX_DEADLINE_MS},
    },
}
_ANY_EDGE = {"anyOf": [_OUTPUT, _QUEUE, {"type": "null", "description": "unwired, where an included file wires it"}]}
_COPY = {
    "description": "some stages and links of a file, each name with the suffix",
    "type": "object",
    "additionalProperties": False,
    "required": ["file", "nodes", "suffix"],
    "properties": {
        "file": {"type": "string"},
        "nodes": {"type": "array", "items": {"type": "string"}},
        "suffix": {"type": "string", "minLength": 1},
    },
}
_INCLUDES = [{"type": "string"}, _COPY]
_EDGE = {"$ref": "#/$defs/edge"}
_THREAD = {
    "type": ["string", "null"],
    "description": "live: stages and sources that name one thread share it; null (default): a thread for each",
}
_PROCESS = {
    "type": ["string", "null"],
    "description": "worker process; stages that name one process share it; null (default): the run's own process",
}
_LOW_PRIORITY = {"type": "boolean", "description": "live: it takes fewer images while other queues overflow"}
_NEEDS = {
    "type": "string",
    "pattern": NEEDED,
    "description": "the node is left out where the configuration has no such value, as in $rig.cameras",
}
_OF_STAGES = {"process": _PROCESS, "low_priority": _LOW_PRIORITY}


def schema(rig: type[BaseModel]) -> dict[str, Any]:
    """The schema of a configuration file with all classes of `known_classes` in flow/config/classes.py.

    `rig`: the model of the `rig` section.
    """
    definitions: dict[str, Any] = {"edge": _ANY_EDGE}
    rig_section = {**_model(rig, definitions), "description": "values that settings refer to as $rig.name"}
    sections = {kind: _section(kind, definitions) for kind in KINDS}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "grd configuration",
        "type": "object",
        "additionalProperties": False,
        "properties": {
            TOP_LEVEL[0]: {
                "description": "file or files that this one is merged over",
                "anyOf": [*_INCLUDES, {"type": "array", "items": {"anyOf": _INCLUDES}}],
            },
            TOP_LEVEL[1]: {"description": "the recording to replay, relative to this file", "type": "string"},
            TOP_LEVEL[2]: rig_section,
            **sections,
        },
        "$defs": definitions,
    }


def _section(kind: str, definitions: dict[str, Any]) -> dict[str, Any]:
    classes = known_classes(kind)
    node: dict[str, Any] = {
        "type": ["object", "null"],
        "additionalProperties": False,
        "properties": {
            "use": {"type": "string", "examples": list(classes), "description": "module.Class"},
            "config": {"type": "object"},
            "inputs": {"type": "object", "additionalProperties": _EDGE},
            "needs": _NEEDS,
            "thread": _THREAD,
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
    settings = _model(cls.settings_type, definitions)
    inputs = {port: {**_EDGE, "description": f"takes {message.__name__}"} for port, message in input_ports(cls).items()}
    gives = ", ".join(output_ports(cls)) or "nothing"
    return {
        "description": f"{(cls.__doc__ or '').strip().splitlines()[0]} Gives {gives}.",
        "properties": {
            "config": settings,
            "inputs": {"type": "object", "additionalProperties": False, "properties": inputs},
        },
    }


def _model(model: type[BaseModel], definitions: dict[str, Any]) -> dict[str, Any]:
    """The schema of a pydantic model; those of the models in it go to `definitions`."""
    found = model.model_json_schema(ref_template="#/$defs/{model}")
    definitions.update({name: _settings(part) for name, part in found.pop("$defs", {}).items()})
    return _settings(found)


def _settings(model: dict[str, Any]) -> dict[str, Any]:
    """A pydantic model's schema where each value may also be a `$reference`, and nothing is required (see above)."""
    if model.get("type") != "object":
        return model
    properties = {name: {"anyOf": [_REFERENCE, part]} for name, part in model.get("properties", {}).items()}
    return {**{k: v for k, v in model.items() if k not in ("required", "title")}, "properties": properties}
