"""Live cameras: an MJPEG server on this machine that stops and restarts, and video files."""

from __future__ import annotations

import threading
import time
from collections import Counter
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from flow.link import LinkError
from links.camera import Camera
from links.camera.capture import Capture, CaptureSettings
from links.clock import host_time
from links.recording import decode_compressed_image

PERIOD_S = 0.04


def jpeg(number, size_px=(64, 48)):
    return cv2.imencode(".jpg", np.full((size_px[1], size_px[0], 3), number % 250, np.uint8))[1].tobytes()


class Server:
    """Numbered frames as a webcam's HTTP server sends them; `stop` and `start` keep the port."""

    def __init__(self, burst=0):
        self.sent_ns, self.port, self._burst = {}, 0, burst
        self.start()

    def start(self):
        outer = self
        outer.running = True

        class Handler(BaseHTTPRequestHandler):
            def log_message(self, *_):
                pass

            def do_GET(self):
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                number = 0
                while outer.running:
                    number += 1
                    data = jpeg(number)
                    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                    try:
                        self.wfile.write(head.encode() + data + b"\r\n")
                    except OSError:
                        return
                    outer.sent_ns[number] = host_time.now_ns()
                    if number > outer._burst:
                        time.sleep(PERIOD_S)

        self._http = ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        self.port = self._http.server_port
        threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()

    def stop(self):
        self.running = False
        self._http.shutdown()
        self._http.server_close()

    @property
    def url(self):
        return f"http://127.0.0.1:{self.port}/stream.mjpg"


@pytest.fixture
def server():
    http = Server()
    yield http
    http.stop()


def number_of(record):
    return int(np.median(cv2.imdecode(np.frombuffer(decode_compressed_image(record.data).data, np.uint8), 0)))


def test_frames_of_a_stream_are_passed_through_and_stamped_at_reception(server):
    camera = Camera(topic="/camera/vehicle", source=server.url, size_px=(64, 48), latency_s=0.25, fps=1 / PERIOD_S)
    with camera.listen() as records:
        taken = [next(records) for _ in range(8)]
    numbers = [number_of(r) for r in taken]
    assert numbers == sorted(set(numbers))
    for number, record in zip(numbers, taken, strict=True):
        frame = decode_compressed_image(record.data)
        assert frame.data == jpeg(number)  # the JPEG that was sent
        assert (frame.frame_id, frame.stamp_ns) == ("camera_vehicle", record.stamp_ns)
        assert record.arrival_ns - record.stamp_ns == 250_000_000
        assert record.topic == "/camera/vehicle"
    assert [r.sequence for r in taken] == list(range(8))
    lateness = [r.arrival_ns - server.sent_ns[n] for n, r in zip(numbers, taken, strict=True)]
    assert np.median(lateness) < 1e9 * PERIOD_S  # none was buffered
    assert camera.decode(taken[0]).grey.shape == (48, 64)


def test_frames_buffered_in_the_connection_are_dropped():
    http = Server(burst=10)
    camera = Camera(topic="/camera/drone", source=http.url, fps=1 / PERIOD_S)
    with camera.listen() as records:
        first = number_of(next(records))
    http.stop()
    assert first > 5
    assert camera.counters["stale"] > 0


def test_a_slow_reader_gets_the_newest_frame_and_the_others_are_counted(server):
    camera = Camera(topic="/camera/vehicle", source=server.url, fps=1 / PERIOD_S)
    with camera.listen() as records:
        before = number_of(next(records))
        while camera.counters.get("overtaken", 0) < 5:
            time.sleep(0.01)
        assert number_of(next(records)) >= before + 5


def test_a_server_that_stops_and_restarts_is_reopened(server):
    camera = Camera(topic="/camera/vehicle", source=server.url, fps=1 / PERIOD_S, timeout_s=1)
    with camera.listen() as records:
        next(records)
        server.stop()
        while camera.counters.get("lost", 0) == 0:
            time.sleep(0.01)
        server.start()
        while camera.counters.get("opened again", 0) == 0:
            next(records)
        assert camera.decode(next(records)) is not None


def test_leaving_the_context_ends_a_waiting_reader(server):
    camera = Camera(topic="/camera/vehicle", source=server.url, fps=1 / PERIOD_S)
    ended = threading.Event()
    with camera.listen() as records:
        next(records)

        def read():
            for _ in records:
                pass
            ended.set()

        thread = threading.Thread(target=read)
        thread.start()
    thread.join(5)
    assert ended.is_set()


def test_frames_of_another_size_than_the_lens_calibration_are_an_error(server):
    camera = Camera(topic="/camera/vehicle", source=server.url, size_px=720)
    with (
        pytest.raises(LinkError, match="64 x 48 pixels, but the lens is calibrated for 720 x 720"),
        camera.listen() as r,
    ):
        next(r)


def video_file(path, codec, frames=6, fps=25.0):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, (64, 48))
    assert writer.isOpened()
    for number in range(frames):
        writer.write(np.full((48, 64, 3), 20 * number, np.uint8))
    writer.release()
    return path


@pytest.mark.parametrize(("name", "codec"), [("a.avi", "MJPG"), ("b.mp4", "mp4v")])
def test_a_video_file_plays_in_real_time_and_ends(tmp_path, name, codec):
    camera = Camera(topic="/camera/drone", source=str(video_file(tmp_path / name, codec)))
    with camera.listen() as records:
        taken = list(records)
    greys = [int(np.median(camera.decode(r).grey)) for r in taken]
    assert greys == pytest.approx(sorted(greys))
    assert abs(greys[-1] - 100) < 8  # the last frame arrived
    assert len(greys) >= 4  # on a busy machine one may be overtaken
    steps = np.diff([r.stamp_ns for r in taken]) / (20e6 * np.diff(greys) / 10)
    assert np.allclose(steps, 1.0, atol=0.35)  # 40 ms for each step of 20 in grey


def test_a_files_frames_are_stamped_by_its_own_timeline(tmp_path):
    settings = CaptureSettings(str(video_file(tmp_path / "a.avi", "MJPG")), None, 30.0, 1.0, 90)
    capture = Capture(settings, host_time.now_ns, Counter())
    stamps = [capture.read().arrival_ns for _ in range(6)]
    capture.close()
    assert np.diff(stamps).tolist() == [40_000_000] * 5


@pytest.mark.parametrize(
    ("source", "expected_text"),
    [
        ("/dev/video-none", "there is no /dev/video-none. Is the camera plugged in and in webcam mode"),
        ("missing.mp4", "there is no file missing.mp4.*did you mean /dev/video0 or a URL"),
        (
            "http://user:secret@127.0.0.1:9/x",
            r"http://\*\*\*@127.0.0.1:9/x cannot be opened. Does another player open it",
        ),
        (None, "set `source` to run live"),
    ],
)
def test_a_source_that_cannot_be_opened_is_an_error_that_names_what_to_check(source, expected_text):
    camera = Camera(topic="/camera/vehicle", source=source, timeout_s=1)
    with pytest.raises(LinkError, match=expected_text) as caught, camera.listen() as records:
        next(records)
    assert "secret" not in str(caught.value)


def test_a_file_that_is_no_video_is_an_error(tmp_path):
    (tmp_path / "no.avi").write_bytes(b"not a video" * 50)
    camera = Camera(topic="/camera/vehicle", source=str(tmp_path / "no.avi"))
    expected_text = r"no.avi cannot be opened. Is `source` the path of a video file"
    with pytest.raises(LinkError, match=expected_text), camera.listen() as records:
        next(records)


@pytest.mark.parametrize("setting", [{"fps": 0}, {"latency_s": -0.1}, {"jpeg_quality": 10}, {"timeout_s": 0}])
def test_impossible_camera_settings_are_errors(setting):
    with pytest.raises(ValidationError):
        Camera(topic="/camera/vehicle", **setting)
