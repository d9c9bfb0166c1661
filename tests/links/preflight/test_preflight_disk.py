"""Whether a flight's recording fits on the disk, told before the flight."""

from __future__ import annotations

import errno
from types import SimpleNamespace

import pytest

from flow.link import Record, Source
from links.camera import Camera
from links.preflight import Level
from links.preflight.disk import disk_check, existing, rate_gb_h
from links.preflight.heard import AllHeard, Heard
from links.preflight.seen import Seen
from links.recording import Recorder
from links.velodyne import Lidar

LIDAR, CAMERA = Lidar(), Camera(topic="/camera/drone")


def heard_of(link: Source, name: str, size: int = 0, rate_hz: float = 10.0, count: int = 0) -> Heard:
    seen = Seen(link.topic)
    for number in range(count):
        at_ns = round(1e9 * number / rate_hz)
        seen.take(Record(link.topic, at_ns, at_ns, bytes(size)))
    return Heard(name, link, seen, {}, None, 0, live=True)


def all_heard(*heard: Heard) -> AllHeard:
    return AllHeard(heard, {}, live=True)


BOTH = all_heard(heard_of(LIDAR, "lidar"), heard_of(CAMERA, "camera_drone"))


@pytest.fixture
def free(monkeypatch):
    """Set how much is free."""

    def set_free(count: float) -> None:
        monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=count))

    return set_free


def test_what_comes_from_a_source_tells_how_much_it_takes():
    lidar = heard_of(LIDAR, "lidar", size=1206, rate_hz=754, count=1509)
    assert rate_gb_h(lidar) == pytest.approx(0.43 * 1206 * 754 * 3600 / 1e9)
    assert rate_gb_h(lidar) == pytest.approx(1.4, abs=0.02)
    camera = heard_of(CAMERA, "camera_drone", size=100_000, rate_hz=20, count=41)
    assert rate_gb_h(camera) == pytest.approx(100_000 * 20 * 3600 / 1e9)


@pytest.mark.parametrize("count", [0, 1])
def test_a_source_that_was_not_heard_is_taken_as_the_usual_one(count):
    assert rate_gb_h(heard_of(LIDAR, "lidar", 1206, count=count)) == 1.4
    assert rate_gb_h(heard_of(CAMERA, "camera_drone", 9, count=count)) == 5.0


def test_less_than_the_recorder_leaves_free_is_no_go(free, tmp_path):
    free(199e6)
    verdict = disk_check(Recorder(), BOTH, tmp_path)
    assert verdict.level is Level.FAIL
    assert verdict.sentence == (
        f"199 MB free at {tmp_path}, and the recorder leaves 200 MB free (reserve_mb): nothing would be recorded; "
        "make room, or give another disk with --out"
    )
    free(250e6)
    assert disk_check(Recorder(reserve_mb=300), BOTH, tmp_path).level is Level.FAIL
    assert disk_check(Recorder(), BOTH, tmp_path).level is Level.WARNING


def test_less_than_an_hour_takes_is_to_look_at_with_the_rate_and_the_minutes(free, tmp_path):
    free(3.4e9)
    verdict = disk_check(Recorder(), BOTH, tmp_path)
    assert verdict.level is Level.WARNING
    assert verdict.sentence == (
        f"3.4 GB free at {tmp_path}; a flight takes 6.4 GB an hour (lidar 1.4, camera_drone 5.0), so it is full after "
        "30 min: make room, or give another disk with --out"
    )
    free(6.59e9)
    assert disk_check(Recorder(), BOTH, tmp_path).level is Level.WARNING


def test_room_for_an_hour_is_right_and_says_for_how_long(free, tmp_path):
    free(6.61e9)
    assert disk_check(Recorder(), BOTH, tmp_path).level is Level.OK
    free(13e9)
    assert disk_check(Recorder(), BOTH, tmp_path).sentence.endswith("(lidar 1.4, camera_drone 5.0), so it lasts 2.0 h")
    free(1e9)
    assert disk_check(Recorder(), all_heard(), tmp_path).level is Level.OK


def test_the_disk_is_that_of_the_folder_to_be_made(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr("shutil.disk_usage", lambda folder: asked.append(folder) or SimpleNamespace(free=1e12))
    disk_check(Recorder(), BOTH, tmp_path / "out" / "flight")
    assert asked == [tmp_path]
    monkeypatch.chdir(tmp_path)
    assert existing(asked[0] / "..") == tmp_path / ".."


def test_a_disk_that_is_gone_is_no_go(monkeypatch, tmp_path):
    def gone(folder):
        raise OSError(errno.ESTALE, "Stale file handle")

    monkeypatch.setattr("shutil.disk_usage", gone)
    verdict = disk_check(Recorder(), BOTH, tmp_path)
    assert verdict.level is Level.FAIL
    assert "Stale file handle: is the disk there?" in verdict.sentence
