"""A camera as a source: one foxglove.CompressedImage per frame, JPEG. Live from a device, a stream or a video file.

A frame's stamp is its reception (for RTSP without the delay of the decoder) minus `latency_s`, the time from the middle
of the middle row's exposure to reception. `latency_s` depends on the camera and is measured once, by filming a clock
next to the live image of the clock.

Source: recording format in recordings/README.md (/camera/*); ITU-T T.81, B.1.1 and B.2.2 (markers, frame header).
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, ClassVar

import cv2
import numpy as np
from pydantic import Field

from flow.counters import Counters
from flow.link import LinkError, Record, Source, SourceSettings
from links.camera.capture import CaptureSettings, Frame
from links.camera.live_camera import LiveCamera
from links.recording import CompressedImage, decode_compressed_image, encode_compressed_image
from stages.geometry.rig import SizePx, width_height_px
from stages.messages import Image

AS_SENT = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION  # the lens is that of the unturned image
MAX_PIXELS = 4096 * 4096  # of a frame; a larger one is rejected before memory is allocated
SLOW_STATUS_S = 5.0  # how long the status "too slow" is kept after its last event
FRAME_HEADERS = (0xC0, 0xC1, 0xC2)  # baseline, extended, progressive


class CameraSettings(SourceSettings):
    """Settings of `Camera`."""

    topic: str
    source: str | None = None  # live: /dev/video0 (better /dev/v4l/by-id/...), rtsp://..., http://..., a video file
    frame_id: str | None = None  # None: from the topic, /camera/vehicle becomes camera_vehicle
    size_px: SizePx | None = None  # the lens is calibrated for this size; null: not checked
    fps: float = Field(30.0, ge=1, le=240)  # requested from a device
    latency_s: float = Field(0.0, ge=0, le=1)  # from the exposure of the middle row to reception
    readout_ms: float = Field(0.0, ge=0, le=100)  # from the first row's exposure to the last's: a rolling shutter
    timeout_s: float = Field(3.0, gt=0, le=30)  # of a stream: for opening it, and between two frames
    jpeg_quality: int = Field(90, ge=30, le=100)  # for frames that do not arrive as JPEG


class Camera(Source[CameraSettings]):
    """One camera, greyscale. A frame that cannot be decoded is counted in `rejected` and skipped."""

    silent_after_s: ClassVar[float | None] = 4.0  # `timeout_s` is 3 s, and reopening starts immediately

    def __init__(self, settings: CameraSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        size_px = self.settings.size_px
        self._size_px = None if size_px is None else width_height_px(size_px)
        self._rejected: int = 0
        self._counts: Counter[str] = Counter()
        self._slow: tuple[int, float] = (0, 0.0)  # newest count of "too slow", and when it increased

    @property
    def rejected(self) -> int:
        """Number of records without a complete JPEG image."""
        return self._rejected

    @property
    def counters(self) -> Counters:
        """Totals since the start.

        Frames: rejected, damaged, stale (buffered for an unknown time), late (slow decoder), too slow (ten consecutive
        late ones), overtaken (replaced by a newer one). Times: lost, opened again.
        """
        return Counters(self._counts, {"no complete JPEG image": self._rejected})

    @property
    def status(self) -> str | None:
        """See Link: this host decodes the stream more slowly than it arrives."""
        slow, now_s = self._counts["too slow"], time.monotonic()
        if slow > self._slow[0]:
            self._slow = slow, now_s
        if not slow or now_s > self._slow[1] + SLOW_STATUS_S:
            return None
        return "this host decodes the stream more slowly than it arrives: use fewer or smaller images, or MJPEG"

    @contextmanager
    def listen(self) -> Iterator[Iterator[Record]]:
        """Open the camera: `with camera.listen() as records`. LinkError: it cannot be opened, or has another size.

        A camera that is lost later is reopened, without a limit of attempts. A video file plays in real time, and ends.
        """
        settings = self.settings
        if settings.source is None:
            raise LinkError(f"{settings.topic}: set `source` to run live: /dev/video0, a URL, or a video file")
        capture = CaptureSettings(
            settings.source, self._size_px, settings.fps, settings.timeout_s, settings.jpeg_quality
        )
        with LiveCamera(capture, self._counts).open() as frames:
            yield self._records(frames)

    def _records(self, frames: Iterator[Frame]) -> Iterator[Record]:
        settings = self.settings
        frame_id = settings.frame_id or settings.topic.strip("/").replace("/", "_")
        for sequence, frame in enumerate(frames):
            with suppress(ValueError):  # no JPEG: `decode` counts it
                self._check_size(frame.jpeg)
            stamp_ns = frame.received_ns - round(1e9 * settings.latency_s)
            data = encode_compressed_image(CompressedImage(stamp_ns, frame_id, frame.jpeg))
            yield Record(settings.topic, frame.arrival_ns, stamp_ns, data, sequence)

    def _check_size(self, jpeg: bytes) -> None:
        found_px = jpeg_size(jpeg)
        if self._size_px is not None and found_px != self._size_px:
            raise LinkError(
                f"{self.topic}: frames of {found_px[0]} x {found_px[1]} pixels, but the lens is calibrated for "
                f"{self._size_px[0]} x {self._size_px[1]}: set the camera's mode, or calibrate the lens in this one"
            )

    def decode(self, record: Record) -> Image | None:
        """The image of one record, with the record's stamp; None: invalid. LinkError: it has another size."""
        try:
            frame = decode_compressed_image(record.data)
            image = decode_image(record.stamp_ns, frame, 1e-3 * self.settings.readout_ms)
        except (ValueError, LinkError):
            self._rejected += 1
            return None
        self._check_size(frame.data)
        return image


def decode_image(stamp_ns: int, frame: CompressedImage, readout_s: float = 0.0) -> Image:
    """Decode a frame to grey. Raises ValueError for a frame that is no JPEG, incomplete, or above MAX_PIXELS pixels."""
    if frame.format not in ("jpeg", "jpg"):
        raise ValueError(f"a frame in format {frame.format!r}, not JPEG")
    width, height = jpeg_size(frame.data)
    if width * height > MAX_PIXELS:
        raise ValueError(f"a frame of {width} x {height} pixels")
    if not frame.data.rstrip(b"\0").endswith(b"\xff\xd9"):
        raise ValueError("an incomplete JPEG")
    grey = cv2.imdecode(np.frombuffer(frame.data, dtype=np.uint8), AS_SENT)
    if grey is None:
        raise ValueError("a damaged JPEG")
    grey = np.asarray(grey, dtype=np.uint8)
    return Image(stamp_ns=stamp_ns, frame_id=frame.frame_id, grey=grey, readout_s=readout_s)


def jpeg_size(data: bytes) -> tuple[int, int]:
    """(width, height) from a JPEG's frame header. Raises ValueError without one."""
    at = 2
    if data[:2] == b"\xff\xd8":
        while at + 9 <= len(data) and data[at] == 0xFF:
            if data[at + 1] in FRAME_HEADERS:
                return int.from_bytes(data[at + 7 : at + 9]), int.from_bytes(data[at + 5 : at + 7])
            at += 2 + int.from_bytes(data[at + 2 : at + 4])
    raise ValueError("not a JPEG")
