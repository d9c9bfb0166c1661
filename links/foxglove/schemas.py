"""JSON schemas of the Foxglove messages that an export writes.

Foxglove recognises a message by its schema's name; the fields are those of its documentation, all required.

Source: https://docs.foxglove.dev/docs/sdk/schemas
"""

from __future__ import annotations

import json
from typing import Any

FLOAT32, UINT16, UINT32 = 7, 3, 5  # foxglove.NumericType
INFO, WARNING = 2, 3  # foxglove.LogLevel


def _object(title: str, **properties: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties, "required": [*properties]}


_NUMBER, _TEXT, _COUNT = {"type": "number"}, {"type": "string"}, {"type": "integer", "minimum": 0}
_BYTES = {"type": "string", "contentEncoding": "base64"}
_TIME = {
    "type": "object",
    "title": "time",
    "properties": {"sec": _COUNT, "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999}},
}
_VECTOR = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_POINT = _object("foxglove.Point3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _object("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION)
_FIELD = _object("foxglove.PackedElementField", name=_TEXT, offset=_COUNT, type=_COUNT)

SCHEMAS: dict[str, dict[str, Any]] = {
    schema["title"]: schema
    for schema in (
        _object("foxglove.PoseInFrame", timestamp=_TIME, frame_id=_TEXT, pose=_POSE),
        _object("foxglove.Point3InFrame", timestamp=_TIME, frame_id=_TEXT, point=_POINT),
        _object(
            "foxglove.FrameTransform",
            timestamp=_TIME,
            parent_frame_id=_TEXT,
            child_frame_id=_TEXT,
            translation=_VECTOR,
            rotation=_QUATERNION,
        ),
        _object(
            "foxglove.PointCloud",
            timestamp=_TIME,
            frame_id=_TEXT,
            pose=_POSE,
            point_stride=_COUNT,
            fields={"type": "array", "items": _FIELD},
            data=_BYTES,
        ),
        _object("foxglove.CompressedImage", timestamp=_TIME, frame_id=_TEXT, data=_BYTES, format=_TEXT),
        _object("foxglove.Log", timestamp=_TIME, level=_COUNT, message=_TEXT, name=_TEXT, file=_TEXT, line=_COUNT),
    )
}


def schema_text(name: str) -> bytes:
    """A schema as MCAP stores it."""
    return json.dumps(SCHEMAS[name], separators=(",", ":")).encode()
