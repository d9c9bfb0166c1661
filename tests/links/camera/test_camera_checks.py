"""Preflight checks of a camera on images made by hand."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from flow.graph import load_graph
from flow.link import Record
from links.camera import Camera
from links.camera.checks import camera_checks, rig_readout_ms, rig_size_px
from links.preflight.check_result import Level
from links.recording import CompressedImage, encode_compressed_image
from tests.links.preflight.observed import BEGIN_NS, by_name, levels, observe

CONFIGS = Path(__file__).resolve().parents[3] / "configs"


def pictures(size=64, step_ns=50_000_000, count=40):
    jpeg = cv2.imencode(".jpg", np.zeros((size, size), np.uint8))[1].tobytes()
    at_ns = [BEGIN_NS + k * step_ns for k in range(count)]
    return [
        Record("/camera/drone", at, at, encode_compressed_image(CompressedImage(at, "camera_drone", jpeg)))
        for at in at_ns
    ]


def test_a_camera_is_judged_by_its_rate_and_the_rigs_size():
    link = Camera(topic="/camera/drone")
    good = by_name(camera_checks(observe(link, pictures()), (64, 64), 0.0))
    assert {v.level for v in good.values()} == {Level.OK}
    assert "20.0 a second" in good["frames"].sentence
    other = by_name(camera_checks(observe(link, pictures(size=80)), (64, 64), 0.0))["size"]
    assert other.level is Level.FAIL
    assert "80 x 80, but the lens is calibrated for 64 x 64" in other.sentence
    assert levels(camera_checks(observe(link, pictures()), None, 0.0))["size"] == "warning"
    assert levels(camera_checks(observe(link, pictures(step_ns=100_000_000)), (64, 64), 0.0))["frames"] == "warning"
    assert levels(camera_checks(observe(link, pictures(step_ns=2_000_000_000)), (64, 64), 0.0))["frames"] == "fail"


def test_how_long_a_cameras_rows_take_is_asked_for_where_neither_rig_nor_link_says_it():
    link = Camera(topic="/camera/drone")
    silent = by_name(camera_checks(observe(link, pictures()), (64, 64), rig_readout_ms({}, link)))["readout"]
    assert silent.level is Level.WARNING
    assert "set cameras.drone.readout_ms" in silent.sentence
    rig = {"cameras": {"drone": {"readout_ms": 0}, "vehicle": {"readout_ms": 12.5}}}
    assert rig_readout_ms(rig, link) == 0
    assert rig_readout_ms(rig, Camera(topic="/camera/vehicle")) == 12.5
    assert rig_readout_ms({}, Camera(topic="/camera/vehicle", readout_ms=8)) == 8
    told = by_name(camera_checks(observe(link, pictures()), (64, 64), 8.0))["readout"]
    assert (told.level, told.sentence) == (Level.OK, "8 ms from the first row to the last")
    at_once = by_name(camera_checks(observe(link, pictures()), (64, 64), 0.0))["readout"]
    assert (at_once.level, at_once.sentence) == (Level.OK, "all rows at once")


@pytest.mark.parametrize("source", ["/dev/video0", "rtsp://192.168.1.9/live", "http://127.0.0.1:8091/"])
def test_how_old_a_live_cameras_pictures_are_is_asked_for_where_nothing_is_set(source):
    def checked(live=True, **settings):
        link = Camera(topic="/camera/drone", **settings)
        return by_name(camera_checks(observe(link, pictures(), live=live), (64, 64), 0.0))

    unset = checked(source=source)["latency"]
    assert unset.level is Level.WARNING
    assert "film a clock on this host's screen, and set it.latency_s" in unset.sentence
    told = checked(source=source, latency_s=0.06)["latency"]
    assert (told.level, told.sentence) == (Level.OK, "60 ms from a picture's exposure to its arrival")
    assert "latency" not in checked(source=source, live=False)  # a recording's stamps are what they are
    assert "latency" not in checked(source="film.mp4")  # a file's are its own


def test_the_field_configuration_leaves_its_cameras_latency_to_be_set():
    nodes = load_graph(CONFIGS / "field.yaml").nodes
    for name in ("camera_vehicle", "camera_drone"):
        assert nodes[name].config["latency_s"] == 0
        assert levels(camera_checks(observe(nodes[name].build(), pictures()), (64, 64), 0.0))["latency"] == "warning"


def test_a_camera_without_pictures_is_no_go():
    link = Camera(topic="/camera/drone")
    (result,) = camera_checks(observe(link, [], status="there is no /dev/video9"), (64, 64), 0.0)
    assert (result.level, result.sentence) == (Level.FAIL, "there is no /dev/video9")
    (result,) = camera_checks(observe(link, [Record("/camera/drone", 1, 1, b"no picture")]), (64, 64), 0.0)
    assert "1 records came that hold no picture" in result.sentence


def test_the_rigs_size_is_the_links_own_or_that_of_the_camera_of_its_name():
    rig = {"cameras": {"drone": {"size_px": [640, 480]}, "vehicle": {"size_px": 720}}}
    assert rig_size_px(rig, Camera(topic="/camera/drone")) == (640, 480)
    assert rig_size_px(rig, Camera(topic="/camera/vehicle")) == (720, 720)
    assert rig_size_px(rig, Camera(topic="/camera/vehicle", size_px=64)) == (64, 64)
    assert rig_size_px({}, Camera(topic="/camera/vehicle")) is None


def test_a_camera_that_stopped_sending_is_no_go():
    """Its rate, from the first record to the last, is that of a healthy one."""
    later_ns = BEGIN_NS + 5_000_000_000
    found = by_name(camera_checks(observe(Camera(topic="/camera/drone"), pictures(), end_ns=later_ns), (64, 64), 0.0))
    assert found["frames"].level is Level.FAIL
    assert "then none came for 3.1 s" in found["frames"].sentence
    slow = observe(Camera(topic="/camera/drone"), pictures(step_ns=800_000_000, count=7), end_ns=later_ns + 800_000_000)
    assert by_name(camera_checks(slow, (64, 64), 0.0))["frames"].level is not Level.OK
