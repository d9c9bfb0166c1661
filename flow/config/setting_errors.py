"""Values of a configuration checked by a pydantic model: one error for each wrong value, at the line that has it.

Source: ours; types of errors: https://docs.pydantic.dev/latest/errors/validation_errors/.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, cast, get_args

from pydantic import BaseModel, ValidationError

from flow.config.tree import KeyPath, Tree
from flow.config_error import did_you_mean, one_of

_TEXTS = {
    "model_type": "must be a mapping of settings",
    "model_attributes_type": "must be a mapping of settings",
    "dict_type": "must be a mapping",
    "tuple_type": "must be a list",
    "list_type": "must be a list",
}


def check_values(tree: Tree, path: KeyPath, model: type[BaseModel], values: Any, owner: str) -> None:
    """Check the values at `path` by a model; errors go to `tree`. `owner`: what has these settings, for their texts."""
    if not isinstance(values, dict):
        tree.error(path, "must be a mapping of settings.")
        return
    try:
        model.model_validate(values)
    except ValidationError as errors:
        alternatives: dict[KeyPath, list[Any]] = {}  # several for one value: it fits no member of a union
        for error in errors.errors(include_url=False):
            alternatives.setdefault(_path_of(error, cast("dict[str, Any]", values)), []).append(error)
        for inner, found in alternatives.items():
            where = (*path, *inner)
            of_mapping = found[0]["type"] == "value_error" and isinstance(found[0]["input"], dict)
            location = tree.last_location(where) if of_mapping else None
            tree.error(where, _text(found, inner, model, owner), location)


def _path_of(error: Any, values: dict[str, Any]) -> KeyPath:
    """Path of the value that an error is about: pydantic's, without the tags of unions."""
    here: Any = values
    path: list[str] = []
    for part in error["loc"]:
        if isinstance(here, dict) and part in here:
            here = cast("dict[str, Any]", here)[part]
        elif isinstance(here, list) and isinstance(part, int):
            here = cast("list[Any]", here)[part]
        elif error["type"] != "missing" or part != error["loc"][-1]:
            continue
        path.append(str(part))
    return tuple(path)


def _text(errors: list[Any], path: KeyPath, model: type[BaseModel], owner: str) -> str:
    """The text of the errors of one value."""
    error = errors[0]
    if error["type"] == "extra_forbidden":
        name, known = path[-1], _fields(model, path)
        has = f" {'.'.join((owner, *path[:-1]))} has {one_of(known)}."
        return f"unknown setting '{name}'.{did_you_mean(name, known) or has}"
    if error["type"] == "missing":
        return "is missing and has no default."
    text = " or ".join(dict.fromkeys(_requirement(error) for error in errors))
    value = error["input"]
    is_shown = isinstance(value, dict) or (isinstance(value, str) and repr(value) in text)
    return f"{text}." if is_shown else f"{text}, got {value!r}."


def _requirement(error: Any) -> str:
    """What a value must be, without a full stop."""
    if error["type"] in _TEXTS:
        return _TEXTS[error["type"]]
    if error["type"] == "union_tag_invalid":
        expected = " or ".join(error["ctx"]["expected_tags"].rsplit(", ", 1))
        return f"{error['ctx']['discriminator']} must be {expected}, not {error['ctx']['tag']!r}"
    text = str(error["msg"]).removeprefix("Value error, ").removesuffix(".")
    if error["type"] == "value_error":
        return text
    return re.sub(r"^Input is ", "is ", re.sub(r"^\w+ should ", "must ", text))


def _fields(model: type[BaseModel], path: KeyPath) -> list[str]:
    """Names that the mapping which contains the value at `path` may have."""
    models = [model]
    for part in path[:-1]:
        fields = [m.model_fields[part].annotation for m in models if part in m.model_fields]
        models = list(_models_in(fields)) or models  # the index of a list, or the tag of a union
    return [name for model in models for name in model.model_fields]


def _models_in(annotations: Iterable[Any]) -> Iterable[type[BaseModel]]:
    for annotation in annotations:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            yield annotation
        yield from _models_in(get_args(annotation))
