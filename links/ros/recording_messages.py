"""Records of a recording as ROS 2 messages, in the frames of `stages/geometry/frames.py`.

LiDAR packets become both `/lidar/packets` (nebula_msgs/NebulaPackets, the payloads) and `/lidar/points`, each message
with CLOUD_NS of data. Every point has its time and its laser; its axes are the sensor's. A frame of the autopilot
becomes mavros_msgs/Mavlink, byte for byte.

Source: ROS 2 common_interfaces; REP-103, REP-105; `links/ros/autopilot.py` for the same the other way round.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flow.config.yaml_text import yaml_values
from flow.link import LinkError, Record
from links.lidar import Lidar, rig_unit
from links.mavlink.transport.framing import V1
from links.recording import decode_compressed_image
from links.recording.format import TRUTH_POSES
from links.ros.mapping import MAVLINK, POINTS, POSE
from links.ros.message_types import header, stamp
from links.runs.truth import INVALID, true_pose
from stages.geometry.frames import Array64, Pose, quaternions_xyzw, rotation_from_quaternion_xyzw, rotation_z
from stages.messages import LidarFirings

Entry = tuple[str, str, int, dict[str, Any]]  # topic, type, time of recording [ns], values
CLOUD_NS = 100_000_000
PACKET_MS = 0.1  # shorter than any packet: a message each, none is left over at the end
TF = "tf2_msgs/msg/TFMessage"
_POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("t", "<u4")]  # t: ns after stamp
)
_DATATYPE = {"<f4": 7, "<u2": 4, "<u4": 6}


def pose_values(xyz_m: Any, quaternion_xyzw: Any) -> dict[str, Any]:
    """Values of a geometry_msgs/Pose."""
    return {
        "position": dict(zip("xyz", map(float, xyz_m), strict=True)),
        "orientation": dict(zip("xyzw", map(float, quaternion_xyzw), strict=True)),
    }


def transform_values(time_ns: int, parent: str, child: str, xyz_m: Any, quaternion_xyzw: Any) -> dict[str, Any]:
    """Values of a TFMessage with one transform."""
    pose = pose_values(xyz_m, quaternion_xyzw)
    transform = {"translation": pose["position"], "rotation": pose["orientation"]}
    return {"transforms": [{"header": header(time_ns, parent), "child_frame_id": child, "transform": transform}]}


def fixed_covariance(body: NDArray[np.float64], quaternion_xyzw: Any) -> NDArray[np.float64]:
    """ROS's 36 numbers (translation first, fixed axes) of a covariance (6, 6), rotation first, tangent at the body."""
    R = rotation_from_quaternion_xyzw(tuple(quaternion_xyzw))
    J = np.zeros((6, 6))
    J[:3, 3:], J[3:, :3] = R, R
    return (J @ body @ J.T).ravel()


class RecordingMessages:
    """Messages of consecutive records of one recording."""

    def __init__(self, rig_yaml: str | None, source: str) -> None:
        self._source = source
        self._rig: dict[str, Any] = {} if rig_yaml is None else yaml_values(rig_yaml)
        self._unit = rig_unit(rig_yaml, source) if rig_yaml is not None and "lidar" in self._rig else None
        self._lidar = None if self._unit is None else Lidar(unit=self._unit, slice_ms=PACKET_MS)
        self._packets: list[Record] = []
        self._firings: list[LidarFirings] = []
        self._static_sent = False
        self._left_out: Counter[str] = Counter()
        self._invalid: Counter[str] = Counter()

    def of(self, record: Record) -> Iterator[Entry]:
        """The messages of a record; packets are collected, invalid JSON is counted."""
        if not self._static_sent:
            self._static_sent = True
            yield from self._static(record.arrival_ns)
        topic = record.topic
        if topic == "/lidar/packets":
            if self._lidar is None:
                raise LinkError(f"{self._source} has no rig, so its packets give no points: give the rig with --rig")
            if self._packets and abs(record.stamp_ns - self._packets[0].stamp_ns) >= CLOUD_NS:  # a clock may step
                yield from self.end()
            self._packets.append(record)
            if (firings := self._lidar.decode(record)) is not None:
                self._firings.append(firings)
        elif topic.startswith("/camera/"):
            yield from _image(record)
        elif topic in ("/autopilot/rx", "/autopilot/tx"):
            name = "/mavlink/from" if topic.endswith("rx") else "/mavlink/to"
            yield name, MAVLINK, record.arrival_ns, _mavlink(record)
        elif topic in ("/servo/state", "/vehicle/odometry", *TRUTH_POSES):
            try:
                entries = list(self._of_json(record))
            except INVALID:
                self._invalid[topic] += 1
                return
            yield from entries
        else:
            self._left_out[topic] += 1

    def _of_json(self, record: Record) -> Iterator[Entry]:
        """The messages of a record of the servo, the odometry or the truth. Raises one of INVALID."""
        if record.topic == "/servo/state":
            yield from self._servo(record)
        elif record.topic == "/vehicle/odometry":
            yield from _odometry(record)
        else:
            values = {"header": header(record.stamp_ns, "world"), "pose": pose_values(*true_pose(record.data))}
            yield record.topic, "geometry_msgs/msg/PoseStamped", record.arrival_ns, values

    def end(self) -> Iterator[Entry]:
        """The collected packets and their points."""
        if not self._packets:
            return
        first, last = self._packets[0], self._packets[-1]
        packets = [{"stamp": stamp(r.arrival_ns), "data": np.frombuffer(r.data, np.uint8)} for r in self._packets]
        values = {"header": header(first.stamp_ns, "lidar"), "packets": packets}
        yield "/lidar/packets", "nebula_msgs/msg/NebulaPackets", last.arrival_ns, values
        if self._firings:
            yield "/lidar/points", POINTS, last.arrival_ns, _cloud(self._firings)
        self._packets, self._firings = [], []

    def warnings(self) -> list[str]:
        """Topics with records that were left out."""
        unknown = [f"{n} records on {topic} are left out: no message holds them" for topic, n in self._left_out.items()]
        return unknown + [f"{n} records on {topic} are left out: invalid" for topic, n in self._invalid.items()]

    def _static(self, time_ns: int) -> Iterator[Entry]:
        """The transforms of the rig that do not change."""
        transforms: list[tuple[str, str, Array64]] = []
        if self._unit is not None:
            mount = self._unit.mount
            transforms += [
                ("vehicle", "turntable_base", mount.T_vehicle_turntable.matrix()),
                ("turntable", "lidar", mount.T_turntable_lidar.matrix()),
            ]
            if not mount.turns:
                transforms.append(("turntable_base", "turntable", np.eye(4)))
        cameras = self._rig.get("cameras")
        for name in ("vehicle", "drone"):
            pose = (cameras or {}).get(name, {}).get(f"T_{name}_camera")
            if pose is not None:
                transforms.append((name, f"camera_{name}", Pose.model_validate(pose).matrix()))
        if transforms:
            each = [transform_values(time_ns, parent, child, *_parts(T)) for parent, child, T in transforms]
            yield "/tf_static", TF, time_ns, {"transforms": [values["transforms"][0] for values in each]}

    def _servo(self, record: Record) -> Iterator[Entry]:
        state = json.loads(record.data)
        values = {
            "header": header(record.stamp_ns),
            "name": ["turntable"],
            "position": [state["position_rad"]],
            "velocity": [state["velocity_radps"]],
        }
        yield "/joint_states", "sensor_msgs/msg/JointState", record.arrival_ns, values
        if self._unit is not None:
            angle = float(self._unit.mount.turntable_rad(float(state["position_rad"])))
            rotation = quaternions_xyzw(rotation_z(angle)[None])[0]
            turn = transform_values(record.stamp_ns, "turntable_base", "turntable", (0, 0, 0), rotation)
            yield "/tf", TF, record.arrival_ns, turn


def _parts(T: Array64) -> tuple[Array64, Array64]:
    return T[:3, 3], quaternions_xyzw(T[None, :3, :3])[0]


def _image(record: Record) -> Iterator[Entry]:
    image = decode_compressed_image(record.data)
    values = {
        "header": header(record.stamp_ns, image.frame_id),
        "format": image.format,
        "data": np.frombuffer(image.data, np.uint8),
    }
    yield f"{record.topic}/compressed", "sensor_msgs/msg/CompressedImage", record.arrival_ns, values


def _odometry(record: Record) -> Iterator[Entry]:
    fields = json.loads(record.data)
    xyz_m, q, rows = fields["xyz_m"], fields["quaternion_xyzw"], fields.get("covariance")
    covariance = np.zeros(36) if rows is None else fixed_covariance(np.array(rows, np.float64).reshape(6, 6), q)
    values = {
        "header": header(record.stamp_ns, "map"),
        "child_frame_id": "vehicle",
        "pose": {"pose": pose_values(xyz_m, q), "covariance": covariance},
        "twist": {"covariance": [-1.0] + 35 * [0.0]},  # not known
    }
    yield record.topic, POSE, record.arrival_ns, values
    yield "/tf", TF, record.arrival_ns, transform_values(record.stamp_ns, "map", "vehicle", xyz_m, q)


def _mavlink(record: Record) -> dict[str, Any]:
    """Values of a mavros_msgs/Mavlink. LinkError for bytes that are no whole frame."""
    data = record.data
    old = data[:1] == bytes([V1])
    head = 6 if old else 10
    if len(data) < head + 2 or len(data) < head + data[1] + 2:
        raise LinkError(f"{record.topic}: a frame of {len(data)} bytes is cut off: `grd recover` the recording")
    end = head + data[1]
    payload = data[head:end]
    flags = (0, 0) if old else (data[2], data[3])
    source = data[2:5] if old else data[4:7]
    return {
        "header": header(record.stamp_ns),
        "framing_status": 1,
        "magic": data[0],
        "len": data[1],
        "incompat_flags": flags[0],
        "compat_flags": flags[1],
        "seq": source[0],
        "sysid": source[1],
        "compid": source[2],
        "msgid": data[5] if old else int.from_bytes(data[7:10], "little"),
        "checksum": int.from_bytes(data[end : end + 2], "little"),
        "payload64": np.frombuffer(payload.ljust(-(-len(payload) // 8) * 8, b"\0"), "<u8"),
        "signature": np.frombuffer(data[end + 2 :], np.uint8),
    }


def _cloud(firings: list[LidarFirings]) -> dict[str, Any]:
    """The returns of several messages as a PointCloud2."""
    kept = [f.range_m > 0 for f in firings]
    count = int(sum(k.sum() for k in kept))
    start_ns = int(min(f.pulse_stamp_ns.min() for f in firings))
    table = np.zeros(count, _POINT)
    for k, axis in enumerate("xyz"):
        table[axis] = np.concatenate([f.xyz_lidar_m[s, k] for f, s in zip(firings, kept, strict=True)])
    table["intensity"] = np.concatenate([f.reflectivity[s] for f, s in zip(firings, kept, strict=True)])
    table["ring"] = np.concatenate([f.laser[s] for f, s in zip(firings, kept, strict=True)])
    table["t"] = np.concatenate([f.pulse_stamp_ns[s] for f, s in zip(firings, kept, strict=True)]) - start_ns
    fields = [
        {"name": name, "offset": offset, "datatype": _DATATYPE[kind.str], "count": 1}
        for name, (kind, offset) in ((n, v[:2]) for n, v in (_POINT.fields or {}).items())
    ]
    return {
        "header": header(start_ns, "lidar"),
        "height": 1,
        "width": count,
        "fields": fields,
        "point_step": _POINT.itemsize,
        "row_step": table.nbytes,
        "data": np.frombuffer(table.tobytes(), np.uint8),
        "is_dense": True,
    }
