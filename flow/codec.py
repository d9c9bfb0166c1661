"""Messages as bytes, to cross a network: any `Message` class, nothing declared beside it.

    offset  bytes  what
    0       4      "GRDm"
    4       1      version of this format
    5       8      fingerprint of the class: its fields, their types, dtypes and shapes
    13      4      CRC-32 of the name and the body
    17      4      length of the body
    21      1+n    name of the class
    ...            body: the fields in order

All numbers are little-endian. int: 8 bytes, signed; float: 8; bool: 1; str and bytes: length (4), then the bytes; enum:
its member's name as str; X | None: a byte 0 or 1, then X; tuple[X, ...]: count (4), then each; an array: its sizes (4
each), then its elements in C order. A reader takes only classes that it expects and whose fingerprint is its own: two
versions of grd that disagree about a message do not misread each other.

Hostile bytes: every length is held against the bytes that are there before anything is made, every array against its
declared dtype and shape. Whatever is wrong is one error, CodecError.

Source: ours. Pickle runs what it reads; JSON has no arrays; protobuf would declare every message a second time.
"""

from __future__ import annotations

import functools
import hashlib
import struct
import zlib
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, get_type_hints

from flow.codec_fields import CodecError, Field, Reader, Sizes, Writer, field_of
from flow.message import Message

MAGIC, VERSION = b"GRDm", 1
MAX_BYTES = 16 * 2**20  # a grey picture of 4096 x 4096
_HEAD = struct.Struct("<4sB8sIIB")


class Plan:
    """How one message class is written."""

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
        told = ";".join(f"{name}:{field.told}" for name, field in self.fields)
        self.fingerprint = hashlib.blake2b(f"{cls.__name__}({told})".encode(), digest_size=8).digest()


@functools.cache
def plan_of(cls: type[Message]) -> Plan:
    """The plan of a class, made once. TypeError: a field of it has a type that does not travel."""
    return Plan(cls)


def encode(message: Message) -> bytes:
    """A message as bytes. CodecError when it does not hold what its class declares."""
    plan = plan_of(type(message))
    parts: Writer = []
    sizes: Sizes = {}
    for name, field in plan.fields:
        try:
            field.write(parts, getattr(message, name), sizes)
        except (ValueError, struct.error, TypeError, AttributeError) as error:
            raise CodecError(f"{type(message).__name__}.{name}: {error}") from None
    length = sum(len(part) for part in parts)
    if length > MAX_BYTES:
        raise CodecError(f"{type(message).__name__} has {length} bytes; a message may have {MAX_BYTES}")
    crc = zlib.crc32(plan.name)
    for part in parts:
        crc = zlib.crc32(part, crc)
    head = _HEAD.pack(MAGIC, VERSION, plan.fingerprint, crc, length, len(plan.name))
    return b"".join((head, plan.name, *parts))


def decode(data: bytes, expected: Mapping[str, type[Message]], start: int = 0) -> Message:
    """The message in `data` from `start`, of one of the `expected` classes (by name). CodecError for anything else."""
    body_at = start + _HEAD.size
    if not body_at <= len(data) <= MAX_BYTES + body_at + 255:
        raise CodecError(f"{len(data) - start} bytes are no message")
    magic, version, fingerprint, crc, length, name_length = _HEAD.unpack_from(data, start)
    if magic != MAGIC or version != VERSION:
        raise CodecError(f"these bytes are no message of version {VERSION}; do both hosts run the same grd?")
    if body_at + name_length + length != len(data):
        raise CodecError(f"{len(data) - body_at} bytes where {name_length + length} were said")
    if zlib.crc32(memoryview(data)[body_at:]) != crc:
        raise CodecError("the checksum does not fit: damaged on the way")
    cls = expected.get(data[body_at : body_at + name_length].decode("ascii", "replace"))
    if cls is None:
        raise CodecError(f"a message of another kind came; expected {' or '.join(expected)}")
    plan = plan_of(cls)
    if fingerprint != plan.fingerprint:
        raise CodecError(f"{cls.__name__} has other fields at the sender: both hosts must run the same version of grd")
    reader = Reader(data, body_at + name_length)
    sizes: Sizes = {}
    values: dict[str, Any] = {}
    name = ""
    try:
        for name, field in plan.fields:
            values[name] = field.read(reader, sizes)
    except CodecError as error:
        raise CodecError(f"{cls.__name__}.{name}: {error}") from None
    reader.end()
    return cls(**values)
