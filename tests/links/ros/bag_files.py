"""Writes ROS bags for tests: ROS 1, and ROS 2 as sqlite3 or MCAP; messages from plain values."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from links.ros.message_types import DEFINITIONS, build, header, stamp, typestore
from stages.messages import LidarFirings

__all__ = ["START_NS", "Entry", "build", "cloud", "header", "joined", "scan", "stamp", "typestore", "write_bag"]

POINT_TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
START_NS = 1_700_000_000_000_000_000
Entry = tuple[str, str, int, Any]  # topic, type, time [ns], values by field name


def write_bag(path: Path, entries: Iterable[Entry], ros: int | None = None, **options: Any) -> Path:
    """A bag at `path`: ROS 1 for .bag, else a folder of ROS 2 (mcap for a name with `mcap`). Missing fields are zero."""
    entries = list(entries)
    if ros is None:
        ros = 1 if path.suffix == ".bag" else 2
    return _write_ros1(path, entries, **options) if ros == 1 else _write_ros2(path, entries, **options)


def _write_ros2(path: Path, entries: list[Entry], compression: str | None = None) -> Path:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    store = typestore()
    plugin = StoragePlugin.MCAP if "mcap" in path.name else StoragePlugin.SQLITE3
    writer = Writer(path, version=9, storage_plugin=plugin)
    if compression:
        writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, time_ns, values in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], time_ns, store.serialize_cdr(build(store, kind, values), kind))
    return path


def _write_ros1(path: Path, entries: list[Entry], compression: str | None = None) -> Path:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    writer = Writer(path)
    if compression:
        writer.set_compression(Writer.CompressionFormat[compression])
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, time_ns, values in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], time_ns, store.serialize_ros1(build(store, kind, values), kind))
    return path


def scan(time_ns: int, packets: Iterable[tuple[int, bytes]], size: int | None = None) -> dict[str, Any]:
    """A VelodyneScan, or with `size` a PandarScan with packets of so many bytes."""
    made = []
    for at_ns, data in packets:
        packet: dict[str, Any] = {"stamp": stamp(at_ns), "data": list(data.ljust(size or 0, b"\0"))}
        if size:
            packet["size"] = len(data)
        made.append(packet)
    return {"header": header(time_ns), "packets": made}


def cloud(time_ns: int, columns: dict[str, Any], frame: str = "lidar") -> dict[str, Any]:
    """A PointCloud2 of columns."""
    kinds = {name: np.asarray(values).dtype for name, values in columns.items()}
    table = np.zeros(len(next(iter(columns.values()))), dtype=[(name, kind) for name, kind in kinds.items()])
    for name, values in columns.items():
        table[name] = values
    fields = [
        {"name": n, "offset": table.dtype.fields[n][1], "datatype": POINT_TYPES[k.str[1:]], "count": 1}  # pyright: ignore[reportOptionalSubscript]
        for n, k in kinds.items()
    ]
    return {
        "header": header(time_ns, frame),
        "height": 1,
        "width": len(table),
        "fields": fields,
        "point_step": table.itemsize,
        "row_step": table.nbytes,
        "data": np.frombuffer(table.tobytes(), np.uint8),
    }


def joined(firings: Iterable[LidarFirings]) -> SimpleNamespace:
    """Columns of several messages as one, returns only."""
    parts = list(firings)
    keep = np.concatenate([(f.range_m > 0) & (f.return_kind == 0) for f in parts])
    names = ("pulse_stamp_ns", "laser", "azimuth_rad", "range_m", "reflectivity", "xyz_lidar_m")
    return SimpleNamespace(**{n: np.concatenate([getattr(f, n) for f in parts])[keep] for n in names})
