"""The viewer tap: bounded queue, counted drops, and failures of disk, port or thread that do not stop the run."""

from __future__ import annotations

import dataclasses
import socket
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import synthetic
from pydantic import ValidationError
from rerun.chunk import RrdReader

from flow.link import Run
from flow.message import Message, message
from links.viewer import Viewer
from links.viewer.message_queue import MessageQueue, Slicer, join, thin
from tests.links.ports import free_port


def a_run(folder: Path) -> Run:
    return Run(out_dir=folder, name="test", mermaid=synthetic.MERMAID, settings_yaml=synthetic.SETTINGS)


def rows(rrd: Path) -> dict[str, int]:
    """Rows on the timeline by entity; static data counts 0."""
    found: dict[str, int] = {}
    for chunk in RrdReader(rrd).stream().to_chunks():
        assert chunk.is_static or chunk.timeline_names == ["sensor_time"]
        found[chunk.entity_path] = found.get(chunk.entity_path, 0) + (0 if chunk.is_static else chunk.num_rows)
    return found


@message
class Tick(Message):
    count: int


def ticks(number: int, start_ns: int = 0) -> list[Tick]:
    return [Tick(stamp_ns=start_ns + k * 1_000_000, count=k) for k in range(number)]


def test_a_full_queue_drops_the_oldest_and_counts_it_by_output():
    queue: MessageQueue[int] = MessageQueue(3, lossless=False, timeout_s=1.0)
    for k in range(5):
        queue.put("early" if k < 2 else "late", k)
    assert queue.take() == [("late", 2), ("late", 3), ("late", 4)]
    assert queue.dropped == {"early": 2}


def test_a_lossless_queue_blocks_and_keeps_everything_in_order():
    queue: MessageQueue[int] = MessageQueue(4, lossless=True, timeout_s=10.0)
    got: list[int] = []

    def take_all() -> None:
        while (items := queue.take()) is not None:
            got.extend(item for _, item in items)

    consumer = threading.Thread(target=take_all)
    consumer.start()
    for k in range(500):
        queue.put("x", k)
    queue.close()
    consumer.join(10.0)
    assert got == list(range(500))
    assert not queue.dropped


def test_a_lossless_queue_stops_blocking_for_a_stalled_consumer():
    queue: MessageQueue[int] = MessageQueue(2, lossless=True, timeout_s=0.05)
    for k in range(100):  # waits once, not a hundred times
        queue.put("x", k)
    assert queue.dropped == {"x": 98}
    assert queue.take() == [("x", 98), ("x", 99)]


def test_a_closed_queue_accepts_no_more_and_counts_drops():
    queue: MessageQueue[int] = MessageQueue(2, lossless=True, timeout_s=10.0)
    queue.put("x", 1)
    queue.close()
    queue.put("x", 2)
    assert queue.take() == [("x", 1)]
    assert queue.take() is None
    assert queue.dropped == {"x": 1}


def test_packets_are_joined_to_slices_without_losing_a_pulse():
    packets = [synthetic.packet(k * synthetic.PACKET_S) for k in range(160)]
    slicer = Slicer(0.1)
    ready = [item for _, swept in packets for item in slicer.add("sweep.swept_points", swept)]
    ready += slicer.finish()
    assert len(ready) == 3  # 160 packets are 0.21 s
    assert sum(content.pulses for _, _, content in ready) == 160 * 384
    together = np.concatenate([content.xyz_vehicle_m for _, _, content in ready])
    np.testing.assert_array_equal(together, np.concatenate([swept.xyz_vehicle_m for _, swept in packets]))
    assert [stamp_ns for _, stamp_ns, _ in ready][-1] == packets[-1][1].stamp_ns  # stamp of the last packet


def test_time_that_jumps_back_starts_a_new_slice():
    _, swept = synthetic.packet(0.05)
    earlier = dataclasses.replace(swept, stamp_ns=swept.stamp_ns - 10)
    slicer = Slicer(0.1)
    assert not list(slicer.add("x", swept))
    assert [content.pulses for _, _, content in slicer.add("x", earlier)] == [384]


def test_lost_packets_add_up_in_a_slice():
    firings, _ = synthetic.packet(0.0)
    joined = join([firings, dataclasses.replace(firings, lost_packets=3), dataclasses.replace(firings, lost_packets=2)])
    assert joined.lost_packets == 5
    assert joined.range_m.shape == (3 * 384,)
    assert len(joined.laser_elevation_rad) == 16  # of the lasers, not of the pulses


def test_thinning_keeps_every_lone_return():
    wall = np.random.default_rng(0).uniform([0, 0, 0], [10, 0.01, 5], (50_000, 3))
    drone = np.array([[5.0, -20.0, 15.0], [5.4, -20.0, 15.0]])
    points = np.concatenate([wall, drone, [[np.nan, 0, 0]]]).astype(np.float32)
    keep = thin(points, 4000)
    assert len(keep) <= 4000
    assert {50_000, 50_001} <= set(keep.tolist())
    assert 50_002 not in keep
    np.testing.assert_array_equal(thin(points[:100], 4000), np.arange(100))
    assert thin(np.zeros((0, 3), np.float32), 10).size == 0


def test_every_edge_of_a_run_is_in_the_file_on_sensor_time(tmp_path):
    viewer = Viewer(lossless=True, queue_size=64, mount=synthetic.MOUNT)
    viewer.open(a_run(tmp_path))
    for output, content in synthetic.run(2.75):
        viewer.see(output, content, 0)
    viewer.close()
    assert viewer.errors == {}
    assert viewer.dropped == {}
    found = rows(tmp_path / "run.rrd")
    for entity in (
        "/range/lidar/lidar_firings",
        "/plots/servo/servo/servo_state",
        "/frames/turntable",
        "/frames/lidar",
        "/vehicle/sweep/swept_points/slice_00",
        "/depth/sweep/depth_image",
        "/score/detect/score_image",
        "/vehicle/detect/detections/accepted",
        "/overlays/detect/detections/accepted",
        "/vehicle/track/drone_fix/drone_1/ellipsoid_95",
        "/plots/hits/track/track_state/drone_1",
        "/states/track",
        "/about/graph",
        "/about/settings",
    ):
        assert entity in found, entity
    servo = sum(output == "servo.servo_state" for output, _ in synthetic.run(2.75))
    assert found["/plots/servo/servo/servo_state"] == servo


@pytest.mark.parametrize(("start_ns", "kind"), [(0, "duration"), (1_760_000_000_000_000_000, "timestamp")])
def test_the_timeline_counts_from_1970_or_from_the_start_of_the_run(tmp_path, start_ns, kind):
    viewer = Viewer(lossless=True)
    viewer.open(a_run(tmp_path))
    for tick in ticks(3, start_ns):
        viewer.see("clock.tick", tick, 0)
    viewer.close()
    assert viewer.errors == {}
    (chunk,) = [
        c
        for c in RrdReader(tmp_path / "run.rrd").stream().to_chunks()
        if c.entity_path == "/plots/fields/clock/tick/count" and not c.is_static
    ]
    times = chunk.to_record_batch().column("sensor_time")
    assert str(times.type).startswith(kind)
    assert times.cast("int64").to_pylist() == [start_ns, start_ns + 1_000_000, start_ns + 2_000_000]


def test_dropped_messages_are_counted_and_the_newest_is_drawn(tmp_path):
    viewer = Viewer(queue_size=10)
    viewer.open(a_run(tmp_path))
    for tick in ticks(5000):  # faster than Rerun's first log()
        viewer.see("clock.tick", tick, 0)
    viewer.close()
    dropped = viewer.dropped["clock.tick"]
    found = rows(tmp_path / "run.rrd")
    assert found["/plots/fields/clock/tick/count"] + dropped == 5000
    assert found["/log/viewer"] >= 1  # the recording reports its own gaps


def test_a_message_that_cannot_be_drawn_is_counted_and_the_next_one_is(tmp_path):
    output, content = next(item for item in synthetic.run(2.8) if item[0] == "track.drone_fix")
    viewer = Viewer(lossless=True)
    viewer.open(a_run(tmp_path))
    viewer.see(output, dataclasses.replace(content, covariance_m2=np.full((3, 3), np.nan)), 0)
    viewer.see(output, content, 0)
    viewer.close()
    ((text, count),) = viewer.errors.items()
    assert viewer.status == f"not all is drawn: {text}"
    assert viewer.counters["errors"] == count
    assert text.startswith("track.drone_fix could not be drawn: LinAlgError")
    assert count == 1
    assert rows(tmp_path / "run.rrd")["/vehicle/track/drone_fix/drone_1/ellipsoid_95"] == 1


def test_a_folder_that_cannot_be_written_is_an_error_of_the_viewer_not_of_the_run(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    viewer = Viewer(lossless=True)
    viewer.open(a_run(tmp_path / "file" / "run"))
    for tick in ticks(100):
        viewer.see("clock.tick", tick, 0)
    viewer.close()
    (text,) = viewer.errors
    assert text.startswith(f"cannot write {tmp_path / 'file' / 'run' / 'run.rrd'}: ")


def test_a_full_disk_does_not_stop_the_run(tmp_path):
    """Files of this process may have 300 kB, which is as a full disk: logged once, no hang at the end or at exit."""
    script = f"""
import resource, sys
sys.path[:0] = [{str(Path(__file__).parent)!r}]
import synthetic
from pathlib import Path
from flow.link import Run
from links.viewer import Viewer
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
viewer = Viewer(lossless=True)
viewer.open(Run(Path({str(tmp_path)!r}), "x", "", ""))
for output, content in synthetic.run(1.0):
    viewer.see(output, content, 0)
viewer.close()
sys.stdout.write(repr(list(viewer.errors.items())))
"""
    root = Path(__file__).parents[3]
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=root, capture_output=True, text=True, timeout=60, check=True
    )
    assert "run.rrd is truncated: File too large" in done.stdout
    assert done.stdout.endswith("1)]")
    assert (tmp_path / "run.rrd").stat().st_size == 300_000


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_no_space_left_is_reported_once(tmp_path):
    (tmp_path / "run.rrd").symlink_to("/dev/full")
    viewer = Viewer(lossless=True)
    viewer.open(a_run(tmp_path))
    for output, content in synthetic.run(0.5):
        viewer.see(output, content, 0)
    viewer.close()
    ((text, count),) = viewer.errors.items()
    assert "run.rrd is truncated: No space left on device" in text
    assert count == 1


def test_a_logging_thread_that_dies_does_not_block_the_run(tmp_path, monkeypatch):
    class UnexpectedError(Exception):
        """Not one of `DRAWING_ERRORS`."""

    def broken(*_: object):
        raise UnexpectedError

    monkeypatch.setattr("links.viewer.viewer.draw", broken)
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    viewer = Viewer(lossless=True, queue_size=4)
    viewer.open(a_run(tmp_path))
    for tick in ticks(100):
        viewer.see("clock.tick", tick, 0)
    viewer.close()
    (text,) = viewer.errors
    assert text.startswith("the logging thread died")
    assert viewer.dropped["clock.tick"] > 0


def listeners(port: int) -> set[str]:
    """Addresses (hex, as /proc has them) that listen on a port."""
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            local, _, state = line.split()[1:4]
            address, hex_port = local.split(":")
            if state == "0A" and int(hex_port, 16) == port:
                found.add(address)
    return found


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="reads listening sockets from Linux's /proc")
def test_a_serving_run_listens_on_loopback_only(tmp_path):
    port = free_port(socket.SOCK_STREAM)
    viewer = Viewer(serve=True, port=port, lossless=True)
    viewer.open(a_run(tmp_path))
    for _ in range(100):
        if listeners(port):
            break
        threading.Event().wait(0.05)
    assert listeners(port) == {"0100007F"}
    viewer.see("clock.tick", ticks(1)[0], 0)
    viewer.close()
    assert viewer.errors == {}
    assert rows(tmp_path / "run.rrd")["/plots/fields/clock/tick/count"] == 1  # the file is written as well


def test_a_port_in_use_is_reported_and_the_file_is_written(tmp_path):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        viewer = Viewer(serve=True, port=other.getsockname()[1], lossless=True)
        viewer.open(a_run(tmp_path))
        viewer.see("clock.tick", ticks(1)[0], 0)
        viewer.close()
    (text,) = viewer.errors
    assert text.startswith(f"port {viewer.settings.port} is in use")
    assert rows(tmp_path / "run.rrd")["/plots/fields/clock/tick/count"] == 1


def test_without_file_and_server_nothing_is_drawn(tmp_path, monkeypatch):
    def never(*_: object):
        raise ValueError

    monkeypatch.setattr("links.viewer.viewer.draw", never)
    viewer = Viewer(file=None)
    assert not viewer.wants(type(ticks(1)[0])), "a live run sends it nothing"
    assert Viewer(file=None, serve=True).wants(type(ticks(1)[0]))
    viewer.open(a_run(tmp_path))
    viewer.see("clock.tick", ticks(1)[0], 0)
    viewer.close()
    assert viewer.errors == {}
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "wrong",
    [{"port": 80}, {"queue_size": 0}, {"slice_s": 0}, {"memory_limit": "much"}, {"history_s": -1}, {"host": "0.0.0.0"}],
)
def test_an_impossible_setting_is_rejected(wrong):
    with pytest.raises(ValidationError):
        Viewer(**wrong)
