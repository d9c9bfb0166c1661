"""Recorded frames to images: complete ones are decoded, others are counted."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flow.link import LinkError, Record
from flow.message import check_arrays
from links.camera import Camera
from links.camera.camera import decode_image, jpeg_size
from links.recording import CompressedImage, encode_compressed_image


def jpeg(height=48, width=64, progressive=False):
    ramp = np.tile(np.linspace(20, 230, width).astype(np.uint8), (height, 1))
    flags = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive)]
    return ramp, cv2.imencode(".jpg", ramp, flags)[1].tobytes()


def record(data, format="jpeg"):
    frame = CompressedImage(123, "camera_vehicle", data, format)
    return Record("/camera/vehicle", arrival_ns=200, stamp_ns=150, data=encode_compressed_image(frame))


@pytest.mark.parametrize("progressive", [False, True])
def test_a_frame_is_decoded_in_grey_at_the_records_time(progressive):
    ramp, data = jpeg(progressive=progressive)
    camera = Camera(topic="/camera/vehicle")
    image = camera.decode(record(data))
    assert image is not None
    check_arrays(image)
    assert (image.stamp_ns, image.frame_id) == (150, "camera_vehicle")
    assert np.abs(image.grey.astype(int) - ramp).max() < 6
    assert camera.rejected == 0


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_an_image_is_not_turned_by_its_exif_orientation(orientation: int):
    """The lens, the masks and the size are those of the image as it was sent."""
    ramp, data = jpeg()
    tag = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0" + bytes([orientation, 0, 0, 0]) + bytes(4)
    exif = b"Exif\0\0" + tag
    turned = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    shown = cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert (np.abs(shown[0].astype(int) - shown[0, 0]).max() < 9) == (orientation in (6, 8))  # OpenCV would turn it
    image = Camera(topic="/camera/vehicle").decode(record(turned))
    assert image is not None
    assert np.abs(image.grey.astype(int) - ramp).max() < 6


def test_an_image_contains_its_readout_time():
    image = Camera(topic="/camera/vehicle", readout_ms=23.5).decode(record(jpeg(48, 64)[1]))
    assert image is not None
    assert image.readout_s == pytest.approx(0.0235)
    assert image.rows_after_s() == pytest.approx(0.0235 / 47)


@pytest.mark.parametrize("size_px", [64, (48, 64), 720])
def test_an_image_of_another_size_than_the_lenss_is_refused(size_px):
    """The lens would give each of its pixels another direction."""
    camera, other = Camera(topic="/camera/vehicle", size_px=size_px), record(jpeg(48, 64)[1])
    with pytest.raises(LinkError, match="frames of 64 x 48 pixels, but the lens is calibrated for"):
        camera.decode(other)
    assert Camera(topic="/camera/vehicle", size_px=(64, 48)).decode(other) is not None
    assert Camera(topic="/camera/vehicle", size_px=48).decode(record(jpeg(48, 48)[1])) is not None


def test_the_size_is_read_without_decoding():
    assert jpeg_size(jpeg(48, 64)[1]) == (64, 48)
    with pytest.raises(ValueError, match="not a JPEG"):
        jpeg_size(b"\x89PNG....")


def test_a_huge_frame_is_rejected_before_memory_is_allocated():
    _, data = jpeg()
    at = data.index(b"\xff\xc0") + 5
    huge = data[:at] + b"\xff\xff\xff\xff" + data[at + 4 :]
    with pytest.raises(ValueError, match="65535 x 65535"):
        decode_image(0, CompressedImage(0, "", huge))


@pytest.mark.parametrize("data", [b"", b"\xff\xd8", b"\xff\xd8\xff\xe0\x00\x00" * 3, jpeg()[1][:-30], b"GIF89a"])
def test_a_damaged_frame_is_counted_and_skipped(data):
    camera = Camera(topic="/camera/vehicle")
    assert camera.decode(record(data)) is None
    assert camera.rejected == 1


def test_another_format_or_no_protobuf_is_counted_and_skipped():
    camera = Camera(topic="/camera/vehicle")
    assert camera.decode(record(jpeg()[1], "png")) is None
    assert camera.decode(Record("/camera/vehicle", 2, 1, b"\xff\xff\xff")) is None
    assert camera.rejected == 2
