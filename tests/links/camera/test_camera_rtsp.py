"""Cameras live by RTSP: a network camera on this machine that sends H.264, is cut off, falls silent and comes back."""

from __future__ import annotations

import time
from collections import Counter

import cv2
import numpy as np
import pytest

from flow.link import LinkError
from links.camera import Camera
from links.camera.capture import Capture, CaptureSettings
from links.recording import decode_compressed_image
from tests.links.camera.h264_by_hand import number_of
from tests.links.camera.rtsp_camera import RtspCamera

PERIOD_S = 0.02
STEP_NS = 33_000_000


@pytest.fixture
def network_camera():
    served = RtspCamera(PERIOD_S, user="crew:secret")
    yield served
    served.stop()


def camera_of(served, **settings):
    settings = {"source": served.url, "size_px": (64, 48), "fps": 1 / PERIOD_S, "timeout_s": 2} | settings
    return Camera(topic="/camera/drone", **settings)


def test_h264_by_rtsp_is_decoded_and_stamped_when_it_came(network_camera):
    camera = camera_of(network_camera, latency_s=0.25)
    with camera.listen() as records:
        taken = [next(records) for _ in range(30)]
    numbers = [number_of(camera.decode(record).grey) for record in taken]
    assert numbers == sorted(set(numbers))
    assert [r.sequence for r in taken] == list(range(30))
    for record in taken:
        frame = decode_compressed_image(record.data)
        assert (frame.frame_id, frame.stamp_ns) == ("camera_drone", record.stamp_ns)
        assert 250_000_000 <= record.arrival_ns - record.stamp_ns < 350_000_000
    assert camera.counters["stale"] > 0  # what had come while it was opened
    assert len(network_camera.asked) == 2  # it serves one client at a time: asked what it sends, let go, opened


def test_without_its_password_a_network_camera_cannot_be_opened(network_camera):
    camera = camera_of(network_camera, source=network_camera.url.replace("crew:secret@", ""))
    with pytest.raises(LinkError, match="Check address, port, name and password"), camera.listen() as records:
        next(records)


def test_a_picture_comes_out_as_soon_as_the_next_one_begins(network_camera):
    """Decoding that waits for more, one picture a thread, would have it come when two or more have been sent after it."""
    camera = camera_of(network_camera)
    with camera.listen() as records:
        taken = [next(records) for _ in range(40)]
    numbers = [number_of(camera.decode(record).grey) for record in taken]
    newest = [max(n for n, ns in network_camera.began_ns.items() if ns <= r.arrival_ns) for r in taken]
    assert np.min(np.subtract(newest, numbers)) == 1


class SlowDecoder:
    """cv2.VideoCapture of a stream in which `waiting` pictures have come, by a clock of its own: a grab takes a while."""

    def __init__(self, waiting, decoding_ns, coding_ns):
        self.waiting, self.decoding_ns, self.coding_ns, self.now_ns, self.number = waiting, decoding_ns, coding_ns, 0, 0

    def grab(self):
        self.number += 1
        self.now_ns = max(self.now_ns, self.came_ns(self.number)) + self.decoding_ns
        return True

    def came_ns(self, number):
        return (number - self.waiting) * STEP_NS

    def retrieve(self):
        self.now_ns += self.coding_ns
        return True, np.zeros((48, 64, 3), np.uint8)

    def get(self, what):
        if what == cv2.CAP_PROP_POS_MSEC:
            return 1e-6 * STEP_NS * self.number
        return float(cv2.VideoWriter.fourcc(*"h264"))

    def isOpened(self):
        return True

    def release(self):
        pass


@pytest.mark.parametrize(("decoding_ms", "coding_ms"), [(1, 5), (12, 5), (15, 22), (20, 5), (28, 2), (30, 20)])
def test_a_picture_is_stamped_when_it_came_however_long_the_decoder_takes(monkeypatch, decoding_ms, coding_ms):
    """Each stamp is late by what decoding takes at least. A host too slow for all sees every second picture."""
    stream = SlowDecoder(30, decoding_ms * 1_000_000, coding_ms * 1_000_000)
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: stream)
    counts = Counter()
    capture = Capture(CaptureSettings("rtsp://camera/live", None, 30.0, 1.0, 90), lambda: stream.now_ns, counts)
    stamps_late_ns, late_ns = [], []
    for _ in range(400):
        frame = capture.read()
        stamps_late_ns.append(frame.came_ns - stream.came_ns(stream.number))
        late_ns.append(frame.arrival_ns - stream.came_ns(stream.number))
    assert max(stamps_late_ns) < stream.decoding_ns + 0.3 * STEP_NS  # of which 1 ms each 10 s: clocks may drift
    assert max(late_ns) < 6 * STEP_NS
    keeps_up = decoding_ms + coding_ms < 33
    assert (counts["late"] == 0) is keeps_up
    assert counts["too slow"] == 0


def test_a_host_that_decodes_more_slowly_than_pictures_come_says_so(monkeypatch):
    stream = SlowDecoder(0, 40_000_000, 5_000_000)
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: stream)
    camera = Camera(topic="/camera/drone", source="rtsp://camera/live", fps=30.0)
    settings = CaptureSettings("rtsp://camera/live", None, 30.0, 1.0, 90)
    capture = Capture(settings, lambda: stream.now_ns, camera._counts)
    assert camera.status is None
    frames = [capture.read() for _ in range(20)]
    assert camera.counters["too slow"] > 5
    assert "decodes its stream more slowly than it comes" in camera.status
    late_ns = [frame.came_ns - stream.came_ns(1) for frame in frames]
    assert late_ns == sorted(late_ns)
    monkeypatch.setattr("links.camera.camera.SLOW_TOLD_S", -1.0)
    assert camera.status is None


def test_a_stream_whose_times_stand_still_is_stamped_on_arrival(monkeypatch):
    stream = SlowDecoder(30, 12_000_000, 5_000_000)
    monkeypatch.setattr(SlowDecoder, "get", lambda *_: 0.0)
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: stream)
    capture = Capture(CaptureSettings("rtsp://camera/live", None, 30.0, 1.0, 90), lambda: stream.now_ns, Counter())
    for _ in range(100):
        frame = capture.read()
        assert frame.came_ns == frame.arrival_ns
        assert frame.arrival_ns - stream.came_ns(stream.number) < STEP_NS + stream.decoding_ns


def test_a_network_camera_that_is_cut_off_and_comes_back_is_opened_again(network_camera):
    camera = camera_of(network_camera)
    with camera.listen() as records:
        before = number_of(camera.decode(next(records)).grey)
        network_camera.stop()
        while camera.counters.get("lost", 0) == 0:
            time.sleep(0.01)
        network_camera.start()
        while camera.counters.get("opened again", 0) == 0:
            next(records)
        assert number_of(camera.decode(next(records)).grey) > before
    assert camera.counters["lost"] == 1


def test_a_network_camera_that_falls_silent_is_lost_after_its_timeout(network_camera):
    camera = camera_of(network_camera, timeout_s=1)
    with camera.listen() as records:
        next(records)
        connections = len(network_camera.asked)
        network_camera.silent = True
        while camera.counters.get("lost", 0) == 0:
            time.sleep(0.01)
        network_camera.silent = False
        while camera.counters.get("opened again", 0) == 0:
            next(records)
    assert len(network_camera.asked) > connections
