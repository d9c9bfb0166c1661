"""Which topic of a ROS bag is which topic of a recording: from a file, or guessed by message types and names.

    /lidar/packets: {topic: /velodyne_packets}
    /servo/state: {topic: /joint_states, joint: turntable}
    /autopilot/rx: [{topic: /mavros/imu/data}, {topic: /mavros/global_position/raw/fix}]

Source: ours.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from flow.config.yaml_text import YamlTextError, yaml_values
from flow.link import LinkError
from links.ros.bag import BagTopic

LIDAR, SERVO, VEHICLE_CAMERA, DRONE_CAMERA = "/lidar/packets", "/servo/state", "/camera/vehicle", "/camera/drone"
ODOMETRY, AUTOPILOT = "/vehicle/odometry", "/autopilot/rx"
POINTS = "sensor_msgs/msg/PointCloud2"
OUSTER_PACKETS = ("ouster_ros/msg/PacketMsg", "ouster_msgs/msg/PacketMsg", "ouster_sensor_msgs/msg/PacketMsg")
SCANS = (
    "velodyne_msgs/msg/VelodyneScan",
    "pandar_msgs/msg/PandarScan",
    "hesai_lidar/msg/PandarScan",
    "hesai_ros_driver/msg/UdpFrame",
    "nebula_msgs/msg/NebulaPackets",
)
IMAGES = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
MAVLINK, IMU, GNSS = "mavros_msgs/msg/Mavlink", "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
POSE = "nav_msgs/msg/Odometry"
TYPES: dict[str, tuple[str, ...]] = {
    LIDAR: (*SCANS, *OUSTER_PACKETS, POINTS),
    SERVO: ("sensor_msgs/msg/JointState", "std_msgs/msg/Float64", "std_msgs/msg/Float32"),
    VEHICLE_CAMERA: IMAGES,
    DRONE_CAMERA: IMAGES,
    ODOMETRY: (POSE,),
    AUTOPILOT: (MAVLINK, IMU, GNSS, POSE),
}
"""Topics of a recording that a bag can fill, and the messages that they take, best first."""

_DRONE = re.compile(r"drone|uav|copter|quad|down|mavros", re.I)
_VEHICLE = re.compile(r"vehicle|ugv|car|rover|husky|up(?![a-z])|roof", re.I)
_SERVO = re.compile(r"servo|turntable|dynamixel|pan|joint", re.I)
_GLOBAL = re.compile(r"global_position")  # of mavros: by GNSS, not the pose that the autopilot flies with
_RECEIVER = re.compile(r"mavros/(.*/)?raw/")  # of mavros: the GNSS receiver's own position
_ESTIMATE = re.compile(r"global_position/global$")  # of mavros: the estimator's position, which may be a sent pose
_NOT_PACKETS = re.compile(r"imu", re.I)


class TopicUse(BaseModel):
    """One topic of a bag and how it is read."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    topic: str
    stamp: Literal["header", "arrival"] = "header"  # arrival: the time of recording, for headers of another clock
    joint: str | None = None  # of a JointState; None: its only joint
    unit: Literal["rad", "deg"] = "rad"  # of a Float32 or Float64
    axes: Literal["sensor", "ros"] | None = None  # of a PointCloud2; None: the habit of the model's driver


class BagMapping(BaseModel):
    """The topics of a bag by the topic of the recording that they become."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    uses: dict[str, tuple[TopicUse, ...]]

    def yaml(self) -> str:
        """As a mapping file."""
        values: dict[str, Any] = {}
        for stream, uses in self.uses.items():
            written = [use.model_dump(exclude_defaults=True) for use in uses]
            values[stream] = written if len(written) > 1 else written[0]
        return yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=120)


def read_mapping(file: Path) -> BagMapping:
    """A mapping file. Raises LinkError with the reason."""
    try:
        tree = yaml_values(file.read_bytes())
        if not isinstance(tree, dict) or not tree:
            raise LinkError(f"{file} is no mapping: it needs lines such as `{LIDAR}: {{topic: /velodyne_packets}}`")
        unknown = [str(key) for key in tree if key not in TYPES]
        if unknown:
            raise LinkError(f"{file}: a bag cannot fill {unknown[0]}: use {', '.join(TYPES)}{_near(unknown[0], TYPES)}")
        lists = {key: value if isinstance(value, list) else [value] for key, value in tree.items()}
        mapping = BagMapping.model_validate({"uses": lists})
    except YamlTextError as error:
        raise LinkError(f"{file} is no mapping: {error}") from None
    except ValidationError as errors:
        first = min(errors.errors(include_url=False), key=lambda error: error["type"] != "extra_forbidden")
        raise LinkError(f"{file}: {'.'.join(str(part) for part in first['loc'][1:])}: {first['msg']}") from None
    for stream, uses in mapping.uses.items():
        if stream != AUTOPILOT and len(uses) > 1:
            raise LinkError(f"{file}: {stream} takes one topic, not {len(uses)}; only {AUTOPILOT} takes several")
    return mapping


def checked(mapping: BagMapping, topics: Iterable[BagTopic], source: str) -> dict[str, tuple[str, TopicUse]]:
    """By topic of the bag: the topic of the recording and how it is read. LinkError for a missing or unfit topic."""
    types = {topic.name: topic.type for topic in topics if topic.messages}
    by_topic: dict[str, tuple[str, TopicUse]] = {}
    for stream, uses in mapping.uses.items():
        for use in uses:
            kind = types.get(use.topic)
            if kind is None:
                raise LinkError(f"{source}: {stream}: no message on topic {use.topic}{_near(use.topic, types)}")
            if kind not in TYPES[stream]:
                raise LinkError(
                    f"{source}: {stream} cannot be made of {use.topic}, type {kind}: "
                    f"it takes {', '.join(TYPES[stream])}"
                )
            if kind == GNSS and _ESTIMATE.search(use.topic):
                raise LinkError(
                    f"{source}: {use.topic} is the position of the autopilot's estimator, which may contain poses that "
                    f"grd sent: use the receiver's, {_ESTIMATE.sub('global_position/raw/fix', use.topic)}"
                )
            if use.topic in by_topic:
                raise LinkError(f"{source}: {use.topic} is named for {by_topic[use.topic][0]} and for {stream}")
            by_topic[use.topic] = stream, use
    return by_topic


def guess(topics: Iterable[BagTopic]) -> BagMapping:
    """The likely mapping, by type and then by name and number of messages; what is not in the bag is left out."""
    there = sorted((topic for topic in topics if topic.messages), key=lambda topic: (-topic.messages, topic.name))
    uses: dict[str, tuple[TopicUse, ...]] = {}
    for stream, kinds in TYPES.items():
        fits = [topic for kind in kinds for topic in there if topic.type == kind]
        found = _named(stream, fits)
        if found:
            uses[stream] = tuple(TopicUse(topic=topic.name) for topic in found)
    return BagMapping(uses=uses)


def _named(stream: str, fits: list[BagTopic]) -> list[BagTopic]:
    """Those of the topics of fitting types, best first, whose names fit the stream."""
    if stream == LIDAR:
        return [topic for topic in fits if not _NOT_PACKETS.search(topic.name)][:1]
    if stream == SERVO:
        return [topic for topic in fits if topic.type.endswith("JointState") or _SERVO.search(topic.name)][:1]
    if stream == AUTOPILOT:
        frames = [topic for topic in fits if topic.type == MAVLINK and not topic.name.endswith("/to")][:1]
        drone = [topic for topic in fits if topic.type != MAVLINK and _DRONE.search(topic.name)]
        drone = [topic for topic in drone if topic.type != POSE or not _GLOBAL.search(topic.name)]
        drone = [topic for topic in drone if topic.type != GNSS or _RECEIVER.search(topic.name)]
        return frames or [topic for topic in drone if topic == next(t for t in drone if t.type == topic.type)]
    if stream == DRONE_CAMERA:
        return [topic for topic in fits if _DRONE.search(topic.name)][:1]
    vehicle = [topic for topic in fits if not _DRONE.search(topic.name)]
    return sorted(vehicle, key=lambda topic: not _VEHICLE.search(topic.name))[:1]


def _near(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), 1, 0.5)
    return f". Did you mean {close[0]}?" if close else ""
