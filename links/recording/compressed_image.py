"""foxglove.CompressedImage in protobuf, written out by hand: four fields need no protobuf library.

Source: https://docs.foxglove.dev/docs/sdk/schemas/compressed-image (field numbers);
https://protobuf.dev/programming-guides/encoding/ (wire format); google/protobuf/descriptor.proto (the schema's own).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from flow.link import LinkError

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  # wire types
_TYPE_INT64, _TYPE_INT32, _TYPE_STRING, _TYPE_MESSAGE, _TYPE_BYTES = 3, 5, 9, 11, 12  # FieldDescriptorProto.Type
_OPTIONAL = 1  # FieldDescriptorProto.Label


@dataclass(frozen=True, slots=True)
class CompressedImage:
    """One camera frame as recorded."""

    stamp_ns: int
    frame_id: str  # "camera_vehicle", "camera_drone"
    data: bytes
    format: str = "jpeg"


def encode_compressed_image(image: CompressedImage) -> bytes:
    """The protobuf bytes of a frame: what a camera record's `data` holds."""
    seconds, nanos = divmod(image.stamp_ns, 1_000_000_000)
    timestamp = _number(1, seconds) + _number(2, nanos)
    return _field(1, timestamp) + _field(2, image.data) + _field(3, image.format) + _field(4, image.frame_id)


def decode_compressed_image(data: bytes) -> CompressedImage:
    """A frame from its protobuf bytes; LinkError when they are damaged. Unknown fields are skipped."""
    stamp_ns, values = 0, {2: b"", 3: b"", 4: b""}
    for number, value in _fields(data):
        if number == 1 and isinstance(value, bytes):
            parts = dict(_fields(value))
            seconds, nanos = parts.get(1, 0), parts.get(2, 0)
            if not isinstance(seconds, int) or not isinstance(nanos, int):
                raise LinkError("camera record: the timestamp is damaged; `grd recover` the recording")
            stamp_ns = seconds * 1_000_000_000 + nanos
        elif number in values and isinstance(value, bytes):
            values[number] = value
    try:
        return CompressedImage(stamp_ns, values[4].decode(), values[2], values[3].decode())
    except UnicodeDecodeError:
        raise LinkError("camera record: frame_id or format is no text; `grd recover` the recording") from None


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _number(number: int, value: int) -> bytes:
    return _varint(number << 3 | _VARINT) + _varint(value & 0xFFFF_FFFF_FFFF_FFFF)


def _field(number: int, value: bytes | str) -> bytes:
    raw = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | _BYTES) + _varint(len(raw)) + raw


def _fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """(field number, value) of one protobuf message; values of wire types 0 and 2, the fixed ones are skipped."""
    offset = 0
    while offset < len(data):
        key, offset = _read_varint(data, offset)
        wire = key & 7
        if wire == _VARINT:
            value, offset = _read_varint(data, offset)
            yield key >> 3, value
            continue
        if wire == _BYTES:
            size, offset = _read_varint(data, offset)
        elif wire in (_FIXED64, _FIXED32):
            size = 8 if wire == _FIXED64 else 4
        else:
            raise LinkError(f"camera record: unknown protobuf wire type {wire} at byte {offset}")
        if offset + size > len(data):
            raise LinkError(f"camera record: a field of {size} bytes at byte {offset} of {len(data)} is cut off")
        if wire == _BYTES:
            yield key >> 3, data[offset : offset + size]
        offset += size


def _read_varint(data: bytes, offset: int) -> tuple[int, int]:
    value = 0
    for i, byte in enumerate(data[offset : offset + 10]):
        value |= (byte & 0x7F) << 7 * i
        if byte < 0x80:
            return value, offset + i + 1
    raise LinkError(f"camera record: the protobuf number at byte {offset} does not end")


def _declare(name: str, number: int, kind: int, type_name: str = "") -> bytes:
    """FieldDescriptorProto, as field 2 of DescriptorProto."""
    out = _field(1, name) + _number(3, number) + _number(4, _OPTIONAL) + _number(5, kind)
    return _field(2, out + (_field(6, type_name) if type_name else b""))


def _file(name: str, package: str, dependencies: list[str], message: str, fields: bytes) -> bytes:
    """FileDescriptorProto, as field 1 of FileDescriptorSet."""
    out = _field(1, name) + _field(2, package) + b"".join(_field(3, d) for d in dependencies)
    return _field(1, out + _field(4, _field(1, message) + fields) + _field(12, "proto3"))


COMPRESSED_IMAGE_SCHEMA = _file(
    "google/protobuf/timestamp.proto",
    "google.protobuf",
    [],
    "Timestamp",
    _declare("seconds", 1, _TYPE_INT64) + _declare("nanos", 2, _TYPE_INT32),
) + _file(
    "foxglove/CompressedImage.proto",
    "foxglove",
    ["google/protobuf/timestamp.proto"],
    "CompressedImage",
    _declare("timestamp", 1, _TYPE_MESSAGE, ".google.protobuf.Timestamp")
    + _declare("data", 2, _TYPE_BYTES)
    + _declare("format", 3, _TYPE_STRING)
    + _declare("frame_id", 4, _TYPE_STRING),
)
"""FileDescriptorSet of foxglove.CompressedImage: what MCAP stores as the camera topics' schema."""
