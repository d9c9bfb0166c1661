"""Messages: declared arrays, port names, hashing."""

from __future__ import annotations

import dataclasses
import enum
import hashlib
from typing import Annotated

import numpy as np
import pytest
from numpy.typing import NDArray

from flow.message import (
    Mat3,
    Message,
    PerPointU8,
    Points32,
    Shape,
    array_fields,
    check_arrays,
    hash_into,
    message,
    nested_fields,
    port_name,
)


class Colour(enum.Enum):
    RED = 1


@message
class Cloud(Message):
    xyz_m: Points32
    ring: PerPointU8
    covariance_m2: Mat3
    image: Annotated[NDArray[np.uint16], Shape("h", "w")]
    colour: Colour
    reasons: tuple[str, ...]


def cloud(**changes):
    fields = {
        "stamp_ns": 7,
        "xyz_m": np.zeros((4, 3), np.float32),
        "ring": np.zeros(4, np.uint8),
        "covariance_m2": np.eye(3),
        "image": np.zeros((2, 5), np.uint16),
        "colour": Colour.RED,
        "reasons": ("a", "bc"),
    }
    return Cloud(**(fields | changes))


def digests(value):
    values, texts = hashlib.blake2b(), hashlib.blake2b()
    hash_into(values, texts, value)
    return values.hexdigest(), texts.hexdigest()


def digest(value):
    return digests(value)[0]


def test_what_comes_before_a_message_is_hashed_as_its_own_update():
    apart, together, texts = hashlib.blake2b(b"@7"), hashlib.blake2b(), hashlib.blake2b()
    hash_into(apart, texts, cloud())
    hash_into(together, texts, cloud(), b"@7")
    assert together.hexdigest() == apart.hexdigest() != digest(cloud())


def test_the_hash_of_a_large_array_is_that_of_its_bytes_in_any_memory_order():
    for rows in (4, 4096):  # copied, and as a view
        points = np.arange(3.0 * rows).reshape(rows, 3)
        assert digest(points) == digest(np.asfortranarray(points)) != digest(-points)


def test_an_output_is_named_after_its_message():
    names = {"DroneFix": "drone_fix", "LidarFirings": "lidar_firings", "VPRotation": "vp_rotation"}
    assert {n: port_name(type(n, (Message,), {})) for n in names} == names


def test_a_message_cannot_be_changed_or_given_new_fields():
    with pytest.raises(dataclasses.FrozenInstanceError):
        cloud().stamp_ns = 8
    with pytest.raises((AttributeError, TypeError)):
        object.__setattr__(cloud(), "new", 1)


def test_arrays_as_declared_pass():
    check_arrays(cloud())


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"xyz_m": np.zeros((4, 3))}, r"Cloud\.xyz_m: declared float32 \(n, 3\), got float64 \(4, 3\)"),
        ({"xyz_m": np.zeros((4, 2), np.float32)}, r"Cloud\.xyz_m: declared \(n, 3\) with 3 = 3, got \(4, 2\)"),
        ({"ring": np.zeros(5, np.uint8)}, r"Cloud\.ring: declared \(n,\) with n = 4, got \(5,\)"),
        ({"covariance_m2": np.zeros(3)}, r"Cloud\.covariance_m2: declared float64 \(3, 3\), got float64 \(3,\)"),
        ({"image": [[1]]}, r"Cloud\.image: declared uint16 \(h, w\), got int64 \(1, 1\)"),
    ],
)
def test_arrays_of_another_type_or_shape_are_named(changes, text):
    with pytest.raises(TypeError, match=text):
        check_arrays(cloud(**changes))


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Flat:
    ring: PerPointU8


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Deep:
    flat: Flat
    covariance_m2: Mat3


@message
class Nested(Message):
    xyz_m: Points32
    shape: Flat | Deep | None
    deep: Deep | None = None


def flat(n=4):
    return Flat(ring=np.zeros(n, np.uint8))


def deep(n=4, covariance_m2=None):
    return Deep(flat=flat(n), covariance_m2=np.eye(3) if covariance_m2 is None else covariance_m2)


def test_arrays_in_nested_dataclasses_belong_to_the_message():
    assert nested_fields(Nested) == (("shape", (Flat, Deep)), ("deep", (Deep,)))
    assert [name for name, _, _ in array_fields(Nested)] == [
        "xyz_m",
        "shape.ring",
        "shape.covariance_m2",
        "shape.flat.ring",
        "deep.covariance_m2",
        "deep.flat.ring",
    ]
    for shape in (None, flat(), deep()):
        check_arrays(Nested(stamp_ns=0, xyz_m=np.zeros((4, 3), np.float32), shape=shape, deep=deep()))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"shape": flat(3)}, r"Nested\.shape\.ring: declared \(n,\) with n = 4, got \(3,\)"),
        ({"shape": deep(3)}, r"Nested\.shape\.flat\.ring: declared \(n,\) with n = 4, got \(3,\)"),
        ({"deep": deep(covariance_m2=np.eye(2))}, r"Nested\.deep\.covariance_m2: declared \(3, 3\) with 3 = 3"),
        ({"deep": deep(covariance_m2=[1])}, r"Nested\.deep\.covariance_m2: declared float64 \(3, 3\), got int64"),
        ({"deep": flat()}, r"Nested\.deep: declared Deep, got Flat"),
        ({"shape": "none"}, r"Nested\.shape: declared Flat \| Deep, got str"),
    ],
)
def test_wrong_arrays_in_nested_dataclasses_are_named(changes, text):
    fields = {"xyz_m": np.zeros((4, 3), np.float32), "shape": None}
    with pytest.raises(TypeError, match=text):
        check_arrays(Nested(stamp_ns=0, **(fields | changes)))


@pytest.mark.parametrize(
    "changes",
    [
        {"stamp_ns": 8},
        {"ring": np.array([0, 0, 0, 1], np.uint8)},
        {"image": np.zeros((5, 2), np.uint16)},
        {"reasons": ("a", "b", "c")},
        {"covariance_m2": -0.0 * np.eye(3) + np.eye(3) * 1.0000000000000002},
    ],
)
def test_the_hash_sees_every_bit(changes):
    assert digest(cloud()) != digest(cloud(**changes))


def test_the_hash_is_that_of_the_content_not_of_the_memory():
    wide = np.zeros((4, 6), np.float32)[:, ::2]  # not contiguous
    assert digest(cloud()) == digest(cloud(xyz_m=wide))
    empty = np.zeros((0, 3), np.float32)
    assert digest(cloud(xyz_m=empty)) != digest(cloud())


def test_a_text_changes_the_hash_of_the_texts_alone():
    values, texts = digests(cloud())
    changed = digests(cloud(reasons=("ab", "c")))
    assert changed[0] == values
    assert changed[1] != texts


@message(schema=901)
class Before(Message):
    level: int
    colour: Colour


class Color(enum.Enum):
    CRIMSON = 1


@message(schema=901)
class After(Message):
    height: int
    color: Color


@message(schema=902)
class Other(Message):
    level: int
    colour: Colour


def test_a_renamed_class_field_or_enum_member_keeps_the_hash():
    before = digests(Before(stamp_ns=1, level=2, colour=Colour.RED))
    assert digests(After(stamp_ns=1, height=2, color=Color.CRIMSON)) == before
    assert digests(After(stamp_ns=1, height=3, color=Color.CRIMSON)) != before
    assert digests(Other(stamp_ns=1, level=2, colour=Colour.RED)) != before


def test_a_message_without_a_number_is_hashed_under_its_own_name():
    assert (Cloud.schema, Before.schema) == ("cloud", "901")


def test_what_cannot_be_hashed_raises():
    with pytest.raises(TypeError, match=r"a message may not hold a dict"):
        digest({"a": 1})
