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


def images(size=64, step_ns=50_000_000, count=40):
    jpeg = cv2.imencode(".jpg", np.zeros((size, size), np.uint8))[1].tobytes()
    at_ns = [BEGIN_NS + k * step_ns for k in range(count)]
    return [
        Record("/camera/drone", at, at, encode_compressed_image(CompressedImage(at, "camera_drone", jpeg)))
        for at in at_ns
    ]


def test_a_camera_is_checked_by_its_rate_and_the_rigs_size():
    link = Camera(topic="/camera/drone")
    good = by_name(camera_checks(observe(link, images()), (64, 64), 0.0))
    assert {v.level for v in good.values()} == {Level.OK}
    assert "20.0 frames/s" in good["frames"].sentence
    other = by_name(camera_checks(observe(link, images(size=80)), (64, 64), 0.0))["size"]
    assert other.level is Level.FAIL
    assert "80 x 80, but the lens is calibrated for 64 x 64" in other.sentence
    assert levels(camera_checks(observe(link, images()), None, 0.0))["size"] == "warning"
    assert levels(camera_checks(observe(link, images(step_ns=100_000_000)), (64, 64), 0.0))["frames"] == "warning"
    assert levels(camera_checks(observe(link, images(step_ns=2_000_000_000)), (64, 64), 0.0))["frames"] == "fail"


def test_a_missing_readout_time_is_a_warning():
    link = Camera(topic="/camera/drone")
    unset = by_name(camera_checks(observe(link, images()), (64, 64), rig_readout_ms({}, link)))["readout"]
    assert unset.level is Level.WARNING
    assert "set cameras.drone.readout_ms" in unset.sentence
    rig = {"cameras": {"drone": {"readout_ms": 0}, "vehicle": {"readout_ms": 12.5}}}
    assert rig_readout_ms(rig, link) == 0
    assert rig_readout_ms(rig, Camera(topic="/camera/vehicle")) == 12.5
    assert rig_readout_ms({}, Camera(topic="/camera/vehicle", readout_ms=8)) == 8
    rolling = by_name(camera_checks(observe(link, images()), (64, 64), 8.0))["readout"]
    assert (rolling.level, rolling.sentence) == (Level.OK, "8 ms from the first row to the last")
    global_shutter = by_name(camera_checks(observe(link, images()), (64, 64), 0.0))["readout"]
    assert (global_shutter.level, global_shutter.sentence) == (Level.OK, "global shutter")


@pytest.mark.parametrize("source", ["/dev/video0", "rtsp://192.168.1.9/live", "http://127.0.0.1:8091/"])
def test_a_missing_latency_of_a_live_camera_is_a_warning(source):
    def checked(live=True, **settings):
        link = Camera(topic="/camera/drone", **settings)
        return by_name(camera_checks(observe(link, images(), live=live), (64, 64), 0.0))

    unset = checked(source=source)["latency"]
    assert unset.level is Level.WARNING
    assert "film a clock on this host's screen, and set it.latency_s" in unset.sentence
    measured = checked(source=source, latency_s=0.06)["latency"]
    assert (measured.level, measured.sentence) == (Level.OK, "60 ms from exposure to reception")
    assert "latency" not in checked(source=source, live=False)  # a recording's stamps are final
    assert "latency" not in checked(source="film.mp4")  # a file has its own time stamps


def test_the_field_configuration_has_no_camera_latency_set():
    nodes = load_graph(CONFIGS / "field.yaml").nodes
    for name in ("camera_vehicle", "camera_drone"):
        assert nodes[name].config["latency_s"] == 0
        assert levels(camera_checks(observe(nodes[name].build(), images(size=720)), None, 0.0))["latency"] == "warning"


def test_a_camera_without_images_fails():
    link = Camera(topic="/camera/drone")
    (result,) = camera_checks(observe(link, [], status="there is no /dev/video9"), (64, 64), 0.0)
    assert (result.level, result.sentence) == (Level.FAIL, "there is no /dev/video9")
    (result,) = camera_checks(observe(link, [Record("/camera/drone", 1, 1, b"no image")]), (64, 64), 0.0)
    assert "1 records without an image arrived" in result.sentence


def test_the_calibrated_size_is_the_links_own_or_that_of_the_rigs_camera():
    rig = {"cameras": {"drone": {"size_px": [640, 480]}, "vehicle": {"size_px": 720}}}
    assert rig_size_px(rig, Camera(topic="/camera/drone")) == (640, 480)
    assert rig_size_px(rig, Camera(topic="/camera/vehicle")) == (720, 720)
    assert rig_size_px(rig, Camera(topic="/camera/vehicle", size_px=64)) == (64, 64)
    assert rig_size_px({}, Camera(topic="/camera/vehicle")) is None


def test_a_camera_that_stopped_sending_fails():
    """Its rate, from the first record to the last, is that of a healthy one."""
    later_ns = BEGIN_NS + 5_000_000_000
    found = by_name(camera_checks(observe(Camera(topic="/camera/drone"), images(), end_ns=later_ns), (64, 64), 0.0))
    assert found["frames"].level is Level.FAIL
    assert "then none for 3.1 s" in found["frames"].sentence
    slow = observe(Camera(topic="/camera/drone"), images(step_ns=800_000_000, count=7), end_ns=later_ns + 800_000_000)
    assert by_name(camera_checks(slow, (64, 64), 0.0))["frames"].level is not Level.OK
