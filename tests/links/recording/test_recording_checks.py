"""Whether a flight's recording fits on the disk, told before the flight."""

from __future__ import annotations

import errno
from types import SimpleNamespace

import pytest

from flow.link import Record, Source
from links.camera import Camera
from links.preflight.check_result import Level
from links.preflight.devices import checks_for
from links.preflight.observations import Observations, ObservedSource
from links.recording import Recorder
from links.recording.checks import disk_check, existing
from links.velodyne import Lidar

LIDAR, CAMERA = Lidar(), Camera(topic="/camera/drone")


def observed(link: Source, name: str, size: int = 0, rate_hz: float = 10.0, count: int = 0) -> ObservedSource:
    observation = checks_for(link).observation(link)
    for number in range(count):
        at_ns = round(1e9 * number / rate_hz)
        observation.add(Record(link.topic, at_ns, at_ns, bytes(size)))
    return ObservedSource(name, link, observation, {}, None, 0, live=True)


def observations(*sources: ObservedSource) -> Observations:
    return Observations(sources, {}, live=True)


BOTH = observations(observed(LIDAR, "lidar"), observed(CAMERA, "camera_drone"))


@pytest.fixture
def free(monkeypatch):
    """Set how much is free."""

    def set_free(count: float) -> None:
        monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=count))

    return set_free


def test_what_comes_from_a_source_tells_how_much_it_takes():
    lidar = observed(LIDAR, "lidar", size=1206, rate_hz=754, count=1509)
    assert lidar.observation.recorded_gb_per_hour == pytest.approx(0.43 * 1206 * 754 * 3600 / 1e9)
    assert lidar.observation.recorded_gb_per_hour == pytest.approx(1.4, abs=0.02)
    camera = observed(CAMERA, "camera_drone", size=100_000, rate_hz=20, count=41)
    assert camera.observation.recorded_gb_per_hour == pytest.approx(100_000 * 20 * 3600 / 1e9)


@pytest.mark.parametrize("count", [0, 1])
def test_a_source_that_was_not_heard_is_taken_as_the_usual_one(count):
    assert observed(LIDAR, "lidar", 1206, count=count).observation.recorded_gb_per_hour == 1.4
    assert observed(CAMERA, "camera_drone", 9, count=count).observation.recorded_gb_per_hour == 5.0


def test_less_than_the_recorder_leaves_free_is_no_go(free, tmp_path):
    free(199e6)
    result = disk_check(Recorder(), BOTH, tmp_path)
    assert result.level is Level.FAIL
    assert result.sentence == (
        f"199 MB free at {tmp_path}, and the recorder leaves 200 MB free (reserve_mb): nothing would be recorded; "
        "make room, or give another disk with --out"
    )
    free(250e6)
    assert disk_check(Recorder(reserve_mb=300), BOTH, tmp_path).level is Level.FAIL
    assert disk_check(Recorder(), BOTH, tmp_path).level is Level.WARNING


def test_less_than_an_hour_takes_is_to_look_at_with_the_rate_and_the_minutes(free, tmp_path):
    free(3.4e9)
    result = disk_check(Recorder(), BOTH, tmp_path)
    assert result.level is Level.WARNING
    assert result.sentence == (
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
    assert disk_check(Recorder(), observations(), tmp_path).level is Level.OK


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
    result = disk_check(Recorder(), BOTH, tmp_path)
    assert result.level is Level.FAIL
    assert "Stale file handle: is the disk there?" in result.sentence
