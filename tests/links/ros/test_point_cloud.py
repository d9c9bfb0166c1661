"""Point clouds as packets: every point of every model comes back, sky stays sky, and unfit clouds are refused."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from bag_files import build, cloud, joined, write_bag
from numpy.testing import assert_allclose

from flow.link import LinkError, Record
from links.importing import import_file
from links.importing.imported_file import DEFAULT_RIG
from links.lidar import Lidar, ouster_beams, rig_unit
from links.recording import RecordingReader
from links.ros.message_types import typestore
from links.ros.point_cloud import CloudEncoder
from stages.geometry.rig_lidar import RigLidar
from stages.messages import LidarFirings

ROOT = Path(__file__).resolve().parents[3]
OTHER = ROOT.parent / "shared" / "data" / "lidar_other"
VLP16 = ROOT / "recordings" / "einride_vlp16.mcap"
CLOUD = "sensor_msgs/msg/PointCloud2"
STORE = typestore()
needs_shared_data = pytest.mark.skipif(not OTHER.is_dir(), reason="the shared data are not here")


def decoded(records: Any, unit: RigLidar) -> list[LidarFirings]:
    lidar = Lidar(unit=unit, slice_ms=0.1)
    firings = [m for r in records if (m := lidar.decode(r)) is not None]
    assert lidar.counters["lost"] == 0
    return firings


def points_of(path: Path, count: int | None = None) -> tuple[RigLidar, SimpleNamespace]:
    """The first return of each pulse in a recording."""
    with RecordingReader(path) as reader:
        assert reader.rig_yaml is not None
        unit = rig_unit(reader.rig_yaml, str(path))
        return unit, joined(decoded(list(reader.records(["/lidar/packets"]))[:count], unit))


def clouds(points: SimpleNamespace, unit: RigLidar, cut_ns: int = 100_000_000, **changes: Any) -> list[Any]:
    """(stamp, PointCloud2) as the model's driver would publish them, cut at fixed times."""
    profile = unit.profile
    xyz, ring = points.xyz_lidar_m.astype(np.float32), points.laser
    velodyne = profile.product_id is not None
    if velodyne:
        xyz = np.stack([xyz[:, 1], -xyz[:, 0], xyz[:, 2]], axis=1)
        ring = np.argsort(np.argsort(profile.elevation_deg))[points.laser]
    start_ns = points.pulse_stamp_ns[0]
    part = (points.pulse_stamp_ns - start_ns) // cut_ns
    out = []
    for k in np.unique(part):
        s = part == k
        stamp_ns = int(points.pulse_stamp_ns[s][0])
        since_ns = points.pulse_stamp_ns[s] - stamp_ns
        if velodyne:
            time: dict[str, Any] = {"time": (since_ns * 1e-9).astype(np.float32)}
        elif profile.model.startswith("OS"):
            time = {"t": since_ns.astype(np.uint32)}
        else:
            time = {"timestamp": points.pulse_stamp_ns[s] * 1e-9}
        columns = {
            "x": xyz[s, 0],
            "y": xyz[s, 1],
            "z": xyz[s, 2],
            "intensity": points.reflectivity[s].astype(np.float32),
            "ring": ring[s].astype(np.uint16),
            **time,
        }
        columns |= {name: value[s] for name, value in changes.items()}
        out.append((stamp_ns, build(STORE, CLOUD, cloud(stamp_ns, columns))))
    return out


def encoded(messages: list[Any], unit: RigLidar, axes: Any = None) -> list[Record]:
    encoder = CloudEncoder(unit, axes, "/points")
    packets = [p for stamp_ns, message in messages for p in encoder.packets(message, stamp_ns)]
    return [Record("/lidar/packets", at_ns, at_ns, data) for at_ns, data in packets]


def compare(before: SimpleNamespace, after: SimpleNamespace, within_ns: int) -> Any:
    """(share of points found again, distances [m], differences of range [m])."""
    start_ns = before.pulse_stamp_ns[0]
    keys = [p.laser.astype(np.int64) * 10**13 + p.pulse_stamp_ns - start_ns for p in (before, after)]
    order = np.argsort(keys[1])
    at = np.clip(np.searchsorted(keys[1][order], keys[0]), 1, len(order) - 1)
    left, right = order[at - 1], order[at]
    nearest = np.where(np.abs(keys[1][left] - keys[0]) < np.abs(keys[1][right] - keys[0]), left, right)
    found = np.abs(keys[1][nearest] - keys[0]) < within_ns
    distance = np.linalg.norm(before.xyz_lidar_m - after.xyz_lidar_m[nearest], axis=1)[found]
    return found.mean(), distance, np.abs(before.range_m - after.range_m[nearest])[found], nearest, found


def test_every_point_of_a_real_vlp_16_comes_back():
    unit, before = points_of(VLP16)
    records = encoded(clouds(before, unit), unit)
    after = joined(decoded(records, unit))
    share, distance, ranges, nearest, found = compare(before, after, 2_000)
    assert share > 0.998  # the last, unfinished packet is left out
    assert ranges.max() < 1e-6
    assert distance.max() < 0.001
    assert (before.reflectivity[found] == after.reflectivity[nearest[found]]).all()
    assert len(after.laser) <= len(before.laser)


@needs_shared_data
def test_every_point_of_a_real_xt16_comes_back(tmp_path: Path):
    report = import_file(OTHER / "hesai_xt16.db3", tmp_path / "xt16.mcap")
    unit, before = points_of(report.path)
    share, distance, ranges, *_ = compare(before, joined(decoded(encoded(clouds(before, unit), unit), unit)), 30_000)
    assert share > 0.997
    assert np.mean(ranges < 1e-5) > 0.999  # at its start the host's clock is adjusted: two sequences at one time
    assert np.mean(distance < 0.005) > 0.999


@needs_shared_data
def test_every_point_of_a_real_ouster_comes_back(tmp_path: Path):
    name = "OS-1-32-G_v2.1.1_1024x10"
    model, beams = ouster_beams((OTHER / f"{name}.json").read_text(), name)
    rig = yaml.safe_load(DEFAULT_RIG.format(model=model))
    rig["lidar"] |= {"model": model, "beams": beams.model_dump(mode="json")}
    report = import_file(OTHER / f"{name}.pcap", tmp_path / "os1.mcap", rig_yaml=yaml.safe_dump(rig))
    unit, before = points_of(report.path)
    after = joined(decoded(encoded(clouds(before, unit, 30_000_000), unit), unit))
    share, distance, *_ = compare(before, after, 50_000)
    assert share > 0.98  # a packet of 64
    assert distance.max() < 1e-4


def test_pulses_without_return_stay_between_the_points_and_between_clouds():
    unit, points = points_of(VLP16, 400)
    phase = (points.pulse_stamp_ns - points.pulse_stamp_ns[0]) % 100_000_000
    sky = (phase > 30_000_000) & (phase < 55_000_000) | (phase > 90_000_000)  # also over the end of each cloud
    seen = SimpleNamespace(**{name: values[~sky] for name, values in vars(points).items()})
    firings = decoded(encoded(clouds(seen, unit), unit), unit)
    stamps = np.concatenate([f.pulse_stamp_ns for f in firings])
    ranges = np.concatenate([f.range_m for f in firings])
    assert_allclose(np.diff(stamps[::16]), 55_296, atol=5_000)  # no sequence is missing
    late = (stamps - points.pulse_stamp_ns[0]) % 100_000_000
    empty = (late > 31_000_000) & (late < 54_000_000) | (late > 91_000_000) & (late < 99_000_000)
    assert ranges[empty].max() == 0
    azimuths = np.concatenate([f.azimuth_rad for f in firings])
    assert_allclose(np.diff(np.unwrap(azimuths[::16])), np.radians(0.199), atol=np.radians(0.12))


def test_a_long_gap_is_lost_packets_not_sky():
    unit, points = points_of(VLP16, 600)
    since_ns = points.pulse_stamp_ns - points.pulse_stamp_ns[0]
    kept = (since_ns < 300_000_000) | (since_ns > 500_000_000)
    seen = SimpleNamespace(**{name: values[kept] for name, values in vars(points).items()})
    records = encoded(clouds(seen, unit), unit)
    assert np.diff([r.stamp_ns for r in records]).max() > 190_000_000


def test_the_axes_of_a_cloud_can_be_the_sensors():
    unit, before = points_of(VLP16, 100)
    xyz = before.xyz_lidar_m.astype(np.float32)
    messages = clouds(before, unit, x=xyz[:, 0], y=xyz[:, 1])
    after = joined(decoded(encoded(messages, unit, "sensor"), unit))
    share, distance, *_ = compare(before, after, 2_000)
    assert share > 0.98
    assert distance.max() < 0.001


def test_a_cloud_without_times_or_rings_is_refused():
    unit, points = points_of(VLP16, 20)
    n = len(points.laser)
    xyz = {name: points.xyz_lidar_m[:, k] for k, name in enumerate("xyz")}
    for columns, says in (
        ({**xyz, "ring": points.laser}, "its points have no time (fields: x, y, z, ring)"),
        ({**xyz, "time": np.zeros(n, np.float32)}, "its points have no ring (fields: x, y, z, time)"),
        ({"x": xyz["x"], "ring": points.laser, "time": np.zeros(n, np.float32)}, "its points have no y, z (fields"),
        (
            {**xyz, "ring": points.laser, "time": np.zeros(n, np.float32)},
            "all points of a cloud have the same time: the drone would be smeared",
        ),
    ):
        with pytest.raises(LinkError) as error:
            encoded([(0, build(STORE, CLOUD, cloud(0, columns)))], unit)
        assert says in str(error.value)


def test_another_model_and_a_compensated_cloud_are_refused():
    unit, points = points_of(VLP16, 200)
    messages = clouds(points, unit)
    with pytest.raises(LinkError, match=r"of the points are not on their beam.*the rig's LiDAR is a Puck Hi-Res"):
        encoded(messages, RigLidar(model="Puck Hi-Res"))
    with pytest.raises(LinkError, match=r"rings 3 to 31.*the rig's LiDAR is a VLP-16"):
        encoded(clouds(points, unit, ring=(2 * points.laser + 1).astype(np.uint16) % 32 * (points.laser > 0)), unit)
    turned = np.random.default_rng(2).uniform(-0.1, 0.1, len(points.laser))
    x, y = points.xyz_lidar_m[:, 1], -points.xyz_lidar_m[:, 0]
    moved = {"x": np.cos(turned) * x - np.sin(turned) * y, "y": np.sin(turned) * x + np.cos(turned) * y}
    with pytest.raises(LinkError, match=r"do not turn steadily.*motion-compensated"):
        encoded(clouds(points, unit, **{k: v.astype(np.float32) for k, v in moved.items()}), unit)


def test_a_damaged_time_in_a_cloud_is_refused_before_memory_is_allocated():
    unit, points = points_of(VLP16, 40)
    for damaged_s in (3.0, 1e9, -1e30):
        ((stamp_ns, message),) = clouds(points, unit)
        message.data = message.data.copy()
        table = message.data.reshape(-1, message.point_step)
        (time,) = [field for field in message.fields if field.name == "time"]
        table[7, time.offset : time.offset + 4] = np.frombuffer(np.float32(damaged_s).tobytes(), np.uint8)
        with pytest.raises(
            LinkError, match=r"/points: the times of the points in one cloud span .* s: .* mapping file"
        ):
            encoded([(stamp_ns, message)], unit)


def test_the_order_of_the_rings_is_decided_once_and_clouds_before_are_skipped():
    """The first cloud has too few points, the third only near ones: neither shows the order."""
    unit, before = points_of(VLP16, 400)
    phase = (before.pulse_stamp_ns - before.pulse_stamp_ns[0]) // 100_000_000
    keep = (phase > 0) | (np.cumsum(phase == 0) <= 20)
    points = SimpleNamespace(**{name: values[keep] for name, values in vars(before).items()})
    near = phase[keep] == 2
    rho = np.hypot(points.xyz_lidar_m[:, 0], points.xyz_lidar_m[:, 1])
    points.xyz_lidar_m = points.xyz_lidar_m * np.where(near, 1.0 / rho, 1.0)[:, None]
    encoder = CloudEncoder(unit, None, "/points")
    packets = [p for stamp_ns, message in clouds(points, unit) for p in encoder.packets(message, stamp_ns)]
    assert encoder.clouds_without_order == 1
    after = joined(decoded([Record("/lidar/packets", at_ns, at_ns, data) for at_ns, data in packets], unit))
    later = SimpleNamespace(**{name: values[phase[keep] > 0] for name, values in vars(points).items()})
    share, *_ = compare(later, after, 2_000)
    assert share > 0.99
    assert len(after.laser) <= len(later.laser)


def test_a_bag_whose_clouds_never_show_the_order_of_their_rings_is_refused_with_advice(tmp_path: Path):
    unit, points = points_of(VLP16, 4)
    ((at_ns, message),) = clouds(SimpleNamespace(**{n: v[:20] for n, v in vars(points).items()}), unit)
    bag = write_bag(tmp_path / "bag", [("/velodyne_points", CLOUD, at_ns + 10**8, vars_of(message))])
    with pytest.raises(LinkError, match=r"no cloud shows the order of its rings.*import the LiDAR's packets"):
        import_file(bag, tmp_path / "out.mcap", rig_yaml=DEFAULT_RIG.format(model="VLP-16"))


def test_points_in_a_bag_need_a_rig_and_become_packets(tmp_path: Path):
    unit, points = points_of(VLP16, 300)
    entries = [("/velodyne_points", CLOUD, at_ns + 10**8, vars_of(message)) for at_ns, message in clouds(points, unit)]
    bag = write_bag(tmp_path / "bag", entries)
    with pytest.raises(LinkError, match="do not name their LiDAR: give its rig with --rig"):
        import_file(bag, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()
    report = import_file(bag, tmp_path / "out.mcap", rig_yaml=DEFAULT_RIG.format(model="VLP-16"))
    with RecordingReader(report.path) as reader:
        records = list(reader.records())
    assert {r.arrival_ns - r.stamp_ns for r in records} == {24 * 55_296 + 101_760}  # when the last pulse has fired
    share, *_ = compare(points, joined(decoded(records, unit)), 2_000)
    assert share > 0.99


def vars_of(message: Any) -> dict[str, Any]:
    """A built PointCloud2 as plain values."""
    fields = [{"name": f.name, "offset": f.offset, "datatype": f.datatype, "count": f.count} for f in message.fields]
    stamp = {"sec": message.header.stamp.sec, "nanosec": message.header.stamp.nanosec}
    names = ("height", "width", "point_step", "row_step", "data")
    return {"header": {"stamp": stamp}, "fields": fields, **{name: getattr(message, name) for name in names}}
