"""Exporting recordings and runs for Foxglove: read back with mcap alone, every message valid by its schema.

FOXGLOVE_SCHEMAS=DIR, with schemas/jsonschema/*.json of https://github.com/foxglove/foxglove-sdk, validates with those,
too.
"""

from __future__ import annotations

import base64
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from flow.link import LinkError
from links.cli.app import app
from links.foxglove import export
from links.foxglove.schemas import SCHEMAS
from links.lidar import Lidar, rig_unit
from links.recording import decode_compressed_image
from links.runs.results import POSE_UPPER
from tests.links.ros.test_export import small

TYPES = {"string": str, "integer": int, "number": (int, float), "object": dict, "array": list}
DTYPES = {3: "<u2", 5: "<u4", 7: "<f4"}
KNOWN = {  # https://docs.foxglove.dev/docs/sdk/schemas: fields of each message
    "foxglove.PoseInFrame": ["timestamp", "frame_id", "pose"],
    "foxglove.Point3InFrame": ["timestamp", "frame_id", "point"],
    "foxglove.FrameTransform": [
        "timestamp",
        "parent_frame_id",
        "child_frame_id",
        "translation",
        "rotation",
    ],
    "foxglove.PointCloud": ["timestamp", "frame_id", "pose", "point_stride", "fields", "data"],
    "foxglove.CompressedImage": ["timestamp", "frame_id", "data", "format"],
    "foxglove.Log": ["timestamp", "level", "message", "name", "file", "line"],
}


def errors_of(value: Any, schema: dict[str, Any], at: str = "") -> list[str]:
    """Violations of the part of JSON Schema that these schemas use."""
    kind = TYPES.get(schema.get("type", ""))
    if kind is not None and (not isinstance(value, kind) or isinstance(value, bool)):
        return [f"{at}: {type(value).__name__} is no {schema['type']}"]
    found = [f"{at}.{name}: missing" for name in schema.get("required", []) if name not in value]
    if "oneOf" in schema and value not in [each["const"] for each in schema["oneOf"]]:
        found.append(f"{at}: {value} is none of oneOf")
    if value is not None and not schema.get("minimum", -np.inf) <= (value if isinstance(value, int) else 0):
        found.append(f"{at}: {value} is too small")
    if value is not None and not (value if isinstance(value, int) else 0) <= schema.get("maximum", np.inf):
        found.append(f"{at}: {value} is too large")
    if schema.get("contentEncoding") == "base64":
        base64.b64decode(value, validate=True)
    if isinstance(value, dict):
        for name, inner in value.items():
            if name not in schema["properties"]:
                found.append(f"{at}.{name}: unknown")
            else:
                found += errors_of(inner, schema["properties"][name], f"{at}.{name}")
    if isinstance(value, list):
        found += [e for k, inner in enumerate(value) for e in errors_of(inner, schema["items"], f"{at}[{k}]")]
    return found


def read(path: Path) -> dict[str, list[tuple[str, int, int, dict[str, Any]]]]:
    """Messages by topic with their schema's name and both times; each is valid by the schema in the file."""
    out: dict[str, list[tuple[str, int, int, dict[str, Any]]]] = {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
            values = json.loads(message.data)
            assert errors_of(values, json.loads(schema.data)) == []
            out.setdefault(channel.topic, []).append((schema.name, message.log_time, message.publish_time, values))
    return out


def time_ns(values: dict[str, Any]) -> int:
    return values["timestamp"]["sec"] * 1_000_000_000 + values["timestamp"]["nsec"]


def made_run(folder: Path, start_ns: int) -> None:
    """A run of three poses: the second without rotation."""
    folder.mkdir()
    lines, rows = [], ["stamp_ns,state,rotation,accepted,resets,nis,measured_s,track_id," + ",".join(POSE_UPPER)]
    for k, state in enumerate(("FULL", "POSITION_ONLY", "FULL")):
        at_s = start_ns * 1e-9 + 0.2 * k
        known = state == "FULL"
        q = "0 0 0.6 0.8" if known else "0 0 0 1"
        lines.append(f"{at_s:.9f} {1.5 + k} -2 8.25 {q}")
        block = np.diag([(0.01 if known else np.pi) ** 2] * 3 + [0.04] * 3)[np.triu_indices(6)]
        rows.append(f"{round(at_s * 1e9)},{state},{int(known)},1,0,1.0,0.0,1," + ",".join(map(str, block)))
    (folder / "pose_vehicle_drone.tum").write_text("\n".join(lines) + "\n")
    (folder / "pose_covariance.csv").write_text("\n".join(rows) + "\n")


def test_the_fields_are_those_of_the_documentation():
    assert {name: schema["required"] for name, schema in SCHEMAS.items()} == KNOWN
    assert all(list(schema["properties"]) == schema["required"] for schema in SCHEMAS.values())


def test_a_recording_is_read_back_with_equal_values(tmp_path):
    path, rig_yaml, records = small(tmp_path)
    report = export(path, tmp_path / "out.mcap")
    topics = read(tmp_path / "out.mcap")
    assert {topic: len(messages) for topic, messages in topics.items()} == report.topics
    for camera in ("vehicle", "drone"):
        images = [r for r in records if r.topic == f"/camera/{camera}"]
        shown = topics[f"/camera/{camera}/compressed"]
        assert len(images) == len(shown) > 2
        for record, (schema, log_ns, _, values) in zip(images, shown, strict=True):
            image = decode_compressed_image(record.data)
            assert (schema, log_ns, time_ns(values)) == (
                "foxglove.CompressedImage",
                record.arrival_ns,
                record.stamp_ns,
            )
            assert base64.b64decode(values["data"]) == image.data
            assert (values["format"], values["frame_id"]) == (image.format, image.frame_id)
    lidar = Lidar(unit=rig_unit(rig_yaml, ""), slice_ms=0.1)
    firings = [f for r in records if r.topic == "/lidar/packets" and (f := lidar.decode(r)) is not None]
    wanted = np.concatenate([f.xyz_lidar_m[f.range_m > 0] for f in firings]).astype(np.float32)
    points = []
    for schema, _, _, values in topics["/lidar/points"]:
        dtype = np.dtype({
            "names": [f["name"] for f in values["fields"]],
            "formats": [DTYPES[f["type"]] for f in values["fields"]],
            "offsets": [f["offset"] for f in values["fields"]],
            "itemsize": values["point_stride"],
        })  # fmt: skip
        points.append(np.frombuffer(base64.b64decode(values["data"]), dtype))
        assert (schema, values["frame_id"]) == ("foxglove.PointCloud", "lidar")
    got = np.concatenate(points)
    assert np.array_equal(np.stack([got[axis] for axis in "xyz"], axis=1), wanted)
    turns = [v for _, _, _, v in topics["/tf"] if v["child_frame_id"] == "turntable"]
    assert len(turns) == sum(r.topic == "/servo/state" for r in records)
    odometry = [v for _, _, _, v in topics["/tf"] if v["child_frame_id"] == "vehicle"]
    assert odometry[0]["translation"] == {"x": 1.0, "y": 2.0, "z": 3.0}
    assert odometry[0]["rotation"] == {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8}
    truth = json.loads(next(r.data for r in records if r.topic == "/truth/drone"))
    assert list(topics["/truth/drone"][0][3]["pose"]["position"].values()) == truth["xyz_m"]


def test_a_run_has_a_pose_only_while_its_rotation_is_known(tmp_path):
    made_run(tmp_path / "run", 1_700_000_000_000_000_000)
    report = export(tmp_path / "run", tmp_path / "out.mcap")
    topics = read(tmp_path / "out.mcap")
    assert [v["point"] for _, _, _, v in topics["/grd/pose/point"]] == [
        {"x": 1.5 + k, "y": -2.0, "z": 8.25} for k in range(3)
    ]
    poses = [v for _, _, _, v in topics["/grd/pose"]]
    assert [p["pose"]["position"]["x"] for p in poses] == [1.5, 3.5]
    assert poses[0]["pose"]["orientation"] == {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8}
    assert all(p["frame_id"] == "vehicle" for p in poses)
    assert [(v["message"], v["level"]) for _, _, _, v in topics["/grd/state"]] == [
        ("FULL", 2),
        ("POSITION_ONLY", 3),
        ("FULL", 2),
    ]
    assert any("--recording" in text for text in report.warnings)


def test_a_run_and_its_recording_are_in_order_of_time(tmp_path):
    path, _, records = small(tmp_path)
    made_run(tmp_path / "run", records[0].arrival_ns)
    export(tmp_path / "run", tmp_path / "out.mcap", recording=path)
    with (tmp_path / "out.mcap").open("rb") as stream:
        times = [m.log_time for _, _, m in make_reader(stream).iter_messages(log_time_order=False)]
    assert np.diff(times).min() >= -100_000_000  # a cloud is written with its last packet
    assert {"/grd/pose", "/lidar/points"} <= read(tmp_path / "out.mcap").keys()


def test_nothing_is_overwritten_by_mistake(tmp_path):
    path, _, _ = small(tmp_path)
    before = path.read_bytes()
    for overwrite in (False, True):
        with pytest.raises(LinkError, match=r"is the recording itself|exists already"):
            export(path, path, overwrite=overwrite)
    other = tmp_path / "notes.mcap"
    other.write_text("notes")
    with pytest.raises(LinkError, match="exists already"):
        export(path, other, overwrite=True)
    assert (path.read_bytes(), other.read_text()) == (before, "notes")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["notes.mcap", "small.mcap"]


def test_nothing_half_written_remains(tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(LinkError, match="no pose"):
        export(empty, tmp_path / "out.mcap")
    assert [p.name for p in tmp_path.iterdir()] == ["empty"]


def test_the_command_names_the_file(tmp_path):
    path, _, _ = small(tmp_path, 0.3)
    result = CliRunner().invoke(app, ["export", str(path), "--foxglove"])
    assert result.exit_code == 0, result.output
    assert (tmp_path / "small_foxglove.mcap").is_file()
    again = CliRunner().invoke(app, ["export", str(path), "--foxglove"])
    assert again.exit_code == 2
    assert "overwrite" in again.output
    assert CliRunner().invoke(app, ["export", str(path), "--foxglove", "--overwrite"]).exit_code == 0


@pytest.mark.skipif("FOXGLOVE_SCHEMAS" not in os.environ, reason="needs FOXGLOVE_SCHEMAS=schemas/jsonschema")
def test_every_message_is_valid_by_the_official_schema(tmp_path):
    folder = Path(os.environ["FOXGLOVE_SCHEMAS"])
    path, _, records = small(tmp_path)
    made_run(tmp_path / "run", records[0].arrival_ns)
    export(tmp_path / "run", tmp_path / "out.mcap", recording=path)
    seen = set()
    for messages in read(tmp_path / "out.mcap").values():
        for schema, _, _, values in messages:
            official = json.loads((folder / f"{schema.removeprefix('foxglove.')}.json").read_text())
            assert errors_of(values, official) == []
            seen.add(schema)
    assert seen == KNOWN.keys()
    for name in KNOWN:
        official = json.loads((folder / f"{name.removeprefix('foxglove.')}.json").read_text())
        assert official["title"] == name
        assert set(official["required"]) <= set(KNOWN[name])
