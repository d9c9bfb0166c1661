"""The one encoding of messages as bytes, between processes and between hosts, made from the classes' annotations.

    offset  bytes  what
    0       4      "GRDm"
    4       1      version of this format
    5       8      fingerprint of the class: its fields, their types, dtypes and shapes
    13      4      CRC-32 of the name and the body
    17      4      length of the body
    21      1+n    name of the class
    ...            body: the fields in order

All numbers are little-endian. int: 8 bytes, signed; float: 8; bool: 1; str and bytes: length (4), then the bytes; enum:
its member's name as str; X | None: a byte 0 or 1, then X; a dataclass: its fields in order; X | Y of dataclasses: the
index of the class (1), then its fields; tuple[X, ...]: count (4), then each; an array: its sizes (4 each), then its
elements in C order. A reader accepts only classes that it expects and whose fingerprint equals its own.
So two versions of grd with different fields of a message do not misread each other.

Bytes may be hostile: every length is checked against the bytes that are left before memory is allocated, every array
against its declared dtype and shape. Every defect raises CodecError.

Source: ours. Pickle executes what it reads; JSON has no arrays; protobuf would declare every message a second time.
"""

from __future__ import annotations

import functools
import hashlib
import struct
import zlib
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, get_type_hints

from flow.message import Message
from flow.remote.codec_fields import CodecError, Field, Reader, Sizes, Writer, field_of

MAGIC, VERSION = b"GRDm", 1
MAX_BYTES = 16 * 2**20  # a grey image of 4096 x 4096
_HEAD = struct.Struct("<4sB8sIIB")


class Encoding:
    """How the messages of one class are encoded."""

    def __init__(self, cls: type[Message]) -> None:
        hints = get_type_hints(cls, include_extras=True)
        self.cls = cls
        self.name = cls.__name__.encode()
        self.fields: list[tuple[str, Field]] = []
        for field in fields(cls):
            try:
                self.fields.append((field.name, field_of(hints[field.name])))
            except TypeError as error:
                raise TypeError(
                    f"{cls.__name__}.{field.name} cannot cross to another process or host: {error}"
                ) from None
        signature = ";".join(f"{name}:{field.signature}" for name, field in self.fields)
        self.fingerprint = hashlib.blake2b(f"{cls.__name__}({signature})".encode(), digest_size=8).digest()


@functools.cache
def encoding_of(cls: type[Message]) -> Encoding:
    """The encoding of a class. TypeError: a field has a type that cannot be encoded."""
    return Encoding(cls)


def encode(message: Message) -> bytes:
    """A message as bytes. CodecError: a value is not what the class declares."""
    encoding = encoding_of(type(message))
    parts: Writer = []
    sizes: Sizes = {}
    for name, field in encoding.fields:
        try:
            field.write(parts, getattr(message, name), sizes)
        except (ValueError, struct.error, TypeError, AttributeError) as error:
            raise CodecError(f"{type(message).__name__}.{name}: {error}") from None
    length = sum(len(part) for part in parts)
    if length > MAX_BYTES:
        raise CodecError(f"{type(message).__name__} has {length} bytes; a message may have {MAX_BYTES}")
    crc = zlib.crc32(encoding.name)
    for part in parts:
        crc = zlib.crc32(part, crc)
    head = _HEAD.pack(MAGIC, VERSION, encoding.fingerprint, crc, length, len(encoding.name))
    return b"".join((head, encoding.name, *parts))


def decode(data: bytes, expected: Mapping[str, type[Message]], start: int = 0) -> Message:
    """The message in `data` from `start` to its end, of one of the `expected` classes (by name). CodecError: none."""
    body_at = start + _HEAD.size
    if not body_at <= len(data) <= MAX_BYTES + body_at + 255:
        raise CodecError(f"{len(data) - start} bytes are no message")
    magic, version, fingerprint, crc, length, name_length = _HEAD.unpack_from(data, start)
    if magic != MAGIC or version != VERSION:
        raise CodecError(f"these bytes are no message of version {VERSION}; do both hosts run the same grd?")
    if body_at + name_length + length != len(data):
        raise CodecError(f"{len(data) - body_at} bytes instead of {name_length + length}")
    if zlib.crc32(memoryview(data)[body_at:]) != crc:
        raise CodecError("wrong checksum: the bytes are damaged")
    cls = expected.get(data[body_at : body_at + name_length].decode("ascii", "replace"))
    if cls is None:
        raise CodecError(f"a message of another class; expected {' or '.join(expected)}")
    encoding = encoding_of(cls)
    if fingerprint != encoding.fingerprint:
        raise CodecError(f"{cls.__name__} has other fields at the sender: both hosts must run the same version of grd")
    reader = Reader(data, body_at + name_length)
    sizes: Sizes = {}
    values: dict[str, Any] = {}
    name = ""
    try:
        for name, field in encoding.fields:
            values[name] = field.read(reader, sizes)
    except CodecError as error:
        raise CodecError(f"{cls.__name__}.{name}: {error}") from None
    reader.end()
    return cls(**values)
