"""One open camera, stream or video file: frames as JPEG with the time at which they came.

What it may be: a V4L2 device (`/dev/video0`, the SP360 as a webcam), a URL (RTSP, HTTP) or a video file, through
OpenCV's V4L2 and FFmpeg. Frames that are JPEG already (MJPEG) are taken as they are, others are decoded and encoded.

A frame's time is when the grab that waited for it returned. A grab that returns at once brings a frame that has been
waiting for an unknown time: after opening those are thrown away until one had to be waited for, later never two in a
row, so that a host that is too slow sees every second frame.

What comes by RTSP has times of its own: by them a picture is freed of what it waited for the decoder
(`links/camera/image_clock.py`), however long that takes, and what is later than on a host that keeps up is thrown
away, nine in a row at most.

FFmpeg decodes with one thread. With n it hands a picture out when the n - 1 after it have come (one a core is its rule:
eight cores, 7 pictures late), and they take the cores from the LiDAR. H.264 comes one picture late even so: where a
picture ends is known when the next begins.

Source: ours; OpenCV 5, VideoCapture (CAP_PROP_FORMAT -1: the stream's own packets; CAP_PROP_CONVERT_RGB 0;
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

from links.camera.image_clock import ImageClock

WAITED_SHARE = 0.25  # of a frame's period: a grab that took less found the frame waiting
DECODED_SHARE = 0.5  # the same where a grab decodes: on a small host that takes 10 ms of 33
BACKLOG_S, TOLD_BACKLOG_S = 1.0, 10.0  # after opening, at most; of a stream that tells its times
LATE_PERIODS = 2.0  # by which a picture is later than the promptest one: the host is too slow for all
MOST_LATE = 9  # thrown away in a row; if that does not help, decoding alone takes longer than a period
MOST_DAMAGED = 10  # pictures in a row
JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
RTSP = ("rtsp://", "rtsps://")
_URL = re.compile(r"^[a-z][a-z0-9+.-]*://", re.IGNORECASE)


class CaptureLost(Exception):
    """The source cannot be opened, or gives no more frames. The text says what it was."""


class CaptureEnded(CaptureLost):
    """A video file is over."""


@dataclass(frozen=True, slots=True)
class CaptureSettings:
    """What to open, and how."""

    source: str
    size_px: tuple[int, int] | None  # to ask a device for
    fps: float
    timeout_s: float
    jpeg_quality: int


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame."""

    arrival_ns: int  # on the clock that the capture was given
    came_ns: int  # the same without what it waited for the decoder, where the stream tells
    jpeg: bytes


def is_url(source: str) -> bool:
    """Whether a source is a stream."""
    return _URL.match(source) is not None


def is_device(source: str) -> bool:
    """Whether a source is a camera on this host."""
    return source.startswith("/dev/")


def shown(source: str) -> str:
    """A source as it may be printed: without the name and password in a URL."""
    return re.sub(r"(?<=://)[^/@]*@", "", source)


class Capture:
    """An open source; `read` gives frame after frame. CaptureLost when it cannot be opened or has died."""

    def __init__(self, settings: CaptureSettings, now_ns: Callable[[], int], counters: Counter[str]) -> None:
        """`counters`: of frames thrown away, because they had been waiting ("stale") or were not whole ("damaged")."""
        self._settings, self._now_ns, self._counters = settings, now_ns, counters
        self._live = is_device(settings.source) or is_url(settings.source)
        self._name = shown(settings.source)
        self._video, self._raw = self._open()
        self._opened_ns = now_ns()
        share = WAITED_SHARE if self._raw or is_device(settings.source) else DECODED_SHARE
        self._waited_ns = share * 1e9 / settings.fps
        self._caught_up = not self._live
        self._dropped_last = False
        self._damaged_in_a_row = self._late_in_a_row = 0
        tells = not self._raw and settings.source.lower().startswith(RTSP)
        self._pictures = ImageClock() if tells else None

    def close(self) -> None:
        """Give the device or connection back."""
        self._video.release()

    def read(self) -> Frame:
        """The next frame whose time is known; waits for it."""
        while True:
            asked_ns = self._now_ns()
            if not self._video.grab():
                if not self._live:
                    raise CaptureEnded(f"{self._name} is over")
                raise CaptureLost(f"{self._name} gives no more frames")
            arrival_ns = self._now_ns() if self._live else self._due_ns()
            came_ns = self._came_ns(arrival_ns)
            if self._live and self._was_waiting(asked_ns, arrival_ns, arrival_ns - came_ns):
                self._counters["stale"] += 1
                continue
            found, picture = self._video.retrieve()
            jpeg = self._jpeg(np.asarray(picture)) if found and picture is not None and picture.size else None
            if jpeg is not None:
                self._damaged_in_a_row = 0
                return Frame(arrival_ns, came_ns, jpeg)
            self._counters["damaged"] += 1
            self._damaged_in_a_row += 1
            if self._damaged_in_a_row > MOST_DAMAGED:
                what = "are no JPEG" if self._raw else "cannot be read"
                raise CaptureLost(f"{self._name} gives frames that {what}")

    def _open(self) -> tuple[cv2.VideoCapture, bool]:
        s = self._settings
        if is_device(s.source):
            return self._open_device()
        if not is_url(s.source) and not Path(s.source).is_file():
            raise CaptureLost(f"there is no file {s.source}")
        limit_ms = round(1e3 * s.timeout_s)
        asked = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit_ms]
        asked += [cv2.CAP_PROP_N_THREADS, 1]
        video = cv2.VideoCapture(s.source, cv2.CAP_FFMPEG, [*asked, cv2.CAP_PROP_FORMAT, -1])
        if video.isOpened() and _codec(video) in ("MJPG", "mjpg", "jpeg"):
            return video, True
        if video.isOpened():  # another codec: its packets are no pictures, open it decoded
            video.release()
            video = cv2.VideoCapture(s.source, cv2.CAP_FFMPEG, asked)
        if not video.isOpened():
            raise CaptureLost(f"{self._name} cannot be opened")
        return video, False

    def _open_device(self) -> tuple[cv2.VideoCapture, bool]:
        s = self._settings
        if not Path(s.source).exists():
            raise CaptureLost(f"there is no {s.source}")
        asked = [cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"), cv2.CAP_PROP_FPS, round(s.fps)]
        if s.size_px is not None:
            asked += [cv2.CAP_PROP_FRAME_WIDTH, s.size_px[0], cv2.CAP_PROP_FRAME_HEIGHT, s.size_px[1]]
        video = cv2.VideoCapture(s.source, cv2.CAP_V4L2, [*asked, cv2.CAP_PROP_CONVERT_RGB, 0])
        if video.isOpened() and _codec(video) == "MJPG":
            return video, True
        video.release()
        video = cv2.VideoCapture(s.source, cv2.CAP_V4L2, asked)
        if not video.isOpened():
            raise CaptureLost(f"{s.source} cannot be opened as a camera")
        return video, False

    def _came_ns(self, arrival_ns: int) -> int:
        """When the grabbed picture came, by the stream's own times where it has some that go on."""
        if self._pictures is None:
            return arrival_ns
        came_ns = self._pictures.came_ns(round(1e6 * self._video.get(cv2.CAP_PROP_POS_MSEC)), arrival_ns)
        if came_ns is None:
            self._pictures = None
            return arrival_ns
        return came_ns

    def _was_waiting(self, asked_ns: int, arrival_ns: int, late_ns: int) -> bool:
        if self._pictures is not None:
            if not self._caught_up:
                self._caught_up = self._pictures.caught_up or arrival_ns - self._opened_ns > TOLD_BACKLOG_S * 1e9
                return not self._caught_up
            late = late_ns > LATE_PERIODS * 1e9 / self._settings.fps
            self._counters["late"] += late
            self._late_in_a_row = self._late_in_a_row + 1 if late else 0
            if self._late_in_a_row > MOST_LATE:
                self._counters["too slow"] += 1
                self._late_in_a_row = 0
                return False
            return late
        waited = arrival_ns - asked_ns > self._waited_ns
        if not self._caught_up:
            self._caught_up = waited or arrival_ns - self._opened_ns > BACKLOG_S * 1e9
            return not self._caught_up
        self._dropped_last = not waited and not self._dropped_last
        return self._dropped_last

    def _due_ns(self) -> int:
        """When a file's frame would have come, by its own timeline; waits until then."""
        due_ns = self._opened_ns + round(1e6 * max(self._video.get(cv2.CAP_PROP_POS_MSEC), 0.0))
        while (left_ns := due_ns - self._now_ns()) > 0:
            time.sleep(min(1e-9 * left_ns, 0.1))
        return due_ns

    def _jpeg(self, picture: np.ndarray) -> bytes | None:
        """A picture as JPEG; None: it came as one that is not whole, as a webcam's first often does."""
        if self._raw:
            data = picture.tobytes()
            end = data.rfind(JPEG_END)  # a device's buffer may be longer than its picture
            return data[: end + 2] if data.startswith(JPEG_START) and end >= 0 else None
        written, coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, self._settings.jpeg_quality])
        if not written:
            raise CaptureLost(f"{self._name}: a frame of shape {picture.shape} cannot be written as JPEG")
        return coded.tobytes()


def _codec(video: cv2.VideoCapture) -> str:
    return int(video.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=False).decode("ascii", "replace")
