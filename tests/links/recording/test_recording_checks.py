"""Preflight check of the free disk space for a recording."""

from __future__ import annotations

import errno
from types import SimpleNamespace

import pytest

from flow.link import Record, Source
from links.camera import Camera
from links.lidar import Lidar
from links.preflight.check_result import Level
from links.preflight.devices import checks_for
from links.preflight.observations import Observations, ObservedSource
from links.recording import Recorder
from links.recording.checks import disk_check, existing

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
    """Set the free disk space."""

    def set_free(count: float) -> None:
        monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=count))

    return set_free


def test_the_recorded_rate_follows_from_the_received_data():
    lidar = observed(LIDAR, "lidar", size=1206, rate_hz=754, count=1509)
    assert lidar.observation.recorded_gb_per_hour == pytest.approx(0.43 * 1206 * 754 * 3600 / 1e9)
    assert lidar.observation.recorded_gb_per_hour == pytest.approx(1.4, abs=0.02)
    camera = observed(CAMERA, "camera_drone", size=100_000, rate_hz=20, count=41)
    assert camera.observation.recorded_gb_per_hour == pytest.approx(100_000 * 20 * 3600 / 1e9)


@pytest.mark.parametrize("count", [0, 1])
def test_a_silent_source_has_the_default_rate(count):
    assert observed(LIDAR, "lidar", 1206, count=count).observation.recorded_gb_per_hour == 1.4
    assert observed(CAMERA, "camera_drone", 9, count=count).observation.recorded_gb_per_hour == 5.0


def test_less_than_the_recorders_reserve_fails(free, tmp_path):
    free(199e6)
    result = disk_check(Recorder(), BOTH, tmp_path)
    assert result.level is Level.FAIL
    assert result.sentence == (
        f"199 MB free at {tmp_path}, and the recorder keeps 200 MB free (reserve_mb): nothing will be recorded; "
        "free some space, or choose another disk with --out"
    )
    free(250e6)
    assert disk_check(Recorder(reserve_mb=300), BOTH, tmp_path).level is Level.FAIL
    assert disk_check(Recorder(), BOTH, tmp_path).level is Level.WARNING


def test_less_than_one_hour_is_a_warning_with_the_rate_and_the_minutes(free, tmp_path):
    free(3.4e9)
    result = disk_check(Recorder(), BOTH, tmp_path)
    assert result.level is Level.WARNING
    assert result.sentence == (
        f"3.4 GB free at {tmp_path}; a flight needs 6.4 GB/h (lidar 1.4, camera_drone 5.0), so it is full after "
        "30 min: free some space, or choose another disk with --out"
    )
    free(6.59e9)
    assert disk_check(Recorder(), BOTH, tmp_path).level is Level.WARNING


def test_space_for_one_hour_passes_with_the_duration(free, tmp_path):
    free(6.61e9)
    assert disk_check(Recorder(), BOTH, tmp_path).level is Level.OK
    free(13e9)
    assert disk_check(Recorder(), BOTH, tmp_path).sentence.endswith("(lidar 1.4, camera_drone 5.0), enough for 2.0 h")
    free(1e9)
    assert disk_check(Recorder(), observations(), tmp_path).level is Level.OK


def test_the_disk_is_that_of_the_future_folder(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr("shutil.disk_usage", lambda folder: asked.append(folder) or SimpleNamespace(free=1e12))
    disk_check(Recorder(), BOTH, tmp_path / "out" / "flight")
    assert asked == [tmp_path]
    monkeypatch.chdir(tmp_path)
    assert existing(asked[0] / "..") == tmp_path / ".."


def test_a_missing_disk_fails(monkeypatch, tmp_path):
    def gone(folder):
        raise OSError(errno.ESTALE, "Stale file handle")

    monkeypatch.setattr("shutil.disk_usage", gone)
    result = disk_check(Recorder(), BOTH, tmp_path)
    assert result.level is Level.FAIL
    assert "Stale file handle: is the disk mounted?" in result.sentence
