"""Capture: one open camera, stream or video file; frames as JPEG with their reception times.

A source is a V4L2 device (`/dev/video0`, the SP360 as a webcam), a URL (RTSP, HTTP) or a video file, read by OpenCV's
V4L2 and FFmpeg backends. MJPEG frames are passed through; frames of other codecs are decoded and encoded as JPEG.

The reception time of a frame is the time at which a blocking grab returns. A grab that returns immediately delivers a
frame that was buffered for an unknown time. After opening, such frames are dropped until one was waited for; later
never two consecutive ones, so that a host that is too slow gets every second frame.

RTSP streams contain time stamps. They give the reception time without the delay of the decoder
(`links/camera/image_clock.py`), however long decoding takes. Images that are later than on a host that keeps up are
dropped, at most nine consecutive ones.

FFmpeg decodes with one thread. With n threads it delivers an image after the next n - 1 have arrived (its default of
one thread per core delays by 7 images on eight cores), and the threads take CPU time from the LiDAR. H.264 is one image
late even with one thread, because the end of an image is known only when the next one begins.

Source: OpenCV 5, VideoCapture (CAP_PROP_FORMAT -1: the stream's own packets; CAP_PROP_CONVERT_RGB 0;
CAP_PROP_N_THREADS, which can be set on opening only).
"""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from flow.config.secrets import without_secrets
from links.camera.image_clock import ImageClock

WAITED_SHARE = 0.25  # of the frame period: after a shorter grab the frame counts as buffered
DECODED_SHARE = 0.5  # the same where grab decodes: on a small host that takes 10 ms of 33 ms
BACKLOG_S, STAMPED_BACKLOG_S = 1.0, 10.0  # limit of dropping frames after opening; of a stream with time stamps
LATE_PERIODS = 2.0  # an image later than this, relative to the fastest one, is dropped
MAX_LATE = 9  # consecutive dropped images; more mean that decoding alone takes longer than a period
MAX_DAMAGED = 10  # consecutive images
JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
RTSP = ("rtsp://", "rtsps://")
_URL = re.compile(r"^[a-z][a-z0-9+.-]*://", re.IGNORECASE)


class CaptureLost(Exception):
    """The source cannot be opened, or delivers no more frames; the text is the reason."""


class CaptureEnded(CaptureLost):
    """A video file has ended."""


@dataclass(frozen=True, slots=True)
class CaptureSettings:
    """What to open, and how."""

    source: str
    size_px: tuple[int, int] | None  # requested from a device
    fps: float
    timeout_s: float
    jpeg_quality: int


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame with its times."""

    arrival_ns: int  # on the clock `now_ns` of the capture
    received_ns: int  # the same without the delay of the decoder, for a stream with time stamps
    jpeg: bytes


def is_url(source: str) -> bool:
    """Whether a source is a URL."""
    return _URL.match(source) is not None


def is_device(source: str) -> bool:
    """Whether a source is a device on this host."""
    return source.startswith("/dev/")


class Capture:
    """An open source; `read` returns frame after frame. Raises CaptureLost when it cannot be opened, or is lost."""

    def __init__(self, settings: CaptureSettings, now_ns: Callable[[], int], counters: Counter[str]) -> None:
        """`counters`: of dropped frames, by reason: "stale" (buffered), "late", "damaged"."""
        self._settings, self._now_ns, self._counters = settings, now_ns, counters
        self._live = is_device(settings.source) or is_url(settings.source)
        self._name = without_secrets(settings.source)
        self._video, self._raw = self._open()
        self._opened_ns = now_ns()
        share = WAITED_SHARE if self._raw or is_device(settings.source) else DECODED_SHARE
        self._waited_ns = share * 1e9 / settings.fps
        self._caught_up = not self._live
        self._dropped_last = False
        self._consecutive_damaged = self._consecutive_late = 0
        stamped = not self._raw and settings.source.lower().startswith(RTSP)
        self._clock = ImageClock() if stamped else None

    def close(self) -> None:
        """Release the device or connection."""
        self._video.release()

    def read(self) -> Frame:
        """Wait for the next frame with a known reception time."""
        while True:
            grab_ns = self._now_ns()
            if not self._video.grab():
                if not self._live:
                    raise CaptureEnded(f"{self._name} has ended")
                raise CaptureLost(f"{self._name} delivers no more frames")
            arrival_ns = self._now_ns() if self._live else self._due_ns()
            received_ns = self._received_ns(arrival_ns)
            if self._live and self._drops(grab_ns, arrival_ns, arrival_ns - received_ns):
                self._counters["stale"] += 1
                continue
            found, image = self._video.retrieve()
            jpeg = self._jpeg(np.asarray(image)) if found and image is not None and image.size else None
            if jpeg is not None:
                self._consecutive_damaged = 0
                return Frame(arrival_ns, received_ns, jpeg)
            self._counters["damaged"] += 1
            self._consecutive_damaged += 1
            if self._consecutive_damaged > MAX_DAMAGED:
                what = "are not JPEG" if self._raw else "cannot be decoded"
                raise CaptureLost(f"{self._name} delivers frames that {what}")

    def _open(self) -> tuple[cv2.VideoCapture, bool]:
        s = self._settings
        if is_device(s.source):
            return self._open_device()
        if not is_url(s.source) and not Path(s.source).is_file():
            raise CaptureLost(f"there is no file {s.source}")
        limit_ms = round(1e3 * s.timeout_s)
        options = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit_ms]
        options += [cv2.CAP_PROP_N_THREADS, 1]
        video = cv2.VideoCapture(s.source, cv2.CAP_FFMPEG, [*options, cv2.CAP_PROP_FORMAT, -1])
        if video.isOpened() and _codec(video) in ("MJPG", "mjpg", "jpeg"):
            return video, True
        if video.isOpened():  # another codec: reopen it with decoding
            video.release()
            video = cv2.VideoCapture(s.source, cv2.CAP_FFMPEG, options)
        if not video.isOpened():
            raise CaptureLost(f"{self._name} cannot be opened")
        return video, False

    def _open_device(self) -> tuple[cv2.VideoCapture, bool]:
        s = self._settings
        if not Path(s.source).exists():
            raise CaptureLost(f"there is no {s.source}")
        options = [cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG")]
        if s.size_px is not None:
            options += [cv2.CAP_PROP_FRAME_WIDTH, s.size_px[0], cv2.CAP_PROP_FRAME_HEIGHT, s.size_px[1]]
        for rate in ([cv2.CAP_PROP_FPS, round(s.fps)], []):  # some drivers refuse any rate
            video = cv2.VideoCapture(s.source, cv2.CAP_V4L2, [*options, *rate, cv2.CAP_PROP_CONVERT_RGB, 0])
            if video.isOpened() and _codec(video) == "MJPG":
                return video, True
            video.release()
            video = cv2.VideoCapture(s.source, cv2.CAP_V4L2, [*options, *rate])
            if video.isOpened():
                return video, False
        raise CaptureLost(f"{s.source} cannot be opened as a camera")

    def _received_ns(self, arrival_ns: int) -> int:
        """Reception time of the grabbed image: by the stream's time stamps if they advance, otherwise its arrival."""
        if self._clock is None:
            return arrival_ns
        received_ns = self._clock.received_ns(round(1e6 * self._video.get(cv2.CAP_PROP_POS_MSEC)), arrival_ns)
        if received_ns is None:
            self._clock = None
            return arrival_ns
        return received_ns

    def _drops(self, grab_ns: int, arrival_ns: int, late_ns: int) -> bool:
        """Whether to drop the grabbed frame: it was buffered for an unknown time, or is late."""
        if self._clock is not None:
            if not self._caught_up:
                self._caught_up = self._clock.caught_up or arrival_ns - self._opened_ns > STAMPED_BACKLOG_S * 1e9
                return not self._caught_up
            late = late_ns > LATE_PERIODS * 1e9 / self._settings.fps
            self._counters["late"] += late
            self._consecutive_late = self._consecutive_late + 1 if late else 0
            if self._consecutive_late > MAX_LATE:
                self._counters["too slow"] += 1
                self._consecutive_late = 0
                return False
            return late
        waited = arrival_ns - grab_ns > self._waited_ns
        if not self._caught_up:
            self._caught_up = waited or arrival_ns - self._opened_ns > BACKLOG_S * 1e9
            return not self._caught_up
        self._dropped_last = not waited and not self._dropped_last
        return self._dropped_last

    def _due_ns(self) -> int:
        """Play a file in real time: wait for the time of its next frame, and return it."""
        due_ns = self._opened_ns + round(1e6 * max(self._video.get(cv2.CAP_PROP_POS_MSEC), 0.0))
        while (left_ns := due_ns - self._now_ns()) > 0:
            time.sleep(min(1e-9 * left_ns, 0.1))
        return due_ns

    def _jpeg(self, image: np.ndarray) -> bytes | None:
        """An image as JPEG; None: an incomplete JPEG, as a webcam's first one often is."""
        if self._raw:
            data = image.tobytes()
            end = data.rfind(JPEG_END)  # a device's buffer may be longer than its image
            return data[: end + 2] if data.startswith(JPEG_START) and end >= 0 else None
        written, coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self._settings.jpeg_quality])
        if not written:
            raise CaptureLost(f"{self._name}: a frame of shape {image.shape} cannot be encoded as JPEG")
        return coded.tobytes()


def _codec(video: cv2.VideoCapture) -> str:
    return int(video.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=False).decode("ascii", "replace")
