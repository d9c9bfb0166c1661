"""Importing ROS bags: every container, every message type, mappings, and each bad bag as one sentence."""

from __future__ import annotations

import bz2
import contextlib
import gzip
import itertools
import json
import lzma
import math
import sqlite3
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bag_files import START_NS, Entry, build, header, scan, typestore, write_bag
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from flow.link import LinkError, Record
from links.cli.app import app
from links.importing import import_file
from links.importing.info import file_info
from links.lidar import rig_unit
from links.mavlink.autopilot import Autopilot
from links.mavlink.transport.framing import parse_frame
from links.recording import RecordingReader, decode_compressed_image
from links.ros.mapping import BagMapping, TopicUse, read_mapping
from links.vehicle_odometry.odometry import parse_pose
from stages.messages import AutopilotStatus, DroneAttitude, DroneGnss, DroneImu, DroneOdometry

ROOT = Path(__file__).resolve().parents[3]
OTHER = ROOT.parent / "shared" / "data" / "lidar_other"
OS1 = OTHER / "OS-1-32-G_v2.1.1_1024x10.json"
SCAN, CLOUD = "velodyne_msgs/msg/VelodyneScan", "sensor_msgs/msg/PointCloud2"
JOINTS, STRING = "sensor_msgs/msg/JointState", "std_msgs/msg/String"
RIG = (
    "version: 1\nlidar:\n  model: VLP-16\n  mount:\n    T_vehicle_turntable: {xyz_m: [0.0, 0.0, 0.2]}\n"
    "    T_turntable_lidar: {xyz_m: [0.0, 0.0, 0.1], rpy_deg: [90.0, 0.0, 0.0]}\n"
)


def vlp16() -> list[Record]:
    with RecordingReader(ROOT / "recordings" / "einride_vlp16.mcap") as reader:
        return list(reader.records(["/lidar/packets"]))[:152]


PACKETS = vlp16()


def scans(topic: str = "/velodyne_packets", shift_ns: int = 0) -> list[Entry]:
    """Two scans of 76 real packets, each recorded a little after its last packet."""
    parts = [PACKETS[:76], PACKETS[76:]]
    times = [part[-1].arrival_ns + 100_000 for part in parts]
    return [
        (topic, SCAN, at_ns, scan(at_ns - shift_ns, [(r.arrival_ns - shift_ns, r.data) for r in part]))
        for part, at_ns in zip(parts, times, strict=True)
    ]


def imported(tmp_path: Path, bag: Path, **settings: Any) -> tuple[Any, list[Record], str | None]:
    report = import_file(bag, tmp_path / "imported.mcap", overwrite=True, **settings)
    with RecordingReader(report.path) as reader:
        assert reader.warnings == []
        return report, list(reader.records()), reader.rig_yaml


def mapping(**uses: Any) -> BagMapping:
    """BagMapping of `camera_drone={"topic": ...}` and so on."""
    return BagMapping(uses={f"/{k.replace('_', '/', 1)}": (TopicUse(**v),) for k, v in uses.items()})


def refused(bag: Path, tmp_path: Path, **settings: Any) -> str:
    """The error of an import, one line, which leaves no file."""
    out = tmp_path / "refused.mcap"
    with pytest.raises(LinkError) as error:
        import_file(bag, out, **settings)
    assert not out.exists()
    assert "\n" not in str(error.value)
    return str(error.value)


# ---- containers


@pytest.mark.parametrize(
    ("name", "compression"),
    [
        ("a.bag", None),
        ("lz4.bag", "LZ4"),
        ("bz2.bag", "BZ2"),
        ("sqlite", None),
        ("mcap", None),
        ("mcap_messages", "MESSAGE"),
        ("sqlite_file", "FILE"),
        ("mcap_chunks", "STORAGE"),
    ],
)
def test_every_kind_of_bag_gives_the_packets_byte_for_byte(tmp_path: Path, name: str, compression: str | None):
    bag = write_bag(tmp_path / name, scans(), compression=compression)
    report, records, rig_yaml = imported(tmp_path, bag)
    assert [r.data for r in records] == [r.data for r in PACKETS]
    assert [(r.arrival_ns, r.stamp_ns) for r in records] == [(r.arrival_ns, r.stamp_ns) for r in PACKETS]
    assert (report.topics, report.skipped, report.warnings) == ({"/lidar/packets": 152}, {}, [])
    assert rig_yaml is not None
    assert rig_unit(rig_yaml, "test").model == "VLP-16"


def test_a_file_of_a_bags_folder_is_a_bag_too(tmp_path: Path):
    for name, suffix in (("sqlite", "*.db3"), ("mcap", "*.mcap")):
        (file,) = write_bag(tmp_path / name, scans()).glob(suffix)
        assert len(imported(tmp_path, file)[1]) == 152


def test_the_first_part_of_a_split_bag_stands_for_all_and_a_later_one_is_read_alone(tmp_path: Path):
    for k, entry in enumerate(scans()):
        write_bag(tmp_path / f"drive_{k}.bag", [entry])
    assert [r.data for r in imported(tmp_path, tmp_path / "drive_0.bag")[1]] == [r.data for r in PACKETS]
    report, records, _ = imported(tmp_path, tmp_path / "drive_1.bag")
    assert [r.data for r in records] == [r.data for r in PACKETS[76:]]
    assert "one of 2 parts and read alone" in report.warnings[0]


def test_a_bag_that_was_never_closed_or_is_cut_is_refused_with_advice(tmp_path: Path):
    bag = write_bag(tmp_path / "a.bag", scans())
    data = bag.read_bytes()
    for size in (len(data) // 2, 5000, 20):
        bag.write_bytes(data[:size])
        assert "cannot be read" in refused(bag, tmp_path)
    folder = write_bag(tmp_path / "mcap", scans())
    (file,) = folder.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-200])
    assert "Was it closed?" in refused(folder, tmp_path)
    file.unlink()
    assert "missing" in refused(folder, tmp_path)


def test_a_file_compressed_as_a_whole_is_named_as_that(tmp_path: Path):
    folder = write_bag(tmp_path / "sqlite", scans(), compression="FILE")
    (file,) = folder.glob("*.zstd")
    assert "compressed as a whole: give its folder with metadata.yaml" in refused(file, tmp_path)
    data = write_bag(tmp_path / "a.bag", scans()).read_bytes()
    for compress, unpack in ((gzip.compress, "gunzip -k"), (bz2.compress, "bunzip2 -k"), (lzma.compress, "unxz -k")):
        file = tmp_path / "a.bag.packed"
        file.write_bytes(compress(data))
        assert f"compressed as a whole: unpack it first (`{unpack} {file}`)" in refused(file, tmp_path)


def test_a_folder_without_its_metadata_names_the_file_in_it(tmp_path: Path):
    folder = write_bag(tmp_path / "mcap", scans())
    (folder / "metadata.yaml").unlink()
    text = refused(folder, tmp_path)
    assert f"has no metadata.yaml, so that it is no ROS 2 bag: name the file {folder / 'mcap.mcap'}" in text
    assert len(imported(tmp_path, folder / "mcap.mcap")[1]) == 152


@pytest.mark.parametrize("name", ["a.bag", "sqlite", "mcap"])
def test_flipped_bytes_raise_only_link_errors(tmp_path: Path, name: str):
    bag = write_bag(tmp_path / name, scans()[:1])
    file = bag if bag.is_file() else next(f for f in bag.iterdir() if f.suffix in (".db3", ".mcap"))
    data = bytearray(file.read_bytes())
    random = np.random.default_rng(4)
    for _ in range(40):
        damaged = data.copy()
        for at in random.integers(13, len(data) if random.random() < 0.5 else 800, 3):
            damaged[at] ^= random.integers(1, 256)
        file.write_bytes(damaged)
        with contextlib.suppress(LinkError):
            import_file(bag, tmp_path / "out.mcap", overwrite=True)
            (tmp_path / "out.mcap").unlink()
        assert not (tmp_path / "out.mcap").exists()


# ---- LiDARs


@pytest.mark.skipif(not OTHER.is_dir(), reason="the shared data are not here")
@pytest.mark.parametrize(("name", "model", "packets"), [("hesai_xt16", "XT16", 1626), ("hesai_xt32", "XT32", 2000)])
def test_real_hesai_bags_name_their_model(tmp_path: Path, name: str, model: str, packets: int):
    report, records, rig_yaml = imported(tmp_path, OTHER / f"{name}.db3")
    assert report.topics == {"/lidar/packets": packets}
    assert report.skipped == {}
    assert rig_yaml is not None
    assert rig_unit(rig_yaml, "test").model == model
    assert all(b.arrival_ns >= a.arrival_ns for a, b in itertools.pairwise(records))


def test_packets_of_hesais_driver_have_the_time_of_recording(tmp_path: Path):
    """It sets the time of the frame alone, in the sensor's clock; here the frame has packets of a VLP-16."""
    entries: list[Entry] = []
    for _, _, at_ns, values in scans():
        packets = [{"data": packet["data"], "size": 1206} for packet in values["packets"]]
        entries.append(
            ("/lidar_packets", "hesai_ros_driver/msg/UdpFrame", at_ns, {"header": header(7), "packets": packets})
        )
    _, records, _ = imported(tmp_path, write_bag(tmp_path / "bag", entries))
    assert [r.data for r in records] == [r.data for r in PACKETS]
    late_ns = np.array([a.arrival_ns - b.arrival_ns for a, b in zip(records, PACKETS, strict=True)])
    assert (np.abs(late_ns - 100_000) < 20_000).all()


@pytest.mark.skipif(not OTHER.is_dir(), reason="the shared data are not here")
@pytest.mark.parametrize("package", ["ouster_ros", "ouster_msgs", "ouster_sensor_msgs"])
def test_packets_of_an_older_ouster_driver_have_one_byte_more(tmp_path: Path, package: str):
    from links.importing.pcap import PcapReport, read_datagrams

    name, kind = OTHER / "OS-0-32-U1_v2.2.0_1024x10", f"{package}/msg/PacketMsg"
    with name.with_name(f"{name.name}.pcap").open("rb") as stream:
        datagrams = [d for d in read_datagrams(stream, name, PcapReport()) if len(d.payload) == 8448]  # no IMU
    entries: list[Entry] = [("/ouster/lidar_packets", kind, d.time_ns, {"buf": [*d.payload, 0]}) for d in datagrams]
    metadata = name.with_name(f"{name.name}.json").read_text()
    entries.insert(0, ("/ouster/metadata", STRING, datagrams[0].time_ns, {"data": metadata}))
    _, records, _ = imported(tmp_path, write_bag(tmp_path / "bag", entries))
    assert [r.data for r in records] == [d.payload for d in datagrams]
    assert len(records) == 64


@pytest.mark.skipif(not OTHER.is_dir(), reason="the shared data are not here")
def test_an_ouster_is_known_by_the_metadata_in_the_bag_and_refused_without(tmp_path: Path):
    from links.importing.pcap import PcapReport, read_datagrams

    name = OTHER / "OS-0-32-U1_v2.2.0_1024x10"
    with name.with_name(f"{name.name}.pcap").open("rb") as stream:
        datagrams = list(read_datagrams(stream, name, PcapReport()))
    kind = "ouster_sensor_msgs/msg/PacketMsg"
    entries: list[Entry] = [("/ouster/lidar_packets", kind, d.time_ns, {"buf": list(d.payload)}) for d in datagrams]
    metadata = name.with_name(f"{name.name}.json").read_text()
    metadata_entry: Entry = ("/ouster/metadata", STRING, datagrams[0].time_ns, {"data": metadata})
    report, records, rig_yaml = imported(tmp_path, write_bag(tmp_path / "with", [metadata_entry, *entries]))
    assert rig_yaml is not None
    unit = rig_unit(rig_yaml, "test")
    assert (unit.model, unit.mount.turns) == ("OS0-32", False)
    assert report.topics["/lidar/packets"] == len(records) == 64
    bag = write_bag(tmp_path / "without", entries)
    assert "no metadata: give the sensor's with --rig" in refused(bag, tmp_path)
    other = metadata.replace('"prod_sn": "', '"prod_sn": "9')
    assert other != metadata
    metadata_entry = ("/ouster/metadata", STRING, datagrams[0].time_ns, {"data": other})
    text = refused(write_bag(tmp_path / "other", [metadata_entry, *entries]), tmp_path)
    assert "from Ouster with serial number 992137000142" in text
    assert "every point would be wrong. Give this unit's metadata" in text
    metadata_entry = ("/ouster/metadata", STRING, datagrams[0].time_ns, {"data": OS1.read_text()})
    text = refused(write_bag(tmp_path / "os1", [metadata_entry, *entries]), tmp_path)
    assert "have 8448 bytes; those of the OS1-32 of the rig's metadata have 6464 bytes: give the LiDAR's own" in text
    metadata_entry = ("/ouster/metadata", STRING, datagrams[0].time_ns, {"data": "{}"})
    assert "not the metadata of an Ouster" in refused(
        write_bag(tmp_path / "empty", [metadata_entry, *entries]), tmp_path
    )


def test_the_rigs_model_must_be_the_packets(tmp_path: Path):
    bag = write_bag(tmp_path / "bag", scans())
    text = refused(bag, tmp_path, rig_yaml=RIG.replace("VLP-16", "VLP-32C"))
    assert "from Velodyne VLP-16" in text
    assert "not a VLP-32C" in text
    text = refused(bag, tmp_path, rig_yaml=RIG.replace("VLP-16", "XT32"))
    assert "152 packets on /velodyne_packets are from a VLP-16; those of a XT32 have 1080 bytes: give" in text


def test_a_lidar_on_a_servo_needs_its_rig(tmp_path: Path):
    joint: Entry = ("/joint_states", JOINTS, PACKETS[0].arrival_ns, {"name": ["a"], "position": [0.5]})
    bag = write_bag(tmp_path / "bag", [joint, *scans()])
    assert "its LiDAR is on a servo, and a bag does not contain its mount: give its rig" in refused(
        bag,
        tmp_path,
        mapping=mapping(
            lidar_packets={"topic": "/velodyne_packets"}, servo_state={"topic": "/joint_states", "stamp": "arrival"}
        ),
    )


def test_a_clock_of_another_epoch_is_an_error_and_the_times_of_recording_can_be_used(tmp_path: Path):
    bag = write_bag(tmp_path / "bag", scans(shift_ns=10**18))
    text = refused(bag, tmp_path)
    assert "1000000000 s from the bag's" in text
    assert "stamp: arrival" in text
    assert "`grd info BAG --map FILE`" in text
    use = {"topic": "/velodyne_packets", "stamp": "arrival"}
    _, records, _ = imported(tmp_path, bag, mapping=mapping(lidar_packets=use))
    assert [r.data for r in records] == [r.data for r in PACKETS]
    late_ns = np.array([a.arrival_ns - b.arrival_ns for a, b in zip(records, PACKETS, strict=True)])
    assert (np.abs(late_ns - 100_000) < 20_000).all()  # the capture's times have this jitter against the sensor's


# ---- servo


def test_a_joint_becomes_the_servo(tmp_path: Path):
    entries: list[Entry] = [
        (
            "/joint_states",
            JOINTS,
            START_NS + k * 10**7 + 1000,
            {"header": header(START_NS + k * 10**7), "name": ["wheel", "pan"], "position": [9.0, 0.1 * k]},
        )
        for k in range(3)
    ]
    bag = write_bag(tmp_path / "bag", entries)
    text = refused(bag, tmp_path)
    assert "several joints (wheel, pan)" in text
    assert "`grd info BAG --map FILE`" in text
    assert "delete the line /servo/state" in text
    use = {"topic": "/joint_states", "joint": "tilt"}
    assert "no joint 'tilt'" in refused(bag, tmp_path, mapping=mapping(servo_state=use))
    _, records, _ = imported(tmp_path, bag, mapping=mapping(servo_state={**use, "joint": "pan"}), rig_yaml=RIG)
    states = [json.loads(r.data) for r in records]
    assert [r.arrival_ns - r.stamp_ns for r in records] == [1000] * 3
    assert_allclose([s["position_rad"] for s in states], [0.0, 0.1, 0.2])
    assert_allclose([s["velocity_radps"] for s in states], [0.0, 10.0, 10.0])


@pytest.mark.parametrize(
    ("names", "words"), [(["pan"], "the position of joint 'pan'"), ([], "no joint (it names none)")]
)
def test_a_joint_state_without_a_position_is_refused_with_advice(tmp_path: Path, names: list[str], words: str):
    bag = write_bag(
        tmp_path / "bag", [("/joint_states", JOINTS, START_NS, {"header": header(START_NS), "name": names})]
    )
    text = refused(bag, tmp_path, rig_yaml=RIG)
    assert words in text
    assert "mapping file" in text


@pytest.mark.parametrize(
    ("kind", "unit", "expected"), [("Float64", "deg", math.radians(30.0)), ("Float32", "rad", 30.0)]
)
def test_a_float_becomes_the_servo(tmp_path: Path, kind: str, unit: str, expected: float):
    bag = write_bag(tmp_path / "a.bag", [("/servo/angle", f"std_msgs/msg/{kind}", START_NS, {"data": 30.0})])
    _, (record,), _ = imported(
        tmp_path, bag, mapping=mapping(servo_state={"topic": "/servo/angle", "unit": unit}), rig_yaml=RIG
    )
    assert (record.arrival_ns, record.stamp_ns) == (START_NS, START_NS)
    assert_allclose(json.loads(record.data)["position_rad"], expected)


# ---- cameras


def photo(height: int = 24, width: int = 32) -> np.ndarray:
    rows, columns = np.mgrid[0:height, 0:width]
    return np.stack([rows * 8, columns * 7, rows + columns], axis=2).astype(np.uint8)


@pytest.mark.parametrize("encoding", ["bgr8", "rgb8", "bgra8", "mono8"])
def test_a_raw_image_becomes_jpeg(tmp_path: Path, encoding: str):
    bgr = photo()
    pixels = {
        "bgr8": bgr,
        "rgb8": bgr[..., ::-1],
        "bgra8": np.dstack([bgr, np.full(bgr.shape[:2], 255, np.uint8)]),
        "mono8": bgr[..., 0],
    }[encoding]
    row = np.ascontiguousarray(pixels).reshape(24, -1)
    padded = np.pad(row, ((0, 0), (0, 4)))  # rows may be longer than the pixels
    values = {
        "header": header(START_NS),
        "height": 24,
        "width": 32,
        "encoding": encoding,
        "step": padded.shape[1],
        "data": padded.ravel(),
    }
    bag = write_bag(tmp_path / "bag", [("/uav/image_raw", "sensor_msgs/msg/Image", START_NS + 5, values)])
    report, (record,), rig_yaml = imported(tmp_path, bag)
    assert report.topics == {"/camera/drone": 1}
    assert rig_yaml is None
    image = decode_compressed_image(record.data)
    assert (image.stamp_ns, image.frame_id, record.arrival_ns) == (START_NS, "camera_drone", START_NS + 5)
    decoded = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
    expected = np.repeat(bgr[..., :1], 3, axis=2) if encoding == "mono8" else bgr
    assert np.abs(decoded.astype(int) - expected).mean() < 4


def test_a_compressed_image_is_kept_as_it_is_and_png_becomes_jpeg(tmp_path: Path):
    jpeg, png = (cv2.imencode(kind, photo())[1].tobytes() for kind in (".jpg", ".png"))
    kind = "sensor_msgs/msg/CompressedImage"

    def bag(data: bytes, name: str) -> Path:
        values = {"header": header(START_NS), "format": name, "data": list(data)}
        return write_bag(tmp_path / f"{name}.bag", [("/roof/compressed", kind, START_NS, values)])

    report, (record,), _ = imported(tmp_path, bag(jpeg, "jpeg"))
    assert report.topics == {"/camera/vehicle": 1}
    assert decode_compressed_image(record.data).data == jpeg
    _, (record,), _ = imported(tmp_path, bag(png, "png"))
    assert decode_compressed_image(record.data).data.startswith(b"\xff\xd8\xff")
    text = refused(bag(b"theora", "theora"), tmp_path)
    assert "an image of format 'theora' is not read: convert the topic to JPEG or PNG, or remove it from" in text


def test_an_image_that_cannot_be_read_is_refused(tmp_path: Path):
    values = {"header": header(START_NS), "height": 2, "width": 2, "encoding": "32FC1", "step": 8, "data": [0] * 16}
    entry: Entry = ("/roof/image", "sensor_msgs/msg/Image", START_NS, values)
    text = refused(write_bag(tmp_path / "a", [entry]), tmp_path)
    assert "images of encoding '32FC1' are not read: convert the topic to one of mono8, " in text
    assert "or remove it from the mapping file" in text
    wrong = values | {"encoding": "bgr8", "width": 4}
    assert "with rows of 8 bytes has 16" in refused(write_bag(tmp_path / "b", [(*entry[:3], wrong)]), tmp_path)


# ---- odometry and autopilot


def test_odometry_keeps_its_covariance_in_body_axes(tmp_path: Path):
    half = math.sqrt(0.5)  # 90 deg of yaw
    sigma2 = [1.0, 4.0, 9.0, 0.01, 0.02, 0.03]  # ROS: translation first, fixed axes
    values = {
        "header": header(START_NS),
        "pose": {
            "pose": {
                "position": {"x": 1.0, "y": 2.0, "z": 3.0},
                "orientation": {"x": 0.0, "y": 0.0, "z": half, "w": half},
            },
            "covariance": np.diag(sigma2).ravel(),
        },
    }
    bag = write_bag(tmp_path / "bag", [("/odom", "nav_msgs/msg/Odometry", START_NS, values)])
    report, (record,), _ = imported(tmp_path, bag)
    assert report.topics == {"/vehicle/odometry": 1}
    motion = parse_pose(record.stamp_ns, record.data)
    assert_allclose(motion.xyz_map_m, [1, 2, 3])
    assert_allclose(motion.R_map_vehicle, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    assert motion.covariance is not None
    assert_allclose(np.diag(motion.covariance), [0.02, 0.01, 0.03, 4.0, 1.0, 9.0])
    unknown = values | {"pose": values["pose"] | {"covariance": np.zeros(36)}}
    bag = write_bag(tmp_path / "unknown", [("/odom", "nav_msgs/msg/Odometry", START_NS, unknown)])
    assert json.loads(imported(tmp_path, bag)[1][0].data)["covariance"] is None


def test_mavros_frames_are_kept_byte_for_byte(tmp_path: Path):
    with RecordingReader(ROOT / "recordings" / "experiment_1.mcap") as reader:
        frames = list(reader.records(["/autopilot/rx"]))[:200]
    entries: list[Entry] = []
    for r in frames:
        d = r.data
        payload = d[10 : 10 + d[1]]
        values = {
            "framing_status": 1,
            "magic": d[0],
            "len": d[1],
            "incompat_flags": d[2],
            "compat_flags": d[3],
            "seq": d[4],
            "sysid": d[5],
            "compid": d[6],
            "msgid": int.from_bytes(d[7:10], "little"),
            "checksum": int.from_bytes(d[10 + d[1] : 12 + d[1]], "little"),
            "payload64": np.frombuffer(payload.ljust(-(-len(payload) // 8) * 8, b"\0"), "<u8"),
            "signature": list(d[12 + d[1] :]),
        }
        entries.append(("/uas1/mavlink_source", "mavros_msgs/msg/Mavlink", r.arrival_ns, values))
    damaged = {**entries[0][3], "framing_status": 2}
    bag = write_bag(tmp_path / "a.bag", [*entries, (*entries[0][:2], entries[-1][2], damaged)])
    report, records, _ = imported(tmp_path, bag)
    assert [r.data for r in records] == [r.data for r in frames]
    assert report.skipped == {"damaged frames on /uas1/mavlink_source": 1}


def test_mavros_topics_become_frames_that_the_autopilots_decoder_reads(tmp_path: Path):
    half = math.sqrt(0.5)
    facing_north = {"x": 0.0, "y": 0.0, "z": half, "w": half}  # ENU: a yaw of 90 deg from east
    imu = {
        "orientation": facing_north,
        "angular_velocity": {"x": 0.1, "y": 0.2, "z": 0.3},
        "linear_acceleration": {"x": 0.5, "y": -0.4, "z": 9.8},
    }
    pose = {"pose": {"pose": {"position": {"x": 5.0, "y": 7.0, "z": 2.0}, "orientation": facing_north}},
            "twist": {"twist": {"linear": {"x": 1.0, "y": 2.0, "z": 3.0}}}}  # fmt: skip
    gnss = {"latitude": 35.7, "longitude": 139.7, "altitude": 40.0}
    entries: list[Entry] = []
    for k in range(50):
        at_ns = START_NS + k * 20_000_000
        for topic, kind, values in (
            ("/mavros/imu/data", "sensor_msgs/msg/Imu", imu),
            ("/mavros/local_position/odom", "nav_msgs/msg/Odometry", pose),
            ("/mavros/global_position/raw/fix", "sensor_msgs/msg/NavSatFix", gnss),
        ):
            entries.append((topic, kind, at_ns + 1_000_000, {"header": header(at_ns), **values}))
    report, records, _ = imported(tmp_path, write_bag(tmp_path / "bag", entries))
    assert report.topics == {"/autopilot/rx": 4 * 50 + 1}
    autopilot = Autopilot()
    messages = [m for r in records if (m := autopilot.decode(r)) is not None]
    newest = {type(m): m for m in messages}
    assert set(newest) == {AutopilotStatus, DroneAttitude, DroneGnss, DroneImu, DroneOdometry}
    assert_allclose(newest[DroneImu].acceleration_drone_mps2, [0.5, -0.4, 9.8], rtol=1e-6)
    assert_allclose(newest[DroneImu].angular_velocity_drone_radps, [0.1, 0.2, 0.3], rtol=1e-6)
    assert_allclose(newest[DroneAttitude].R_odom_drone, np.eye(3), atol=1e-6)  # x of odom is north
    assert_allclose(newest[DroneOdometry].xyz_odom_m, [7.0, -5.0, 2.0], rtol=1e-6)  # north, west, up
    assert_allclose(newest[DroneOdometry].velocity_drone_mps, [1.0, 2.0, 3.0], rtol=1e-6)
    last_ns = START_NS + 49 * 20_000_000
    assert abs(newest[DroneOdometry].stamp_ns - last_ns) < 2_000_000  # late by the least delay, 1 ms


def test_damaged_values_of_mavros_are_counted_and_the_rest_is_imported(tmp_path: Path):
    kinds = {"imu": "sensor_msgs/msg/Imu", "fix": "sensor_msgs/msg/NavSatFix"}
    good = {"orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    values = [("imu", {**good, "angular_velocity": {"x": 1e300, "y": 0.0, "z": 0.0}}), ("imu", good)]
    values += [("fix", {"latitude": 1e10, "longitude": 139.7}), ("fix", {"latitude": 35.7, "longitude": 139.7})]
    names = {"imu": "/mavros/imu/data", "fix": "/mavros/global_position/raw/fix"}
    entries: list[Entry] = [
        (names[name], kinds[name], START_NS + k * 10**7, {"header": header(START_NS + k * 10**7), **each})
        for k, (name, each) in enumerate(values)
    ]
    report, records, _ = imported(tmp_path, write_bag(tmp_path / "bag", entries))
    assert report.skipped == {"values out of range": 3}  # HIGHRES_IMU and ATTITUDE of the first, the first position
    assert [parse_frame(r.data).get_type() for r in records] == ["HEARTBEAT", "HIGHRES_IMU", "ATTITUDE", "GPS_RAW_INT"]
    assert [r.data[4] for r in records] == [0, 1, 2, 3]  # no sequence number is missing


# ---- mapping


def test_the_guess_takes_what_names_and_types_say(tmp_path: Path):
    imu, image, fix = "sensor_msgs/msg/Imu", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/NavSatFix"
    topics = {
        "/velodyne_points": CLOUD,
        "/velodyne_packets": SCAN,
        "/joint_states": JOINTS,
        "/camera_up/compressed": image,
        "/drone/camera/compressed": image,
        "/odom": "nav_msgs/msg/Odometry",
        "/mavros/global_position/local": "nav_msgs/msg/Odometry",  # by GNSS, not the autopilot's estimate
        "/mavros/local_position/odom": "nav_msgs/msg/Odometry",
        "/imu/data": imu,  # the vehicle's own
        "/mavros/imu/data": imu,
        "/mavros/global_position/global": fix,  # the estimator's, which may be a sent pose
        "/mavros/global_position/raw/fix": fix,
        "/fix": fix,
        "/rosout": "std_msgs/msg/String",
    }
    bag = write_bag(tmp_path / "bag", [(topic, kind, START_NS, {}) for topic, kind in topics.items()])
    info = file_info(bag)
    assert info.mapping is not None
    found = {stream: [use.topic for use in uses] for stream, uses in info.mapping.uses.items()}
    assert found == {
        "/lidar/packets": ["/velodyne_packets"],
        "/servo/state": ["/joint_states"],
        "/camera/vehicle": ["/camera_up/compressed"],
        "/camera/drone": ["/drone/camera/compressed"],
        "/vehicle/odometry": ["/odom"],
        "/autopilot/rx": [
            "/mavros/imu/data",
            "/mavros/global_position/raw/fix",
            "/mavros/local_position/odom",
        ],
    }


def test_the_estimators_global_position_is_not_the_receivers(tmp_path: Path):
    topic = "/mavros/global_position/global"
    entries: list[Entry] = [(topic, "sensor_msgs/msg/NavSatFix", START_NS, {})]
    bag = write_bag(tmp_path / "bag", entries)
    info = file_info(bag)
    assert info.mapping is not None
    assert info.mapping.uses == {}
    assert "estimator" in (text := refused(bag, tmp_path, mapping=mapping(autopilot_rx={"topic": topic})))
    assert "/mavros/global_position/raw/fix" in text


def test_info_writes_the_guess_and_import_takes_it(tmp_path: Path):
    bag, file = write_bag(tmp_path / "flight.bag", scans()), tmp_path / "mapping.yaml"
    result = CliRunner().invoke(app, ["info", str(bag), "--map", str(file)])
    assert result.exit_code == 0, result.output
    assert file.read_text() == "/lidar/packets: {topic: /velodyne_packets}\n"
    result = CliRunner().invoke(app, ["import", str(bag), "--map", str(file)])
    assert result.exit_code == 0, result.output
    assert "152 on /lidar/packets" in result.output
    result = CliRunner().invoke(app, ["import", str(ROOT / "recordings" / "street_sweep.mcap"), "--map", str(file)])
    assert result.exit_code == 2


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("- 1\n", "is no mapping"),
        ("/lidar/packet: {topic: /a}\n", "a bag cannot fill /lidar/packet"),
        ("/lidar/packets: {topik: /a}\n", "topik"),
        ("/lidar/packets: [{topic: /a}, {topic: /b}]\n", "takes one topic, not 2"),
        ("/servo/state: {topic: /a, unit: turns}\n", "unit"),
        ("a: [\n", "is no mapping"),
    ],
)
def test_a_wrong_mapping_is_one_sentence(tmp_path: Path, text: str, says: str):
    file = tmp_path / "mapping.yaml"
    file.write_text(text)
    with pytest.raises(LinkError, match=r"mapping\.yaml") as error:
        read_mapping(file)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_missing_topics_and_wrong_types_are_named(tmp_path: Path):
    bag = write_bag(tmp_path / "bag", [*scans(), ("/talk", STRING, PACKETS[0].arrival_ns, {"data": "hello"})])
    text = refused(bag, tmp_path, mapping=mapping(lidar_packets={"topic": "/velodyne_packet"}))
    assert "no message on topic /velodyne_packet. Did you mean /velodyne_packets?" in text
    text = refused(bag, tmp_path, mapping=mapping(lidar_packets={"topic": "/talk"}))
    assert "cannot be made of /talk, type std_msgs/msg/String" in text
    report, _, _ = imported(tmp_path, bag)
    assert report.skipped == {"messages on /talk (std_msgs/msg/String), which no stream takes": 1}
    only = write_bag(tmp_path / "only", [("/talk", STRING, START_NS, {"data": "hello"})])
    assert "nothing that grd can use: /talk (std_msgs/msg/String)" in refused(only, tmp_path)


def older_bag(folder: Path, kind: str, definitions: dict[str, str], values: dict[str, Any]) -> Path:
    """A ROS 2 bag of before Iron, which stores no definitions: one message of a type that only its writer knows."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import get_types_from_msg

    store = typestore()
    for name, text in definitions.items():
        store.register(get_types_from_msg(text, name))
    with Writer(folder, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/thing", kind, typestore=store)
        writer.write(connection, START_NS, store.serialize_cdr(build(store, kind, values), kind))
    (file,) = folder.glob("*.db3")
    with contextlib.closing(sqlite3.connect(file)) as database, database:
        database.execute("DELETE FROM message_definitions")
    return folder


def test_a_message_type_without_a_definition_is_named(tmp_path: Path):
    kind = "hesai_lidar/msg/PandarScan"
    definitions = {
        "hesai_lidar/msg/PandarPacket": "builtin_interfaces/Time stamp\nuint8[1500] data\nuint32 size\n",
        kind: "std_msgs/Header header\nhesai_lidar/PandarPacket[] packets\n",
    }
    values = scan(START_NS, [(START_NS, PACKETS[0].data)], 1500)
    text = refused(older_bag(tmp_path / "scan", kind, definitions, values), tmp_path)
    assert f"/thing has messages of type {kind}, which the bag does not define" in text
    assert "record it as .mcap" in text
    text = refused(older_bag(tmp_path / "b", "a/msg/Thing", {"a/msg/Thing": "int32 a\n"}, {"a": 1}), tmp_path)
    assert "nothing that grd can use: /thing (a/msg/Thing)" in text
