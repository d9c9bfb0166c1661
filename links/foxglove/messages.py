"""Messages of a ROS export as Foxglove's, in JSON.

    PoseWithCovarianceStamped   Point3InFrame; PoseInFrame only while the rotation is known: neither has a covariance
    PoseStamped                 PoseInFrame
    TFMessage                   FrameTransform, one each
    PointCloud2                 PointCloud
    CompressedImage             CompressedImage
    DiagnosticArray             Log, when the state of the pose changes

Packets, frames of the autopilot, and what is in a transform already are left out.

Source: https://docs.foxglove.dev/docs/sdk/schemas; links/ros/recording_messages.py, links/ros/run_messages.py.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

from links.foxglove.schemas import FLOAT32, INFO, UINT16, UINT32, WARNING
from links.ros.recording_messages import Entry

TYPES = {4: UINT16, 6: UINT32, 7: FLOAT32}  # of a PointField
NO_POSE = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
KNOWN_RAD2 = 1.0  # an unknown rotation has a variance of pi^2


class FoxgloveMessage(NamedTuple):
    """A message of a topic."""

    topic: str
    schema: str
    log_time_ns: int
    publish_time_ns: int
    values: dict[str, Any]


class FoxgloveMessages:
    """Converts consecutive messages of one export."""

    def __init__(self) -> None:
        self._state: str | None = None

    def of(self, entry: Entry) -> Iterator[FoxgloveMessage]:
        """The messages of a ROS message; none for a type that is left out."""
        topic, kind, time_ns, values = entry
        name = kind.rpartition("/")[2]
        if name == "TFMessage":
            for each in values["transforms"]:
                yield _message(topic, "FrameTransform", time_ns, each["header"], _transform(each))
        elif name == "PoseStamped":
            pose = {"pose": values["pose"]}
            yield _message(topic, "PoseInFrame", time_ns, values["header"], _in_frame(values, pose))
        elif name == "PoseWithCovarianceStamped":
            yield from self._pose(topic, time_ns, values)
        elif name == "PointCloud2":
            yield _message(topic, "PointCloud", time_ns, values["header"], _cloud(values))
        elif name == "CompressedImage":
            image = {"data": _base64(values["data"]), "format": values["format"]}
            yield _message(topic, "CompressedImage", time_ns, values["header"], _in_frame(values, image))
        elif name == "DiagnosticArray":
            yield from self._log(time_ns, values)

    def _pose(self, topic: str, time_ns: int, values: dict[str, Any]) -> Iterator[FoxgloveMessage]:
        pose, covariance = values["pose"]["pose"], values["pose"]["covariance"]
        point = _in_frame(values, {"point": pose["position"]})
        yield _message(f"{topic}/point", "Point3InFrame", time_ns, values["header"], point)
        if max(float(covariance[k]) for k in (21, 28, 35)) < KNOWN_RAD2:
            yield _message(topic, "PoseInFrame", time_ns, values["header"], _in_frame(values, {"pose": pose}))

    def _log(self, time_ns: int, values: dict[str, Any]) -> Iterator[FoxgloveMessage]:
        for status in values["status"]:
            if status["message"] == self._state:
                continue
            self._state = status["message"]
            log = {
                "timestamp": _time(values["header"]),
                "level": WARNING if status["level"] else INFO,
                "message": status["message"],
                "name": status["name"],
                "file": "",
                "line": 0,
            }
            yield _message("/grd/state", "Log", time_ns, values["header"], log)


def _message(topic: str, schema: str, time_ns: int, header: dict[str, Any], values: dict[str, Any]) -> FoxgloveMessage:
    time = _time(header)
    return FoxgloveMessage(topic, f"foxglove.{schema}", time_ns, time["sec"] * 1_000_000_000 + time["nsec"], values)


def _time(header: dict[str, Any]) -> dict[str, int]:
    stamp = header["stamp"]
    return {"sec": int(stamp["sec"]), "nsec": int(stamp["nanosec"])}


def _in_frame(values: dict[str, Any], what: dict[str, Any]) -> dict[str, Any]:
    return {"timestamp": _time(values["header"]), "frame_id": values["header"]["frame_id"], **what}


def _transform(values: dict[str, Any]) -> dict[str, Any]:
    return {
        "timestamp": _time(values["header"]),
        "parent_frame_id": values["header"]["frame_id"],
        "child_frame_id": values["child_frame_id"],
        "translation": values["transform"]["translation"],
        "rotation": values["transform"]["rotation"],
    }


def _cloud(values: dict[str, Any]) -> dict[str, Any]:
    fields = [{"name": f["name"], "offset": f["offset"], "type": TYPES[f["datatype"]]} for f in values["fields"]]
    cloud = {"pose": NO_POSE, "point_stride": values["point_step"], "fields": fields, "data": _base64(values["data"])}
    return _in_frame(values, cloud)


def _base64(data: Any) -> str:
    return base64.b64encode(data.tobytes()).decode()


def finite(values: Any) -> bool:
    """Whether all numbers of a message are finite: JSON has no others."""
    if isinstance(values, dict):
        return all(finite(v) for v in values.values())
    if isinstance(values, list):
        return all(finite(v) for v in values)
    return not isinstance(values, float) or math.isfinite(values)
