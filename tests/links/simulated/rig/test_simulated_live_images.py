"""Recorded images, served in time: what a camera link reads, when each is served, and who is rejected."""

from __future__ import annotations

import threading
import time
import urllib.error
import urllib.request

import cv2
import numpy as np
import pytest

from flow.link import LinkError, Record, Run
from links.camera import Camera
from links.clock import host_time
from links.recording import CompressedImage, decode_compressed_image, encode_compressed_image
from links.simulated import LiveRig
from links.simulated.rig.live_images import MOST_CLIENTS, MjpegServer, TimedImageServer

PATIENCE_S = 60.0
MS = 1_000_000


def jpeg(number: int) -> bytes:
    return cv2.imencode(".jpg", np.full((48, 64), number % 250, np.uint8))[1].tobytes()


class Kept:
    """A camera with recorded images: ten per second, each arrives 60 ms after its stamp."""

    def __init__(self, topic: str, count: int) -> None:
        self.topic, self.count, self.given = topic, count, 0
        self.asked_ns: list[int] = []

    def records(self, until_ns: int) -> list[Record]:
        self.asked_ns.append(until_ns)
        made = []
        while self.given < self.count and self.given * 100 * MS < until_ns:
            stamp_ns = self.given * 100 * MS
            data = encode_compressed_image(CompressedImage(stamp_ns, "camera", jpeg(self.given)))
            made.append(Record(self.topic, stamp_ns + 60 * MS, stamp_ns, data))
            self.given += 1
        return made


def test_a_camera_link_reads_images_unchanged():
    stop = threading.Event()
    with MjpegServer(0) as server:

        def show() -> None:
            number = 0
            while not stop.wait(0.05):
                number += 1
                server.show(jpeg(number))

        showing = threading.Thread(target=show)
        showing.start()
        camera = Camera(topic="/camera/drone", source=f"http://127.0.0.1:{server.port}/", size_px=(64, 48), fps=20)
        with camera.listen() as records:
            taken = [decode_compressed_image(next(records).data).data for _ in range(4)]
        stop.set()
        showing.join()
    whole = {jpeg(number) for number in range(250)}
    assert set(taken) <= whole
    assert len(set(taken)) == 4, "none twice"


def test_too_many_clients_are_rejected():
    with MjpegServer(0) as server:
        server.show(jpeg(1))
        url = f"http://127.0.0.1:{server.port}/"
        stop, clients = threading.Event(), []
        keep = threading.Thread(target=lambda: [server.show(jpeg(n)) for n in range(10**6) if not stop.wait(0.02)][:0])
        keep.start()
        try:
            clients = [urllib.request.urlopen(url, timeout=PATIENCE_S) for _ in range(MOST_CLIENTS)]
            assert all(client.read(10) == b"--frame\r\nC" for client in clients)
            with pytest.raises(urllib.error.HTTPError, match="503"):
                urllib.request.urlopen(url, timeout=PATIENCE_S)
        finally:
            stop.set()
            for client in clients:
                client.close()
            keep.join()


def test_each_image_is_served_at_its_arrival_and_none_is_read_beyond_the_end():
    began_ns = host_time.now_ns()
    shown: list[tuple[bytes, int]] = []
    camera, end_ns = Kept("/camera/drone", 5), 450 * MS
    late_ns = host_time.now_ns
    in_time = TimedImageServer([camera], {"/camera/drone": 0}, lambda: late_ns() - began_ns, end_ns)
    with in_time:
        server = in_time._servers["/camera/drone"]
        show = server.show
        server.show = lambda data: (shown.append((data, host_time.now_ns() - began_ns)), show(data))
        deadline_s = time.monotonic() + PATIENCE_S
        while in_time.shown < 5 and time.monotonic() < deadline_s:
            time.sleep(0.01)
    assert in_time.shown == 5
    numbers = [next(n for n in range(5) if jpeg(n) == data) for data, _ in shown]
    assert numbers == sorted(numbers)
    assert all(at_ns >= n * 100 * MS + 60 * MS for n, (_, at_ns) in zip(numbers, shown, strict=True)), "none early"
    assert max(camera.asked_ns) <= end_ns


def test_without_the_images_the_error_states_how_to_render_them(tmp_path):
    scenario = tmp_path / "small.yaml"
    scenario.write_text("version: 1\n")
    rig = LiveRig(scenario=scenario, servo=tmp_path / "servo", images=tmp_path / "none.mcap")
    with pytest.raises(LinkError, match=r"none.mcap: no such recording.*grd simulate .*small.yaml -o .*none.mcap"):
        rig.open(Run(tmp_path, "sim", "", "", live=True))
