"""foxglove.CompressedImage in protobuf: against bytes of the protobuf library, and against damage."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flow.link import LinkError
from links.recording import CompressedImage, decode_compressed_image, encode_compressed_image
from links.recording.compressed_image import COMPRESSED_IMAGE_SCHEMA

IMAGE = CompressedImage(1_600_000_000_123_456_789, "camera_drone", b"\xff\xd8abc")
# What the protobuf package writes for IMAGE, given foxglove's CompressedImage.proto.
BYTES = bytes.fromhex(
    "0a0b0880a0f8fa0510959aef3a1205ffd86162631a046a706567220c63616d6572615f64726f6e65",
)


def test_the_bytes_are_those_of_the_protobuf_library():
    assert encode_compressed_image(IMAGE) == BYTES
    assert decode_compressed_image(BYTES) == IMAGE


@given(
    st.integers(0, 2**62),
    st.text(max_size=20),
    st.binary(max_size=300),
    st.sampled_from(["jpeg", "png", "webp", "avif"]),
)
def test_an_image_round_trips(stamp_ns: int, frame_id: str, data: bytes, image_format: str):
    image = CompressedImage(stamp_ns, frame_id, data, image_format)
    assert decode_compressed_image(encode_compressed_image(image)) == image


def test_unknown_fields_are_skipped():
    extra = b"\x28\x96\x01" + b"\x31" + bytes(8) + b"\x3d" + bytes(4) + b"\x42\x02hi"  # fields 5 to 8, one of each kind
    assert decode_compressed_image(extra + BYTES) == IMAGE


def test_empty_bytes_are_an_empty_image():
    assert decode_compressed_image(b"") == CompressedImage(0, "", b"", "")


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (BYTES[:18], "is cut off"),
        (b"\x80" * 12, "does not end"),
        (b"\x0b", "unknown protobuf wire type 3"),
        (b"\x22\x01\xff", "is no text"),
        (b"\x0a\x02\x0a\x00", "the timestamp is damaged"),
    ],
)
def test_damaged_bytes_are_an_error(data: bytes, text: str):
    with pytest.raises(LinkError, match=text):
        decode_compressed_image(data)


@given(st.binary(max_size=60))
def test_random_bytes_raise_only_link_errors(data: bytes):
    try:
        decode_compressed_image(data)
    except LinkError:
        return


def test_the_schema_names_its_types():
    for name in (b"foxglove", b"CompressedImage", b".google.protobuf.Timestamp", b"frame_id", b"proto3"):
        assert name in COMPRESSED_IMAGE_SCHEMA
