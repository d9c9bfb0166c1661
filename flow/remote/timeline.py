"""Conversion of a message of another host to this host's clock.

Each host stamps with its own clock. A field whose name ends in `_ns` is a time of that clock, or an offset to it
(`clock_offset_ns`), and is shifted by the difference of the two clocks. A field whose name ends in `_uncertainty_ns` is
a duration and grows by the uncertainty of that difference.

Source: ours.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from flow.message import nested_fields

_I64 = np.iinfo(np.int64)
M = TypeVar("M")


def in_local_time(message: M, offset_ns: int, uncertainty_ns: int) -> M:
    """The message with `offset_ns` (local clock - remote clock, known to `uncertainty_ns`) added to its times.

    Times in nested dataclasses are shifted, too. OverflowError: a time would exceed 64 bits, so it is no time.
    """
    changed: dict[str, Any] = {}
    for name, grows in _own_time_fields(type(message)):
        value: Any = getattr(message, name)
        if value is not None:
            changed[name] = _added(value, uncertainty_ns if grows else offset_ns)
    for name, nested in nested_fields(type(message)):
        inner: Any = getattr(message, name)
        if type(inner) in nested:
            changed[name] = in_local_time(inner, offset_ns, uncertainty_ns)
    return dataclasses.replace(cast(Any, message), **changed)


@functools.cache
def time_fields(cls: type[Any]) -> tuple[tuple[str, bool], ...]:
    """(field, whether it is an uncertainty) of all fields that hold nanoseconds; a nested one is `field.inner`."""
    found = list(_own_time_fields(cls))
    for name, nested in nested_fields(cls):
        found += [(f"{name}.{inner}", grows) for kind in nested for inner, grows in time_fields(kind)]
    return tuple(dict.fromkeys(found))


@functools.cache
def _own_time_fields(cls: type[Any]) -> tuple[tuple[str, bool], ...]:
    names = [field.name for field in dataclasses.fields(cls) if field.name.endswith("_ns")]
    return tuple((name, name.endswith("_uncertainty_ns")) for name in names)


def _added(value: Any, added_ns: int) -> Any:
    if isinstance(value, np.ndarray):
        times = cast("NDArray[np.int64]", value)
        if times.size:
            _checked(int(times.min()) + added_ns)
            _checked(int(times.max()) + added_ns)
        return times + added_ns
    return _checked(int(value) + added_ns)


def _checked(time_ns: int) -> int:
    if not _I64.min <= time_ns <= _I64.max:
        raise OverflowError(f"{time_ns} ns is no time")
    return time_ns
