"""Exporting recordings and runs as ROS 2 bags: every value read back by rosbags, and imported again byte for byte."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rosbags.highlevel import AnyReader
from typer.testing import CliRunner

from flow.link import LinkError, Record
from links.cli.app import app
from links.importing import import_file
from links.lidar import Lidar, rig_unit
from links.recording import RecordingReader, RecordingWriter, decode_compressed_image
from links.ros.export import export
from links.ros.recording_messages import RecordingMessages, fixed_covariance
from links.ros.streams import body_covariance
from stages.geometry.frames import rotation_from_quaternion_xyzw

ROOT = Path(__file__).resolve().parents[3]
RECORDING = ROOT / "recordings" / "experiment_1.mcap"


def small(tmp_path: Path, seconds: float = 0.8) -> tuple[Path, str, list[Record]]:
    """The first part of a recording with LiDAR, servo, cameras, autopilot and truth; and one vehicle odometry."""
    with RecordingReader(RECORDING) as reader:
        rig_yaml = reader.rig_yaml
        first = [r for r in reader.records() if r.arrival_ns < reader.start_ns + seconds * 1e9]
    records = [r for r in first if r.topic != "/vehicle/odometry"]
    assert rig_yaml is not None
    covariance = np.diag([0.01, 0.02, 0.03, 1.0, 2.0, 3.0])
    pose = {
        "xyz_m": [1.0, 2.0, 3.0],
        "quaternion_xyzw": [0.0, 0.0, 0.6, 0.8],
        "covariance": covariance.ravel().tolist(),
    }
    at_ns = records[-1].arrival_ns
    records.append(Record("/vehicle/odometry", at_ns, at_ns - 5, json.dumps(pose).encode()))
    path = tmp_path / "small.mcap"
    with RecordingWriter(path, rig_yaml=rig_yaml, lossless=True) as writer:
        for record in records:
            writer.write(record)
    return path, rig_yaml, records


def read(folder: Path) -> dict[str, list[tuple[int, Any]]]:
    """Messages by topic, decoded with the definitions in the bag alone."""
    out: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([folder]) as reader:
        for connection, time_ns, raw in reader.messages():
            out.setdefault(connection.topic, []).append((time_ns, reader.deserialize(raw, connection.msgtype)))
    return out


def stamp_ns(message: Any) -> int:
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def of(records: list[Record], topic: str) -> list[Record]:
    return [r for r in records if r.topic == topic]


def test_an_exported_recording_is_read_back_with_equal_values(tmp_path: Path):
    path, rig_yaml, records = small(tmp_path)
    report = export(path, tmp_path / "bag")
    assert sorted(f.name for f in report.path.iterdir()) == ["bag.mcap", "metadata.yaml"]
    bag = read(report.path)
    assert report.topics == {topic: len(messages) for topic, messages in bag.items()}

    servo = of(records, "/servo/state")
    assert [(t, stamp_ns(m)) for t, m in bag["/joint_states"]] == [(r.arrival_ns, r.stamp_ns) for r in servo]
    states = [json.loads(r.data) for r in servo]
    assert [m.position[0] for _, m in bag["/joint_states"]] == [s["position_rad"] for s in states]
    assert [m.velocity[0] for _, m in bag["/joint_states"]] == [s["velocity_radps"] for s in states]

    for camera in ("vehicle", "drone"):
        images = of(records, f"/camera/{camera}")
        exported = bag[f"/camera/{camera}/compressed"]
        assert len(exported) == len(images) > 0
        for (time_ns, m), r in zip(exported, images, strict=True):
            image = decode_compressed_image(r.data)
            assert (time_ns, stamp_ns(m), m.header.frame_id) == (r.arrival_ns, r.stamp_ns, f"camera_{camera}")
            assert (m.format, m.data.tobytes()) == ("jpeg", image.data)

    for part in ("vehicle", "drone"):
        truth = [json.loads(r.data) for r in of(records, f"/truth/{part}")]
        poses = [m.pose for _, m in bag[f"/truth/{part}"]]
        assert [[p.position.x, p.position.y, p.position.z] for p in poses] == [t["xyz_m"] for t in truth]
        q = [[p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w] for p in poses]
        assert q == [t["quaternion_xyzw"] for t in truth]

    ((_, odometry),) = bag["/vehicle/odometry"]
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "vehicle")
    assert_allclose(np.diag(odometry.pose.covariance.reshape(6, 6))[5], 0.03)  # about z, the axis of the rotation
    R = rotation_from_quaternion_xyzw((0.0, 0.0, 0.6, 0.8))
    assert_allclose(odometry.pose.covariance.reshape(6, 6)[:3, :3], R @ np.diag([1.0, 2.0, 3.0]) @ R.T)
    assert "/truth/hits" not in bag
    del rig_yaml


def test_exported_points_are_the_decoders(tmp_path: Path):
    path, rig_yaml, records = small(tmp_path)
    bag = read(export(path, tmp_path / "bag").path)
    lidar = Lidar(unit=rig_unit(rig_yaml, "test"), slice_ms=0.1)
    firings = [m for r in of(records, "/lidar/packets") if (m := lidar.decode(r)) is not None]
    returned = [f.range_m > 0 for f in firings]
    expected = np.concatenate([f.xyz_lidar_m[s] for f, s in zip(firings, returned, strict=True)])
    times = np.concatenate([f.pulse_stamp_ns[s] for f, s in zip(firings, returned, strict=True)])
    lasers = np.concatenate([f.laser[s] for f, s in zip(firings, returned, strict=True)])
    kind = np.dtype([("xyz", "<f4", 3), ("intensity", "<f4"), ("ring", "<u2"), ("t", "<u4")])
    clouds = [(stamp_ns(m), np.frombuffer(m.data.tobytes(), kind)) for _, m in bag["/lidar/points"]]
    assert (np.concatenate([c["xyz"] for _, c in clouds]) == expected).all()
    assert (np.concatenate([at_ns + c["t"].astype(np.int64) for at_ns, c in clouds]) == times).all()
    assert (np.concatenate([c["ring"] for _, c in clouds]) == lasers).all()
    for _, m in bag["/lidar/points"]:
        assert [f.name for f in m.fields] == ["x", "y", "z", "intensity", "ring", "t"]
        assert [f.offset for f in m.fields] == [0, 4, 8, 12, 16, 18]


def test_clouds_stay_short_after_the_sensors_clock_steps_back(tmp_path: Path):
    path, rig_yaml, records = small(tmp_path)
    packets = of(records, "/lidar/packets")
    step_ns = 3_600_000_000_000
    half = len(packets) // 2
    messages = RecordingMessages(rig_yaml, str(path))
    stepped = [Record(r.topic, r.arrival_ns, r.stamp_ns - step_ns * (k > half), r.data) for k, r in enumerate(packets)]
    entries = [entry for record in stepped for entry in messages.of(record)]
    sizes = [len(values["packets"]) for topic, _, _, values in entries if topic == "/lidar/packets"]
    assert len(sizes) >= 6
    assert max(sizes) <= 80  # 0.1 s


def test_the_transforms_are_the_rigs(tmp_path: Path):
    path, rig_yaml, records = small(tmp_path)
    bag = read(export(path, tmp_path / "bag").path)
    ((_, static),) = bag["/tf_static"]
    names = [(t.header.frame_id, t.child_frame_id) for t in static.transforms]
    assert names == [
        ("vehicle", "turntable_base"),
        ("turntable", "lidar"),
        ("vehicle", "camera_vehicle"),
        ("drone", "camera_drone"),
    ]
    mount = rig_unit(rig_yaml, "test").mount
    q = static.transforms[1].transform.rotation
    assert_allclose(
        rotation_from_quaternion_xyzw((q.x, q.y, q.z, q.w)), mount.T_turntable_lidar.matrix()[:3, :3], atol=1e-12
    )
    turns = [m.transforms[0] for _, m in bag["/tf"] if m.transforms[0].child_frame_id == "turntable"]
    angles = [2 * np.arctan2(t.transform.rotation.z, t.transform.rotation.w) for t in turns]
    expected = [mount.turntable_rad(json.loads(r.data)["position_rad"]) for r in of(records, "/servo/state")]
    assert_allclose(np.sin(angles), np.sin(expected), atol=1e-9)
    with AnyReader([tmp_path / "bag"]) as reader:
        (connection,) = [c for c in reader.connections if c.topic == "/tf_static"]
        assert connection.ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"  # pyright: ignore


def test_an_exported_recording_is_imported_again_byte_for_byte(tmp_path: Path):
    path, rig_yaml, records = small(tmp_path)
    bag = export(path, tmp_path / "bag").path
    report = import_file(bag, tmp_path / "again.mcap", rig_yaml=rig_yaml)
    with RecordingReader(report.path) as reader:
        again = list(reader.records())
    for topic in ("/lidar/packets", "/camera/vehicle", "/camera/drone", "/autopilot/rx"):
        before, after = of(records, topic), of(again, topic)
        assert [(r.arrival_ns, r.data) for r in after] == [(r.arrival_ns, r.data) for r in before], topic
        if topic != "/autopilot/rx":
            late_ns = [abs(a.stamp_ns - b.stamp_ns) for a, b in zip(before, after, strict=True)]
            limit_ns = 1_000_000 if topic == "/lidar/packets" else 0  # a packet's is computed from its arrival, as live
            assert max(late_ns) <= limit_ns, topic
    before, after = of(records, "/servo/state"), of(again, "/servo/state")
    values = [[json.loads(r.data)[n] for n in ("position_rad", "velocity_radps")] for r in before]
    assert [[json.loads(r.data)[n] for n in ("position_rad", "velocity_radps")] for r in after] == values
    (a,), (b,) = of(records, "/vehicle/odometry"), of(again, "/vehicle/odometry")
    assert (a.arrival_ns, a.stamp_ns) == (b.arrival_ns, b.stamp_ns)
    assert_allclose(json.loads(a.data)["covariance"], json.loads(b.data)["covariance"], atol=1e-12)


def test_covariances_turn_between_body_and_fixed_axes():
    random = np.random.default_rng(3)
    A = random.normal(size=(6, 6))
    q = random.normal(size=4)
    q = tuple((q / np.linalg.norm(q)).tolist())
    back = body_covariance(fixed_covariance(A @ A.T, q), q)
    assert back is not None
    assert_allclose(np.reshape(back, (6, 6)), A @ A.T, atol=1e-12)


# ---- runs


def run_folder(tmp_path: Path) -> Path:
    """A run's folder with two fused poses and one LiDAR position, as `links.runs.results` writes them."""
    folder = tmp_path / "run"
    folder.mkdir()
    upper = [f"c{a}{b}" for a in range(6) for b in range(a, 6)]
    diagonal = {"c00": 0.01, "c11": 0.02, "c22": 0.03, "c33": 1.0, "c44": 2.0, "c55": 3.0}
    cells = [str(diagonal.get(name, 0.0)) for name in upper]
    tail = [["FULL", "1", "1", "0", "2.5", "1.100000000", "1"], ["COASTING", "0", "1", "0", "", "1.1", "1"]]
    (folder / "pose_vehicle_drone.tum").write_text(
        "# T_vehicle_drone, fused\n1700000001.100000001 1 2 3 0 0 0.6 0.8\n1700000001.200000002 4 5 6 0 0 0 1\n"
    )
    head = [*upper, "state", "accepted", "rotation", "resets", "nis", "measured_s", "track_id"]
    lines = [["stamp_s", *head], ["1700000001.1", *cells, *tail[0]], ["1700000001.2", *cells, *tail[1]]]
    (folder / "pose_covariance.csv").write_text("".join(",".join(line) + "\n" for line in lines))
    (folder / "fix_vehicle_drone.tum").write_text(
        "# position only: not measured\n1700000001.050000000 1.5 2 3 0 0 0 1\n"
    )
    (folder / "fix_covariance.csv").write_text(
        "stamp_s,cxx_m2,cxy_m2,cxz_m2,cyy_m2,cyz_m2,czz_m2,returns,iterations,track_id\n"
        "1700000001.05,0.1,0.01,0.02,0.2,0.03,0.3,5,1,1\n"
    )
    (folder / "summary.json").write_text("{}")
    return folder


def test_an_exported_run_has_its_poses_transforms_and_diagnostics(tmp_path: Path):
    report = export(run_folder(tmp_path), tmp_path / "bag")
    assert "without the sensors' data" in report.warnings[0]
    bag = read(report.path)
    (first_ns, first), (_, second) = bag["/grd/pose"]
    assert (first_ns, stamp_ns(first), first.header.frame_id) == (1_700_000_001_100_000_001, first_ns, "vehicle")
    p, q = first.pose.pose.position, first.pose.pose.orientation
    assert ([p.x, p.y, p.z], [q.x, q.y, q.z, q.w]) == ([1, 2, 3], [0, 0, 0.6, 0.8])
    R = rotation_from_quaternion_xyzw((0, 0, 0.6, 0.8))
    fixed = first.pose.covariance.reshape(6, 6)
    assert_allclose(fixed[:3, :3], R @ np.diag([1, 2, 3]) @ R.T, atol=1e-12)
    assert_allclose(fixed[3:, 3:], R @ np.diag([0.01, 0.02, 0.03]) @ R.T, atol=1e-12)
    assert_allclose(np.diag(second.pose.covariance.reshape(6, 6)), [1, 2, 3, 0.01, 0.02, 0.03])
    odometry = bag["/grd/odometry"][0][1]
    assert (odometry.child_frame_id, odometry.twist.covariance[0]) == ("drone", -1)
    assert (odometry.pose.covariance == first.pose.covariance).all()
    transform = bag["/tf"][0][1].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("vehicle", "drone")
    assert transform.transform.translation.z == 3
    status = [m.status[0] for _, m in bag["/diagnostics"]]
    assert [(s.message, s.level) for s in status] == [("FULL", 0), ("COASTING", 1)]
    assert {v.key: v.value for v in status[0].values}["nis"] == "2.5"
    ((_, fix),) = bag["/grd/position"]
    covariance = fix.pose.covariance.reshape(6, 6)
    assert_allclose(covariance[:3, :3], [[0.1, 0.01, 0.02], [0.01, 0.2, 0.03], [0.02, 0.03, 0.3]])
    assert covariance[5, 5] == pytest.approx(np.pi**2)


def test_a_pose_whose_rotation_is_unknown_has_no_transform(tmp_path: Path):
    run = run_folder(tmp_path)
    table = run / "pose_covariance.csv"
    table.write_text(table.read_text().replace("COASTING,0,1,", "POSITION_ONLY,0,0,").replace("0.01", "9.8696044"))
    bag = read(export(run, tmp_path / "bag").path)
    assert [time_ns for time_ns, _ in bag["/tf"]] == [1_700_000_001_100_000_001]
    for topic in ("/grd/pose", "/grd/odometry"):
        assert len(bag[topic]) == 2
        pose = bag[topic][1][1].pose
        assert (pose.pose.orientation.x, pose.pose.orientation.w) == (0.0, 1.0)
        assert pose.covariance[21] == pytest.approx(np.pi**2)


def test_a_run_is_exported_with_its_recording(tmp_path: Path):
    path, _, _ = small(tmp_path, 0.3)
    topics = read(export(run_folder(tmp_path), tmp_path / "bag", recording=path).path)
    assert {"/grd/pose", "/lidar/points", "/joint_states"} <= topics.keys()


def test_what_cannot_be_exported_leaves_no_folder(tmp_path: Path):
    empty = tmp_path / "empty"
    empty.mkdir()
    cut = run_folder(tmp_path)
    (cut / "pose_covariance.csv").write_text("stamp_s,state\n")
    for source, says in (
        (empty, "no pose and no position"),
        (cut, "pose_vehicle_drone.tum has 2 lines and pose_covariance.csv 0"),
        (tmp_path / "none.mcap", "no such file"),
    ):
        with pytest.raises(LinkError, match=says):
            export(source, tmp_path / "bag")
    with RecordingWriter(tmp_path / "log.mcap", rig_yaml=None, lossless=True) as writer:
        writer.write(Record("/truth/hits", 1, 1, b"{}"))
    with pytest.raises(LinkError, match=r"no record that `grd export` converts: `grd info .*log.mcap` shows"):
        export(tmp_path / "log.mcap", tmp_path / "bag")
    assert {f.name for f in tmp_path.iterdir()} == {"empty", "run", "log.mcap"}


def test_an_existing_folder_is_kept_unless_it_is_a_bag_and_may_be_overwritten(tmp_path: Path):
    path, _, _ = small(tmp_path, 0.2)
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "note.txt").write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(LinkError, match="exists already"):
            export(path, folder, overwrite=overwrite)
    assert (folder / "note.txt").read_text() == "mine"
    result = CliRunner().invoke(app, ["export", str(path)])
    assert result.exit_code == 0, result.output
    assert (tmp_path / "small_ros2" / "metadata.yaml").is_file()
    assert CliRunner().invoke(app, ["export", str(path)]).exit_code == 2
    assert CliRunner().invoke(app, ["export", str(path), "--overwrite"]).exit_code == 0


def test_a_record_without_a_message_is_counted():
    messages = RecordingMessages(None, "a.mcap")
    for _ in range(2):
        list(messages.of(Record("/cues", 1, 1, b"{}")))
    assert messages.warnings() == ["2 records on /cues are left out: no message holds them"]


@pytest.mark.parametrize(
    ("topic", "data"),
    [
        ("/truth/drone", b"not JSON"),
        ("/truth/drone", b'{"xyz_m": [0, 0, NaN], "quaternion_xyzw": [0, 0, 0, 1]}'),
        ("/truth/vehicle", b'{"xyz_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 2]}'),
        ("/servo/state", b'{"position_rad": 0.1}'),
        ("/vehicle/odometry", b'{"xyz_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1], "covariance": [1]}'),
    ],
)
def test_an_invalid_record_is_left_out_and_counted(topic: str, data: bytes):
    messages = RecordingMessages(None, "a.mcap")
    assert list(messages.of(Record(topic, 1, 1, data))) == []
    assert messages.warnings() == [f"1 records on {topic} are left out: invalid"]
