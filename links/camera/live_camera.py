"""Live camera: a thread reads every frame, keeps the newest for the consumer, and reopens a lost camera."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from flow.config.secrets import without_secrets
from flow.link import LinkError
from links.camera.capture import (
    Capture,
    CaptureEnded,
    CaptureLost,
    CaptureSettings,
    Frame,
    is_device,
    is_url,
)
from links.clock import host_time

PAUSE_S, MAX_PAUSE_S = 0.25, 5.0  # between two attempts to open the camera
END_S = 1.0  # limit of waiting for a read that is blocked in a driver
_WAKE_S = 0.2


class LiveCamera:
    """Frames of one camera, from `open` to the end of its context."""

    def __init__(self, settings: CaptureSettings, counters: Counter[str]) -> None:
        self._settings, self._counters = settings, counters
        self._changed = threading.Condition()
        self._newest: Frame | None = None
        self._ended = False  # the video file has ended
        self._lost: CaptureLost | None = None  # why no frame arrives
        self._delivered = False
        self._closed = threading.Event()

    @contextmanager
    def open(self) -> Iterator[Iterator[Frame]]:
        """An iterator of the newest frames; it raises LinkError when the first frame does not arrive."""
        thread = threading.Thread(target=self._run, name="camera", daemon=True)
        thread.start()
        try:
            yield self._frames()
        finally:
            self._closed.set()
            with self._changed:
                self._changed.notify_all()
            thread.join(END_S)

    def _frames(self) -> Iterator[Frame]:
        while not self._closed.is_set():
            with self._changed:
                if self._newest is None and not self._ended:
                    self._changed.wait(_WAKE_S)
                frame, self._newest = self._newest, None
            if frame is not None:
                self._delivered = True
                yield frame
            elif self._ended:
                return
            elif self._lost is not None and not self._delivered:
                raise LinkError(f"{self._lost}. {self._advice()}")

    def _run(self) -> None:
        """Thread: open, read, and reopen after a loss, until the end."""
        pause_s = PAUSE_S
        capture: Capture | None = None
        while not self._closed.is_set():
            try:
                if capture is None:
                    capture = Capture(self._settings, host_time.now_ns, self._counters)
                self._put(capture.read())
                pause_s = PAUSE_S
            except CaptureEnded:
                self._end()
                break
            except CaptureLost as error:
                self._counters["lost"] += self._lost is None
                self._lost = error
                if capture is not None:
                    capture.close()
                capture = None
                self._closed.wait(pause_s)
                pause_s = min(2 * pause_s, MAX_PAUSE_S)
        if capture is not None:
            capture.close()

    def _put(self, frame: Frame) -> None:
        with self._changed:
            self._counters["overtaken"] += self._newest is not None
            self._counters["opened again"] += self._lost is not None
            self._newest, self._lost = frame, None
            self._changed.notify_all()

    def _end(self) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _advice(self) -> str:
        source = self._settings.source
        if is_device(source):
            return (
                "Is the camera plugged in and in webcam mode, is `source` its device (`ls -l /dev/v4l/by-id`), is this "
                "user in the group video, and does another program use it (`fuser -v /dev/video0`)?"
            )
        if is_url(source):
            command = f"ffplay {without_secrets(source)}"
            return f"Does another player open it (`{command}`)? Check address, port, name and password."
        return "Is `source` the path of a video file that FFmpeg reads, or did you mean /dev/video0 or a URL?"
