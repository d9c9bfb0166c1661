"""Hypothesis strategies that make any message class from its annotations."""

from __future__ import annotations

import enum
import struct
import types
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from flow.message import Message, Shape

I64 = st.integers(-(2**63), 2**63 - 1)
F64 = st.integers(0, 2**64 - 1).map(lambda bits: struct.unpack("<d", struct.pack("<Q", bits))[0])


def value_of(hint: Any, sizes: dict[str, int]) -> st.SearchStrategy[Any]:
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        shape = next(extra for extra in args[1:] if isinstance(extra, Shape))
        dtype = np.dtype(get_args(get_args(args[0])[1])[0])
        dims = tuple(sizes[d] if isinstance(d, str) else d for d in shape.dims)
        return npst.arrays(dtype, dims)
    if origin in (Union, types.UnionType):
        return st.one_of(*(st.none() if arg is type(None) else value_of(arg, sizes) for arg in args))
    if origin is tuple:
        if args[-1] is Ellipsis:
            return st.lists(value_of(args[0], sizes), max_size=3).map(tuple)
        return st.tuples(*(value_of(arg, sizes) for arg in args))
    if is_dataclass(hint):
        hints = get_type_hints(hint, include_extras=True)
        return st.builds(hint, **{field.name: value_of(hints[field.name], sizes) for field in fields(hint)})
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return st.sampled_from(hint)
    return {int: I64, float: F64, bool: st.booleans(), str: st.text(max_size=20), bytes: st.binary(max_size=20)}[hint]


@st.composite
def messages(draw: Any, cls: type[Message]) -> Message:
    hints = get_type_hints(cls, include_extras=True)
    letters = {letter: draw(st.integers(0, 4)) for letter in ("n", "m", "k", "a", "h", "w", "lasers")}
    return cls(**{field.name: draw(value_of(hints[field.name], letters)) for field in fields(cls)})
