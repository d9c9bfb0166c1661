"""Definitions of messages that are in no ROS distribution: bags of sqlite3 before Iron store none.

Source: velodyne_msgs (ros-drivers/velodyne), pandar_msgs and nebula_msgs (tier4/nebula), hesai_ros_driver
(HesaiTechnology/HesaiLidar_ROS_2.0), ouster_sensor_msgs (ouster-lidar/ouster-ros), mavros_msgs (mavlink/mavros).
"""

from __future__ import annotations

from typing import Any

import numpy as np

_STAMPED = "builtin_interfaces/Time stamp\n"
_SCAN = "std_msgs/Header header\n{package}/{packet}[] packets\n"
_MAVLINK = """\
uint8 FRAMING_OK=1
uint8 MAVLINK_V10=254
uint8 MAVLINK_V20=253
std_msgs/Header header
uint8 framing_status
uint8 magic
uint8 len
uint8 incompat_flags
uint8 compat_flags
uint8 seq
uint8 sysid
uint8 compid
uint32 msgid
uint16 checksum
uint64[] payload64
uint8[] signature
"""

DEFINITIONS = {
    "velodyne_msgs/msg/VelodynePacket": f"{_STAMPED}uint8[1206] data\n",
    "velodyne_msgs/msg/VelodyneScan": _SCAN.format(package="velodyne_msgs", packet="VelodynePacket"),
    "pandar_msgs/msg/PandarPacket": f"{_STAMPED}uint8[1500] data\nuint32 size\n",
    "pandar_msgs/msg/PandarScan": _SCAN.format(package="pandar_msgs", packet="PandarPacket"),
    "hesai_ros_driver/msg/UdpPacket": f"{_STAMPED}uint8[] data\nuint32 size\n",
    "hesai_ros_driver/msg/UdpFrame": "std_msgs/Header header\nhesai_ros_driver/UdpPacket[] packets\n",
    "nebula_msgs/msg/NebulaPacket": f"{_STAMPED}uint8[] data\n",
    "nebula_msgs/msg/NebulaPackets": _SCAN.format(package="nebula_msgs", packet="NebulaPacket"),
    "ouster_ros/msg/PacketMsg": "uint8[] buf\n",
    "ouster_msgs/msg/PacketMsg": "uint8[] buf\n",
    "ouster_sensor_msgs/msg/PacketMsg": "uint8[] buf\n",
    "mavros_msgs/msg/Mavlink": _MAVLINK,
}


def typestore() -> Any:
    """rosbags' type store of ROS 2 Humble with DEFINITIONS."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def stamp(time_ns: int) -> dict[str, int]:
    """Values of a builtin_interfaces/Time."""
    return {"sec": time_ns // 1_000_000_000, "nanosec": time_ns % 1_000_000_000}


def header(time_ns: int, frame: str = "") -> dict[str, Any]:
    """Values of a std_msgs/Header."""
    return {"stamp": stamp(time_ns), "frame_id": frame}


def build(store: Any, kind: str, values: Any) -> Any:
    """A message of `kind` with `values`; fields that are not given are zero or empty."""
    from rosbags.interfaces import Nodetype

    _, fields = store.fielddefs[kind]

    def value_of(definition: Any, value: Any) -> Any:
        node, detail = definition
        if node == Nodetype.NAME:
            return build(store, detail, value or {})
        if node == Nodetype.BASE:
            if value is not None:
                return value
            return "" if detail[0] == "string" else False if detail[0] == "bool" else 0
        (item, item_detail), size = detail
        if item == Nodetype.NAME:
            return [build(store, item_detail, each) for each in value or []]
        if item_detail[0] == "string":
            return list(value or [])
        array = np.zeros(size, dtype=item_detail[0]) if size else np.zeros(0, dtype=item_detail[0])
        return array if value is None else np.asarray(value, dtype=array.dtype)

    made = {name: value_of(definition, values.get(name)) for name, definition in fields}
    return store.types[kind](**made)
