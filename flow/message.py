"""Messages: what travels on an edge of the graph.

One frozen, slotted dataclass per meaning and frame, so that a wrong wire fails when the graph is loaded.
Arrays declare element type and shape once, in the annotation; `check_arrays` reads them there.

Source: ours.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import re
import struct
import types
from collections.abc import Callable
from operator import attrgetter
from typing import (
    Annotated,
    Any,
    ClassVar,
    Protocol,
    TypeVar,
    Union,
    cast,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
    overload,
)

import numpy as np
from numpy.typing import NDArray

C = TypeVar("C", bound=type)


def port_name(message_type: type[Any]) -> str:
    """Output port of a message type: `DroneFix` -> `drone_fix`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", message_type.__name__).lower()


@overload
def message(cls: C, /) -> C: ...
@overload
def message(*, schema: int) -> Callable[[C], C]: ...


@dataclass_transform(frozen_default=True, eq_default=False, kw_only_default=True)
def message(cls: C | None = None, /, *, schema: int | None = None) -> C | Callable[[C], C]:
    """Make a `Message` subclass a frozen, slotted, keyword-only dataclass (identity equality: it holds arrays).

    `schema` is the message type's number in output hashes. It stays when the class or a field is renamed; a type whose
    fields change in number, order or meaning gets a new one. A type without a number is hashed under its own name.
    """

    def make(cls: C) -> C:
        made = cast(Any, dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)(cls))
        made.schema = port_name(made) if schema is None else str(schema)
        return made

    return make if cls is None else make(cls)


@message
class Message:
    """Base of all messages. `stamp_ns` is when the content was true [ns], never when it arrived."""

    schema: ClassVar[str] = ""
    """What output hashes call this type: see `message`."""

    stamp_ns: int


@dataclasses.dataclass(frozen=True, slots=True)
class Shape:
    """Declared array shape: a number is exact, a letter binds to one size within a message.

    `xyz_lidar_m: Annotated[NDArray[np.float32], Shape("n", 3)]`
    """

    dims: tuple[int | str, ...]

    def __init__(self, *dims: int | str) -> None:
        object.__setattr__(self, "dims", dims)

    def __str__(self) -> str:
        return "(" + ", ".join(str(d) for d in self.dims) + ("," if len(self.dims) == 1 else "") + ")"


# Array types that messages use; the field's name has the unit.
Vec3 = Annotated[NDArray[np.float64], Shape(3)]
Mat3 = Annotated[NDArray[np.float64], Shape(3, 3)]
Mat6 = Annotated[NDArray[np.float64], Shape(6, 6)]
Points32 = Annotated[NDArray[np.float32], Shape("n", 3)]
Points64 = Annotated[NDArray[np.float64], Shape("n", 3)]
PerPointF32 = Annotated[NDArray[np.float32], Shape("n")]
PerPointF64 = Annotated[NDArray[np.float64], Shape("n")]
PerPointI64 = Annotated[NDArray[np.int64], Shape("n")]
PerPointU8 = Annotated[NDArray[np.uint8], Shape("n")]
PerPointBool = Annotated[NDArray[np.bool_], Shape("n")]


@functools.cache
def nested_fields(cls: type[Any]) -> tuple[tuple[str, tuple[type[Any], ...]], ...]:
    """(field, classes) of each field of a dataclass that holds a dataclass, one of several (`X | Y`), or None."""
    hints = get_type_hints(cls)
    found: list[tuple[str, tuple[type[Any], ...]]] = []
    for field in dataclasses.fields(cls):
        hint = hints[field.name]
        kinds: tuple[Any, ...] = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
        if nested := tuple(kind for kind in kinds if isinstance(kind, type) and dataclasses.is_dataclass(kind)):
            found.append((field.name, cast("tuple[type[Any], ...]", nested)))
    return tuple(found)


@functools.cache
def array_fields(cls: type[Any]) -> tuple[tuple[str, np.dtype[Any], Shape], ...]:
    """(field, dtype, shape) of each declared array field of a message type; in a nested dataclass: `field.inner`."""
    found = list(_own_array_fields(cls))
    for name, nested in nested_fields(cls):
        found += [(f"{name}.{inner}", dtype, shape) for kind in nested for inner, dtype, shape in array_fields(kind)]
    return tuple(dict.fromkeys(found))


@functools.cache
def _own_array_fields(cls: type[Any]) -> tuple[tuple[str, np.dtype[Any], Shape], ...]:
    found: list[tuple[str, np.dtype[Any], Shape]] = []
    for name, hint in get_type_hints(cls, include_extras=True).items():
        if get_origin(hint) is not Annotated:
            continue
        base, *extras = get_args(hint)
        shape = next((x for x in extras if isinstance(x, Shape)), None)
        if shape is not None:
            dtype = get_args(get_args(base)[1])[0]  # NDArray[T] is ndarray[shape, dtype[T]]
            found.append((name, np.dtype(dtype), shape))
    return tuple(found)


def check_arrays(message: Message) -> None:
    """Raise TypeError when an array's dtype or shape is not what the message type declares, also in its dataclasses.

    A letter of a shape is one size in the whole message.
    """
    _check_arrays(message, type(message).__name__, {})


def _check_arrays(holder: Any, path: str, sizes: dict[str, int]) -> None:
    for name, dtype, shape in _own_array_fields(holder.__class__):
        value: Any = getattr(holder, name)
        where = f"{path}.{name}"
        array: NDArray[Any] = np.asarray(value)
        if array is not value or array.dtype != dtype or array.ndim != len(shape.dims):
            raise TypeError(f"{where}: declared {dtype} {shape}, got {array.dtype} {array.shape}")
        for declared, size in zip(shape.dims, array.shape, strict=True):
            wanted = sizes.setdefault(declared, size) if isinstance(declared, str) else declared
            if size != wanted:
                raise TypeError(f"{where}: declared {shape} with {declared} = {wanted}, got {array.shape}")
    for name, nested in nested_fields(holder.__class__):
        inner: Any = getattr(holder, name)
        if inner.__class__ in nested:
            _check_arrays(inner, f"{path}.{name}", sizes)
        elif inner is not None:
            declared = " | ".join(kind.__name__ for kind in nested)
            raise TypeError(f"{path}.{name}: declared {declared}, got {inner.__class__.__name__}")


class Hasher(Protocol):
    """The part of hashlib's objects that `hash_into` needs."""

    def update(self, data: Any, /) -> None: ...


_pack_float = struct.Struct("<d").pack
SMALL_BYTES = 2048  # copying a smaller array takes less time than a view of it


@functools.lru_cache(maxsize=4096)  # few types and shapes, hashed often
def _array_header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """An array's type and shape, as they are hashed."""
    return f"[{dtype.str}{shape}".encode()


class _Parts:
    """The bytes of one message: its values with their types, and its texts."""

    __slots__ = ("texts", "values")

    def __init__(self) -> None:
        self.values: list[Any] = []
        self.texts: list[bytes] = []


def hash_into(values: Hasher, texts: Hasher, value: Any, before: bytes = b"") -> None:
    """Feed `before` and a message's values into one hash, to the last bit and with types, and its texts into another.

    Names of classes, fields and enum members are not hashed: a message type counts by its `schema`, a field by its
    position, an enum member by its value. TypeError for a type that a message may not hold.

    Each hash is updated once: hashlib releases Python's lock for each buffer beyond 2 kB, and has to wait for it again.
    """
    parts = _Parts()
    parts.values.append(before)
    _add(parts, value)
    values.update(b"".join(parts.values))
    if parts.texts:
        texts.update(b"".join(parts.texts))


Adder = Callable[[_Parts, Any], None]
_adders: dict[type[Any], Adder] = {}  # by type: needed for each field of each message


def _add(parts: _Parts, value: Any) -> None:
    cls: Any = value.__class__
    (_adders.get(cls) or _adder_of(value, cls))(parts, value)


def _adder_of(value: Any, cls: type[Any]) -> Adder:
    """What writes values of this one's type."""
    if dataclasses.is_dataclass(cls):
        add = _fields_adder(cls)
    else:
        add = next((add for kind, add in _KINDS if isinstance(value, kind)), None)
    if add is None:
        raise TypeError(f"a message may not hold a {cls.__name__}: {value!r}")
    _adders[cls] = add
    return add


def _fields_adder(cls: type[Any]) -> Adder:
    header, names = b"{" + getattr(cls, "schema", "").encode(), [field.name for field in dataclasses.fields(cls)]
    values_of: Callable[[Any], tuple[Any, ...]] = (
        attrgetter(*names) if len(names) > 1 else lambda value: tuple(getattr(value, name) for name in names)
    )

    def add(parts: _Parts, value: Any) -> None:
        parts.values.append(header)
        _add_each(parts, values_of(value))
        parts.values.append(b"}")

    return add


def _add_each(parts: _Parts, items: tuple[Any, ...]) -> None:
    """Write values one after another; the most frequent types without a call for each."""
    append, adders = parts.values.append, _adders
    for item in items:
        cls: Any = item.__class__
        if cls is float:
            append(b"d" + _pack_float(item))
        elif cls is int:
            append(b"i%d;" % item)
        else:
            (adders.get(cls) or _adder_of(item, cls))(parts, item)


def _add_array(parts: _Parts, array: NDArray[Any]) -> None:
    parts.values.append(_array_header(array.dtype, array.shape))
    if array.nbytes < SMALL_BYTES:
        parts.values.append(array.tobytes())
    else:
        parts.values.append(array.data if array.flags.c_contiguous else np.ascontiguousarray(array).data)


def _add_enum(parts: _Parts, member: enum.Enum) -> None:
    parts.values.append(b"e%s;" % str(member.value).encode())


def _add_text(parts: _Parts, text: str) -> None:
    data = text.encode()
    parts.values.append(b"s")
    parts.texts.append(b"%d:" % len(data) + data)


def _add_tuple(parts: _Parts, items: tuple[Any, ...]) -> None:
    parts.values.append(b"(%d:" % len(items))
    _add_each(parts, items)


_KINDS: tuple[tuple[Any, Adder], ...] = (
    (np.ndarray, _add_array),
    (enum.Enum, _add_enum),
    (bool | np.bool_, lambda parts, value: parts.values.append(b"T" if value else b"F")),
    (int | np.integer, lambda parts, value: parts.values.append(b"i%d;" % int(value))),
    (float | np.floating, lambda parts, value: parts.values.append(b"d" + _pack_float(float(value)))),
    (str, _add_text),
    (bytes, lambda parts, value: parts.values.extend((b"b%d:" % len(value), value))),
    (type(None), lambda parts, _: parts.values.append(b"N")),
    (tuple, _add_tuple),
)
