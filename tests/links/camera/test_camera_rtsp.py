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
        assert record.arrival_ns - record.stamp_ns == 250_000_000
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

    def get(self, _):
        return float(cv2.VideoWriter.fourcc(*"h264"))

    def isOpened(self):
        return True

    def release(self):
        pass


@pytest.mark.parametrize(("decoding_ms", "coding_ms"), [(1, 5), (12, 5), (15, 22)])
def test_what_waited_is_thrown_away_though_decoding_takes_its_time(monkeypatch, decoding_ms, coding_ms):
    """A stamp is wrong by what a picture waited. A host for which each takes longer than a period sees every second."""
    stream = SlowDecoder(30, decoding_ms * 1_000_000, coding_ms * 1_000_000)
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: stream)
    capture = Capture(CaptureSettings("rtsp://camera/live", None, 30.0, 1.0, 90), lambda: stream.now_ns, Counter())
    late_ns = []
    for _ in range(200):
        arrival_ns = capture.read().arrival_ns
        late_ns.append(arrival_ns - stream.came_ns(stream.number))
    assert max(late_ns) < STEP_NS + stream.decoding_ns
    taken = 200 * (1 if decoding_ms + coding_ms < 33 else 2)
    assert stream.number < taken + 60  # the 30, what comes meanwhile, and no more


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
