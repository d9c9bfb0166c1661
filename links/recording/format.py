"""The recording format: an MCAP file with profile "grd"; recordings/README.md documents it.

    header             profile "grd"
    metadata "grd"     format_version; then metadata "recording": the metadata passed to the writer
    attachments        rig.yaml, config.yaml (both at the start, so that a killed recording keeps them)
    chunks             camera topics uncompressed (JPEG does not shrink), all others zstd
    metadata "losses"  only when records were dropped
    summary            indexes and counts; an unfinished recording has none

A message's log_time is the arrival on the host, its publish_time the measurement; sequence is one global counter.

Source: MCAP specification 0 (https://mcap.dev/spec); the topics are ours.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from links.recording.compressed_image import COMPRESSED_IMAGE_SCHEMA

PROFILE = "grd"
FORMAT_VERSION = (1, 1)  # a reader refuses a newer major; a minor only adds topics or metadata
METADATA_FORMAT = "grd"
METADATA_USER = "recording"
METADATA_LOSSES = "losses"
TRUTH_POSES = ("/truth/vehicle", "/truth/drone")
RIG_ATTACHMENT = "rig.yaml"
CONFIG_ATTACHMENT = "config.yaml"

MAX_MESSAGE_BYTES = 32 * 2**20  # of one record
MAX_CHUNK_BYTES = 64 * 2**20  # uncompressed; a file that claims more is damaged
MAX_TIME_NS = 2**63 - 1

Progress = Callable[[int, int], None]
"""Called with (bytes done, bytes in all), often enough for a progress bar."""


@dataclass(frozen=True, slots=True)
class Topic:
    """Contents of a topic and its MCAP declaration."""

    name: str
    holds: str
    encoding: str  # MCAP message encoding
    schema_name: str = ""  # empty: no schema, raw bytes
    schema_encoding: str = ""
    schema: bytes = b""
    compress: bool = True


_XYZ = {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3, "description": "[m]"}
_QUATERNION = {"type": "array", "items": {"type": "number"}, "minItems": 4, "maxItems": 4}
_COVARIANCE = {
    "type": "array",
    "items": {"type": "number"},
    "minItems": 36,
    "maxItems": 36,
    "description": "6x6 by rows: rotation [rad], then translation [m], tangent at the body",
}
_POSE = {"xyz_m": _XYZ, "quaternion_xyzw": _QUATERNION}


def _raw(name: str, encoding: str, holds: str) -> Topic:
    return Topic(name=name, holds=holds, encoding=encoding)


def _json(name: str, schema_name: str, fields: dict[str, Any], holds: str, optional: bool = False) -> Topic:
    """A topic of JSON objects. `optional`: an object has some of the fields only."""
    schema = {"title": schema_name, "type": "object", "properties": fields, "required": [] if optional else [*fields]}
    text = json.dumps(schema, separators=(",", ":")).encode()
    return Topic(name, holds, "json", schema_name, "jsonschema", text)


def _jpeg(name: str, holds: str) -> Topic:
    return Topic(
        name, holds, "protobuf", "foxglove.CompressedImage", "protobuf", COMPRESSED_IMAGE_SCHEMA, compress=False
    )


_NUMBER, _NUMBER_OR_NULL = {"type": "number"}, {"type": ["number", "null"]}
_GNSS = {
    "type": "object",
    "properties": {
        "latitude_deg": _NUMBER,
        "longitude_deg": _NUMBER,
        "altitude_m": {"type": "number", "description": "above mean sea level"},
        "sigma_m": _NUMBER,
        "sigma_up_m": _NUMBER,
        "heading_deg": {"type": "number", "description": "clockwise from true north; of the vehicle only"},
        "heading_sigma_deg": _NUMBER,
    },
    "required": ["latitude_deg", "longitude_deg", "altitude_m"],
}
_RANGE = {"type": "object", "properties": {"range_m": _NUMBER, "sigma_m": _NUMBER}, "required": ["range_m"]}
_CUES = {"vehicle_gnss": _GNSS, "drone_gnss": _GNSS, "uwb_range": _RANGE, "age_s": _NUMBER}
_HITS = {"pulse_stamp_ns": {"type": "array", "items": {"type": "integer"}}}
_FLIGHT = {
    "crashed": {"type": "boolean"},
    "failsafe_s": _NUMBER_OR_NULL,
    "lost_s": _NUMBER_OR_NULL,
    "sent_poses": {"type": "integer"},
    "wrong_poses": {"type": "integer"},
    "events": {"type": "array"},
}
_FIX = {
    "tick": {"type": "boolean"},
    "xyz_m": _XYZ,
    "velocity_mps": _XYZ | {"description": "[m/s]"},
    "sigma_m": _NUMBER,
    "bias_sigma_m": _NUMBER,
}
_ROTATION = {"R": {"type": "array", "items": {"type": "array", "items": _NUMBER}}, "sigma_rad": _NUMBER}
_NUMBERED = re.compile(r"(/\w+/\w+?)_\d+")  # of a second drone, and so on

_SERVO = {
    "position_rad": {"type": "number"},
    "velocity_radps": {"type": "number"},
    "goal_rad": {"type": "number"},
    "error": {"type": "integer", "description": "the servo's own error bits, 0 is healthy"},
}

TOPICS: dict[str, Topic] = {
    topic.name: topic
    for topic in (
        _raw("/lidar/packets", "velodyne-data", "a LiDAR's data packet: the UDP payload; channel metadata: model"),
        _raw("/lidar/position", "velodyne-position", "a Velodyne's position packet: the 512-byte UDP payload"),
        _json("/servo/state", "grd.ServoState", _SERVO, "servo reading; stamp = middle of request and reply"),
        _jpeg("/camera/vehicle", "vehicle fisheye, JPEG"),
        _jpeg("/camera/drone", "drone fisheye, JPEG"),
        _raw("/autopilot/rx", "mavlink", "one MAVLink frame from the autopilot"),
        _raw("/autopilot/tx", "mavlink", "one MAVLink frame to the autopilot"),
        _json(
            "/vehicle/odometry",
            "grd.PoseWithCovariance",
            {**_POSE, "covariance": _COVARIANCE},
            "the vehicle's own odometry, when it has one",
        ),
        _json("/cues", "grd.Cues", _CUES, "GNSS of vehicle and drone, ranges: one of them", optional=True),
        _raw("/cues/nmea", "nmea", "NMEA sentences of the vehicle's GNSS receiver"),
        _raw("/clock", "empty", "empty: a tick of the host's clock in a live run"),
        _raw("/run/order", "grd-order", "order of the inputs of each stage, live runs only: flow/live/input_order.py"),
        _json(
            "/run/end",
            "grd.RunEnd",
            {"output_hash": {"type": ["string", "null"]}},
            "the live run's hash, written at its end",
        ),
        _json("/truth/vehicle", "grd.Pose", _POSE, "T_world_vehicle; simulated only, never wired to a stage"),
        _json("/truth/drone", "grd.Pose", _POSE, "T_world_drone; simulated only, never wired to a stage"),
        _json("/truth/hits", "grd.Hits", _HITS, "pulses of one LiDAR packet that the drone returned; simulated only"),
        _json("/truth/visible", "grd.Visible", {"visible": {"type": "boolean"}}, "line of sight; simulated only"),
        _json("/truth/flight", "grd.Flight", _FLIGHT, "outcome of a flight with an autopilot in the loop"),
        _json("/simulated/fixes", "grd.SimulatedFix", _FIX, "fixes in place of the LiDAR, and ticks", optional=True),
        _json("/simulated/rotations", "grd.SimulatedRotation", _ROTATION, "rotations in place of the cameras"),
    )
}


def topic(name: str) -> Topic:
    """Declaration of a topic; a topic that is not in the table holds raw bytes.

    Those of a second drone, `/truth/drone_2` and `/autopilot/rx_2`, are declared as those of the first.
    """
    numbered = _NUMBERED.fullmatch(name)
    if numbered is not None and (first := TOPICS.get(numbered[1])) is not None:
        return dataclasses.replace(first, name=name)
    return TOPICS.get(name) or _raw(name, "application/octet-stream", "raw bytes of a topic that grd does not know")
