"""The simulated cameras in real time: recorded images, served over HTTP as network cameras do (MJPEG).

Rendering two fisheyes takes eight times as long as the flight, so the images come from a recording of the same flight
(`image_cache` checks it). Each is served at its recorded arrival, about 60 ms after its exposure. A client gets the
newest image and none twice; a slow client misses some.

Source: ours; multipart/x-mixed-replace as network cameras send it (RFC 2046, 5.1).
"""

from __future__ import annotations

import heapq
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType

from links.recording import decode_compressed_image
from links.simulated.rig.image_cache import CachedCamera

LOOPBACK = "127.0.0.1"
AHEAD_NS = 200_000_000  # images are read this long before they are due
POLL_S = 0.05  # period of reading ahead, and of checks for the end
MOST_CLIENTS = 4


class MjpegServer:
    """One camera on a port of this host. `with MjpegServer(8091) as server: server.show(jpeg)`."""

    def __init__(self, port: int) -> None:
        """`port` 0: any free port. OSError when the port is in use."""
        self._changed = threading.Condition()
        self._newest: bytes | None = None
        self._number = self._clients = 0
        self._closed = False
        shown = self

        class Handler(BaseHTTPRequestHandler):
            """One client, until it disconnects or the server closes."""

            def log_message(self, format: str, *args: object) -> None:
                """Do not log."""

            def do_GET(self) -> None:
                """The stream, for any path."""
                shown.serve(self)

        self._http = ThreadingHTTPServer((LOOPBACK, port), Handler)
        self._http.daemon_threads = True
        self._thread = threading.Thread(target=self._http.serve_forever, args=(POLL_S,), daemon=True)

    @property
    def port(self) -> int:
        """The port on which it listens."""
        return self._http.server_port

    def __enter__(self) -> MjpegServer:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._http.shutdown()
        self._http.server_close()

    def show(self, jpeg: bytes) -> None:
        """Publish the newest image."""
        with self._changed:
            self._newest, self._number = jpeg, self._number + 1
            self._changed.notify_all()

    def serve(self, client: BaseHTTPRequestHandler) -> None:
        """Send images to one client."""
        with self._changed:
            if self._clients >= MOST_CLIENTS:
                client.send_error(503, "too many clients")
                return
            self._clients += 1
        try:
            client.send_response(200)
            client.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            client.end_headers()
            sent = self._number
            while (image := self._after(sent)) is not None:
                sent, jpeg = image
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                client.wfile.write(head.encode() + jpeg + b"\r\n")
        except OSError:  # it disconnected
            return
        finally:
            with self._changed:
                self._clients -= 1

    def _after(self, sent: int) -> tuple[int, bytes] | None:
        """Number and bytes of an image newer than `sent`; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._number > sent)
            return None if self._closed or self._newest is None else (self._number, self._newest)


class TimedImageServer:
    """Serves the images of cached cameras at their arrival times: `with TimedImageServer(...)`."""

    def __init__(
        self, cameras: Sequence[CachedCamera], ports: Mapping[str, int], now_ns: Callable[[], int], end_ns: int
    ) -> None:
        """`ports` by topic; `now_ns` is the scenario's time, `end_ns` its end. OSError on entry: a port is in use."""
        self._cameras, self._ports, self._now_ns, self._end_ns = cameras, ports, now_ns, end_ns
        self._servers: dict[str, MjpegServer] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="images", daemon=True)
        self._open = ExitStack()
        self.shown = 0

    def __enter__(self) -> TimedImageServer:
        with ExitStack() as opening:
            for topic, port in self._ports.items():
                self._servers[topic] = opening.enter_context(MjpegServer(port))
            self._open = opening.pop_all()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        self._open.close()

    def _run(self) -> None:
        waiting: list[tuple[int, str, bytes]] = []
        while True:
            for camera in self._cameras:
                for record in camera.records(min(self._now_ns() + AHEAD_NS, self._end_ns)):
                    heapq.heappush(waiting, (record.arrival_ns, record.topic, record.data))
            due_s = (waiting[0][0] - self._now_ns()) * 1e-9 if waiting else POLL_S
            if self._stop.wait(min(max(due_s, 0.0), POLL_S)):
                return
            while waiting and waiting[0][0] <= self._now_ns():
                _, topic, data = heapq.heappop(waiting)
                server = self._servers.get(topic)
                if server is not None:
                    server.show(decode_compressed_image(data).data)
                    self.shown += 1
