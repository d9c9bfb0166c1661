"""A camera as a source: one foxglove.CompressedImage per frame, JPEG.

Source: recording format in recordings/README.md (/camera/*); ITU-T T.81, B.1.1 and B.2.2 (markers, frame header).
"""

from __future__ import annotations

import cv2
import numpy as np
from pydantic import PrivateAttr

from flow.link import LinkError, Record, Source
from links.recording import CompressedImage, decode_compressed_image
from stages.messages import Image

MAX_PIXELS = 4096 * 4096  # of a frame; a larger one is refused before it takes memory
FRAME_HEADERS = (0xC0, 0xC1, 0xC2)  # baseline, extended, progressive


class Camera(Source):
    """Frames of one camera, in grey. A frame that cannot be decoded is counted in `refused` and left out."""

    topic: str
    _refused: int = PrivateAttr(default=0)

    @property
    def refused(self) -> int:
        """Records that held no whole JPEG image."""
        return self._refused

    def decode(self, record: Record) -> Image | None:
        """The image of one record, stamped as the record is."""
        try:
            return decode_image(record.stamp_ns, decode_compressed_image(record.data))
        except (ValueError, LinkError):
            self._refused += 1
            return None


def decode_image(stamp_ns: int, frame: CompressedImage) -> Image:
    """A frame in grey. Raises ValueError when it is no JPEG, is cut off, or has more than MAX_PIXELS pixels."""
    if frame.format not in ("jpeg", "jpg"):
        raise ValueError(f"a frame in format {frame.format!r}; record JPEG")
    width, height = jpeg_size(frame.data)
    if width * height > MAX_PIXELS:
        raise ValueError(f"a frame of {width} x {height} pixels")
    if not frame.data.rstrip(b"\0").endswith(b"\xff\xd9"):
        raise ValueError("a JPEG that is cut off")
    grey = cv2.imdecode(np.frombuffer(frame.data, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise ValueError("a damaged JPEG")
    return Image(stamp_ns=stamp_ns, frame_id=frame.frame_id, grey=np.asarray(grey, dtype=np.uint8))


def jpeg_size(data: bytes) -> tuple[int, int]:
    """(width, height) from a JPEG's frame header; ValueError when there is none."""
    at = 2
    if data[:2] == b"\xff\xd8":
        while at + 9 <= len(data) and data[at] == 0xFF:
            if data[at + 1] in FRAME_HEADERS:
                return int.from_bytes(data[at + 7 : at + 9]), int.from_bytes(data[at + 5 : at + 7])
            at += 2 + int.from_bytes(data[at + 2 : at + 4])
    raise ValueError("no JPEG")
