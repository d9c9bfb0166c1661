"""V4L2 webcams, which CI does not have: a fake of OpenCV's V4L2 capture that follows its source code.

A driver without the requested format or size selects another one. An unconverted image is the used part of a buffer, one
row of bytes.

Source: OpenCV, modules/videoio/src/cap_v4l.cpp (setProperty, autosetup_capture_mode_v4l2, retrieveFrame).
"""

from __future__ import annotations

import time
from collections import Counter

import cv2
import numpy as np
import pytest

from flow.link import LinkError
from links.camera import Camera
from links.camera.capture import MAX_DAMAGED, Capture, CaptureLost, CaptureSettings
from links.clock import host_time
from links.recording import decode_compressed_image

DEVICE = "/dev/null"  # a device that exists
PERIOD_NS = 20_000_000
CODING_NS = 15_000_000  # to decode an image from the buffer


class Webcam:
    """The plugged-in camera: its formats, its only size, the padding of its buffers, and its clock."""

    def __init__(self, formats=("MJPG", "YUYV"), size_px=(64, 48), padding=b"", real_time=False, takes_rate=True):
        self.takes_rate = takes_rate
        self.formats, self.size_px, self.padding, self.plugged = formats, size_px, padding, True
        self.opened, self.number, self.damaged, self._now_ns = [], 0, set(), None if real_time else 0

    def now_ns(self):
        return host_time.now_ns() if self._now_ns is None else self._now_ns

    def wait(self, ns):
        if self._now_ns is None:
            time.sleep(1e-9 * ns)
        else:
            self._now_ns += ns

    def image(self, number):
        return np.full((self.size_px[1], self.size_px[0], 3), number % 250, np.uint8)

    def jpeg(self, number):
        whole = cv2.imencode(".jpg", self.image(number))[1].tobytes()
        return whole[:-40] if number in self.damaged else whole


class Video:
    """cv2.VideoCapture of a Webcam."""

    def __init__(self, webcam, source, api, asked):
        assert (source, api) == (DEVICE, cv2.CAP_V4L2)
        self.asked = dict(zip(asked[::2], asked[1::2], strict=True))
        self._webcam = webcam
        self._open = webcam.plugged and (webcam.takes_rate or cv2.CAP_PROP_FPS not in self.asked)
        webcam.opened.append(self)
        wanted = int(self.asked[cv2.CAP_PROP_FOURCC]).to_bytes(4, "little").decode()
        self._format = wanted if wanted in webcam.formats else webcam.formats[-1]
        self._raw = self.asked.get(cv2.CAP_PROP_CONVERT_RGB) == 0

    def isOpened(self):
        return self._open

    def release(self):
        self._open = False

    def get(self, key):
        assert key == cv2.CAP_PROP_FOURCC
        return float(cv2.VideoWriter.fourcc(*self._format))

    def grab(self):
        assert self._open
        self._webcam.wait(PERIOD_NS)
        self._webcam.number += 1
        return self._webcam.plugged

    def retrieve(self):
        webcam = self._webcam
        webcam.wait(CODING_NS if not self._raw else 0)
        if not self._raw:
            return True, webcam.image(webcam.number)
        assert self._format == "MJPG", "an unconverted image in another format is no JPEG"
        return True, np.frombuffer(webcam.jpeg(webcam.number) + webcam.padding, np.uint8)[None]


def plug_in(monkeypatch, **what):
    webcam = Webcam(**what)
    monkeypatch.setattr(cv2, "VideoCapture", lambda *a: Video(webcam, *a))
    return webcam


def capture_of(webcam, counters=None, size_px=(64, 48)):
    settings = CaptureSettings(DEVICE, size_px, 1e9 / PERIOD_NS, 1.0, 90)
    return Capture(settings, webcam.now_ns, Counter() if counters is None else counters)


def camera_of(size_px=(64, 48)):
    return Camera(topic="/camera/vehicle", source=DEVICE, size_px=size_px, fps=1e9 / PERIOD_NS, latency_s=0.05)


@pytest.mark.parametrize("padding", [b"", b"\0" * 500, b"\0" * 7 + b"old bytes"])
def test_mjpg_is_passed_through_without_padding(monkeypatch, padding):
    webcam = plug_in(monkeypatch, padding=padding)
    capture = capture_of(webcam)
    for number in (1, 2, 3):
        frame = capture.read()
        assert frame.jpeg == webcam.jpeg(number)
        assert frame.arrival_ns == number * PERIOD_NS
    (video,) = webcam.opened
    assert video.asked == {
        cv2.CAP_PROP_FOURCC: cv2.VideoWriter.fourcc(*"MJPG"),
        cv2.CAP_PROP_FPS: 50,
        cv2.CAP_PROP_FRAME_WIDTH: 64,
        cv2.CAP_PROP_FRAME_HEIGHT: 48,
        cv2.CAP_PROP_CONVERT_RGB: 0,
    }
    capture.close()
    assert not video.isOpened()


@pytest.mark.parametrize("formats", [("MJPG",), ("YUYV",)])
def test_a_camera_whose_driver_refuses_a_rate_is_opened_without(monkeypatch, formats):
    webcam = plug_in(monkeypatch, formats=formats, takes_rate=False)
    assert capture_of(webcam).read().arrival_ns == PERIOD_NS
    assert cv2.CAP_PROP_FPS not in webcam.opened[-1].asked
    assert webcam.opened[-1].asked[cv2.CAP_PROP_FRAME_WIDTH] == 64


def test_a_camera_without_mjpg_is_reopened_with_decoding_and_its_images_are_encoded(monkeypatch):
    webcam = plug_in(monkeypatch, formats=("YUYV",))
    capture = capture_of(webcam)
    first, second = capture.read(), capture.read()
    assert first.arrival_ns == PERIOD_NS  # reception, not the end of encoding
    assert second.arrival_ns == 2 * PERIOD_NS + CODING_NS
    raw, decoded = webcam.opened
    assert not raw.isOpened()  # a device can be opened once
    assert cv2.CAP_PROP_CONVERT_RGB not in decoded.asked
    grey = cv2.imdecode(np.frombuffer(second.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert grey.shape == (48, 64)
    assert np.abs(grey.astype(int) - 2).max() <= 2


def test_without_a_size_the_camera_keeps_its_default(monkeypatch):
    webcam = plug_in(monkeypatch)
    capture_of(webcam, size_px=None).read()
    assert not {cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT} & set(webcam.opened[0].asked)


def test_a_damaged_image_is_skipped_and_counted_and_the_camera_stays_open(monkeypatch):
    """With many cameras the first image after opening is damaged: reopening would never end."""
    webcam, counters = plug_in(monkeypatch), Counter()
    webcam.damaged = set(range(1, 4 * MAX_DAMAGED, 2))
    capture = capture_of(webcam, counters)
    assert [capture.read().jpeg for _ in range(20)] == [webcam.jpeg(number) for number in range(2, 42, 2)]
    assert counters["damaged"] == 20
    assert len(webcam.opened) == 1


def test_a_camera_that_delivers_only_damaged_images_is_lost(monkeypatch):
    webcam = plug_in(monkeypatch)
    webcam.damaged = set(range(1000))
    with pytest.raises(CaptureLost, match="/dev/null delivers frames that are not JPEG"):
        capture_of(webcam).read()
    assert webcam.number == MAX_DAMAGED + 1


def test_a_camera_of_another_size_is_an_error(monkeypatch):
    plug_in(monkeypatch, real_time=True)
    expected_text = "frames of 64 x 48 pixels, but the lens is calibrated for 720 x 720: set the camera's mode"
    with pytest.raises(LinkError, match=expected_text), camera_of(size_px=(720, 720)).listen() as records:
        next(records)


def test_an_unplugged_camera_is_reopened_when_it_returns(monkeypatch):
    webcam, camera = plug_in(monkeypatch, real_time=True), camera_of()
    with camera.listen() as records:
        first = next(records)
        webcam.plugged = False
        while len(webcam.opened) < 2:  # the first was lost, the next cannot be opened
            time.sleep(0.005)
        assert not webcam.opened[0].isOpened()
        webcam.plugged = True
        while camera.counters.get("opened again", 0) == 0:
            last = next(records)
    assert camera.counters["lost"] == 1
    assert last.arrival_ns > first.arrival_ns
    for record in (first, last):
        assert record.arrival_ns - record.stamp_ns == 50_000_000
        assert decode_compressed_image(record.data).stamp_ns == record.stamp_ns


def test_a_camera_used_by_another_program_is_an_error_that_names_what_to_check(monkeypatch):
    plug_in(monkeypatch).plugged = False
    expected_text = "/dev/null cannot be opened as a camera. Is the camera plugged in.*does another program use it"
    with pytest.raises(LinkError, match=expected_text), camera_of().listen() as records:
        next(records)
