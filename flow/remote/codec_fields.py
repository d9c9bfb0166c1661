"""How one field of a message is encoded and decoded; `flow.remote.codec` specifies the bytes.

Source: ours.
"""

from __future__ import annotations

import dataclasses
import enum
import math
import struct
import types
from typing import Annotated, Any, Protocol, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from flow.message import Shape

EMPTY_DIM = 65_536
"""An array without elements has at most so many rows or columns, or as many as the message has bytes."""

_I64, _F64, _U32 = struct.Struct("<q"), struct.Struct("<d"), struct.Struct("<I")

Writer = list[Any]  # pieces of the encoded message: bytes and memoryviews
Sizes = dict[str, int]  # sizes by the letters of declared shapes, within one message


class CodecError(ValueError):
    """Bytes that are not the expected message, or a message that is not what its class declares."""


class Reader:
    """Encoded bytes and a position in them; it never reads beyond their end."""

    def __init__(self, data: bytes, at: int) -> None:
        self._data, self._at = data, at
        self.size = len(data)
        """Bytes in all."""

    @property
    def left(self) -> int:
        """Bytes not read yet."""
        return self.size - self._at

    def number(self, form: struct.Struct) -> Any:
        """One number."""
        return form.unpack_from(self._data, self._skip(form.size))[0]

    def numbers(self, form: struct.Struct) -> tuple[Any, ...]:
        """As many numbers as `form` has."""
        return form.unpack_from(self._data, self._skip(form.size))

    def take(self, length: int) -> bytes:
        """The next bytes."""
        at = self._skip(length)
        return self._data[at : at + length]

    def array(self, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
        """The next `count` elements, not copied."""
        return np.frombuffer(self._data, dtype, count, self._skip(count * dtype.itemsize))

    def end(self) -> None:
        """CodecError: bytes are left."""
        if self.left:
            raise CodecError(f"{self.left} bytes too many")

    def _skip(self, length: int) -> int:
        at = self._at
        if at + length > self.size:
            raise CodecError(f"ends too early: {length} bytes wanted, {self.left} left")
        self._at = at + length
        return at


class Field(Protocol):
    """A type that can be encoded."""

    signature: str
    """Text that describes the type in the fingerprint."""
    min_bytes: int
    """Size of its shortest encoding."""

    def write(self, out: Writer, value: Any, sizes: Sizes) -> None:
        """Append the value's bytes to `out`."""
        ...

    def read(self, reader: Reader, sizes: Sizes) -> Any:
        """Decode the next bytes."""
        ...


class _Int:
    signature, min_bytes = "int", 8

    def write(self, out: Writer, value: Any, sizes: Sizes) -> None:
        out.append(_I64.pack(value))

    def read(self, reader: Reader, sizes: Sizes) -> int:
        return reader.number(_I64)


class _Float:
    signature, min_bytes = "float", 8

    def write(self, out: Writer, value: Any, sizes: Sizes) -> None:
        out.append(_F64.pack(value))

    def read(self, reader: Reader, sizes: Sizes) -> float:
        return reader.number(_F64)


class _Bool:
    signature, min_bytes = "bool", 1

    def write(self, out: Writer, value: Any, sizes: Sizes) -> None:
        out.append(b"\x01" if value else b"\x00")

    def read(self, reader: Reader, sizes: Sizes) -> bool:
        byte = reader.take(1)[0]
        if byte > 1:
            raise CodecError(f"{byte} is neither true nor false")
        return byte == 1


class _Text:
    signature, min_bytes = "str", 4

    def write(self, out: Writer, value: Any, sizes: Sizes) -> None:
        data = value.encode()
        out += (_U32.pack(len(data)), data)

    def read(self, reader: Reader, sizes: Sizes) -> str:
        try:
            return reader.take(reader.number(_U32)).decode()
        except UnicodeDecodeError as error:
            raise CodecError(f"is not UTF-8 (byte {error.start})") from None


class _Bytes:
    signature, min_bytes = "bytes", 4

    def write(self, out: Writer, value: Any, sizes: Sizes) -> None:
        out += (_U32.pack(len(value)), bytes(value))

    def read(self, reader: Reader, sizes: Sizes) -> bytes:
        return reader.take(reader.number(_U32))


class _Enum(_Text):
    def __init__(self, cls: type[enum.Enum]) -> None:
        self._cls = cls
        self.signature = f"{cls.__name__}[{','.join(member.name for member in cls)}]"

    def write(self, out: Writer, value: Any, sizes: Sizes) -> None:
        super().write(out, self._cls(value).name, sizes)

    def read(self, reader: Reader, sizes: Sizes) -> Any:
        name = super().read(reader, sizes)
        member = self._cls.__members__.get(name)
        if member is None:
            raise CodecError(f"{self._cls.__name__} has no {name[:40]!r}")
        return member


class _Optional:
    min_bytes = 1

    def __init__(self, inner: Field) -> None:
        self._inner = inner
        self.signature = f"{inner.signature}?"

    def write(self, out: Writer, value: Any, sizes: Sizes) -> None:
        _FLAG.write(out, value is not None, sizes)
        if value is not None:
            self._inner.write(out, value, sizes)

    def read(self, reader: Reader, sizes: Sizes) -> Any:
        return self._inner.read(reader, sizes) if _FLAG.read(reader, sizes) else None


class _Many:
    """tuple[X, ...]"""

    min_bytes = 4

    def __init__(self, inner: Field) -> None:
        self._inner = inner
        self.signature = f"({inner.signature}...)"

    def write(self, out: Writer, value: Any, sizes: Sizes) -> None:
        out.append(_U32.pack(len(value)))
        for item in value:
            self._inner.write(out, item, sizes)

    def read(self, reader: Reader, sizes: Sizes) -> tuple[Any, ...]:
        count = reader.number(_U32)
        if count * self._inner.min_bytes > reader.left:
            raise CodecError(f"{count} items cannot be in {reader.left} bytes")
        return tuple(self._inner.read(reader, sizes) for _ in range(count))


class _Each:
    """tuple[X, Y, Z]"""

    def __init__(self, inner: list[Field]) -> None:
        self._inner = inner
        self.signature = f"({','.join(field.signature for field in inner)})"
        self.min_bytes = sum(field.min_bytes for field in inner)

    def write(self, out: Writer, value: Any, sizes: Sizes) -> None:
        if len(value) != len(self._inner):
            raise CodecError(f"{len(value)} items, declared are {len(self._inner)}")
        for field, item in zip(self._inner, value, strict=True):
            field.write(out, item, sizes)

    def read(self, reader: Reader, sizes: Sizes) -> tuple[Any, ...]:
        return tuple(field.read(reader, sizes) for field in self._inner)


class _Array:
    def __init__(self, dtype: np.dtype[Any], shape: Shape) -> None:
        if dtype.kind not in "iufb":
            raise TypeError(f"an array of {dtype}")
        self._dtype, self._shape, self._dims = dtype, shape, shape.dims
        self._wire = dtype.newbyteorder("<")
        self._head = struct.Struct(f"<{len(shape.dims)}I")
        self.signature = f"{self._wire.str}{shape}"
        self.min_bytes = 4 * len(shape.dims)

    def write(self, out: Writer, value: Any, sizes: Sizes) -> None:
        array: NDArray[Any] = np.asarray(value)
        if array is not value or array.dtype != self._dtype or array.ndim != len(self._shape.dims):
            raise CodecError(f"declared {self._dtype} {self._shape}, got {array.dtype} {array.shape}")
        self._check(array.shape, sizes)
        out.append(self._head.pack(*array.shape))
        if array.size:
            out.append(np.ascontiguousarray(array, self._wire).data.cast("B"))

    def read(self, reader: Reader, sizes: Sizes) -> NDArray[Any]:
        shape = reader.numbers(self._head)
        self._check(shape, sizes)
        if max(shape, default=0) > max(reader.size, EMPTY_DIM):
            raise CodecError(f"an array of {shape} cannot be in {reader.left} bytes")
        count = math.prod(shape)
        if not count:
            return np.empty(shape, self._dtype)
        array = np.array(reader.array(self._wire, count), self._dtype).reshape(shape)
        if self._dtype.kind == "b" and array.view(np.uint8).max() > 1:
            raise CodecError("a byte that is neither true nor false")
        return array

    def _check(self, shape: tuple[int, ...], sizes: Sizes) -> None:
        for declared, size in zip(self._dims, shape, strict=True):
            wanted = sizes.setdefault(declared, size) if isinstance(declared, str) else declared
            if size != wanted:
                bound = f" with {declared} = {wanted}" if isinstance(declared, str) else ""
                raise CodecError(f"declared {self._shape}{bound}, got {shape}")


class _Record:
    """A nested dataclass: its fields in order."""

    def __init__(self, cls: type[Any]) -> None:
        hints = get_type_hints(cls, include_extras=True)
        self.cls = cls
        self._fields = [(field.name, field_of(hints[field.name])) for field in dataclasses.fields(cls)]
        self.signature = f"{cls.__name__}({';'.join(f'{name}:{field.signature}' for name, field in self._fields)})"
        self.min_bytes = sum(field.min_bytes for _, field in self._fields)

    def write(self, out: Writer, value: Any, sizes: Sizes) -> None:
        if type(value) is not self.cls:
            raise CodecError(f"declared {self.cls.__name__}, got {type(value).__name__}")
        for name, field in self._fields:
            field.write(out, getattr(value, name), sizes)

    def read(self, reader: Reader, sizes: Sizes) -> Any:
        return self.cls(**{name: field.read(reader, sizes) for name, field in self._fields})


class _Union:
    """X | Y of dataclasses: the index of the class, then its fields."""

    def __init__(self, records: list[_Record]) -> None:
        self._records = records
        self.signature = "|".join(record.signature for record in records)
        self.min_bytes = 1 + min(record.min_bytes for record in records)

    def write(self, out: Writer, value: Any, sizes: Sizes) -> None:
        index = next((i for i, record in enumerate(self._records) if type(value) is record.cls), None)
        if index is None:
            raise CodecError(
                f"declared {' | '.join(r.cls.__name__ for r in self._records)}, got {type(value).__name__}"
            )
        out.append(bytes([index]))
        self._records[index].write(out, value, sizes)

    def read(self, reader: Reader, sizes: Sizes) -> Any:
        index = reader.take(1)[0]
        if index >= len(self._records):
            raise CodecError(f"class {index} of {len(self._records)}")
        return self._records[index].read(reader, sizes)


_FLAG = _Bool()
_PLAIN: dict[Any, Field] = {int: _Int(), float: _Float(), bool: _FLAG, str: _Text(), bytes: _Bytes()}


def field_of(hint: Any) -> Field:
    """The field of an annotation. TypeError: the type cannot be encoded."""
    if hint in _PLAIN:
        return _PLAIN[hint]
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        shape = next((extra for extra in args[1:] if isinstance(extra, Shape)), None)
        if shape is None:
            return field_of(args[0])
        return _Array(np.dtype(get_args(get_args(args[0])[1])[0]), shape)  # NDArray[T] is ndarray[shape, dtype[T]]
    if origin in (Union, types.UnionType):
        inner = [arg for arg in args if arg is not type(None)]
        if len(inner) == 1 and len(args) == 2:
            return _Optional(field_of(inner[0]))
        if all(dataclasses.is_dataclass(arg) for arg in inner):
            union = _Union([_Record(arg) for arg in inner])
            return union if len(inner) == len(args) else _Optional(union)
    if origin is tuple and args:
        if args[-1] is Ellipsis:
            return _Many(field_of(args[0]))
        return _Each([field_of(arg) for arg in args])
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return _Enum(hint)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _Record(hint)
    raise TypeError(f"{hint!r} is no type that can be encoded")
