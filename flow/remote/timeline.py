"""Conversion of a message of another host to this host's clock.

Each host stamps with its own clock. A field whose name ends in `_ns` is a time of that clock, or an offset to it
(`clock_offset_ns`), and is shifted by the difference of the two clocks. A field whose name ends in `_uncertainty_ns` is
a duration and grows by the uncertainty of that difference.

Source: ours.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from flow.message import Message

_I64 = np.iinfo(np.int64)


def in_local_time(message: Message, offset_ns: int, uncertainty_ns: int) -> Message:
    """The message with `offset_ns` (local clock - remote clock, known to `uncertainty_ns`) added to its times.

    OverflowError: a time would exceed 64 bits, so it is no time.
    """
    changed: dict[str, Any] = {}
    for name, added_ns in _times(type(message), offset_ns, uncertainty_ns):
        value: Any = getattr(message, name)
        if value is not None:
            changed[name] = _added(value, added_ns)
    return dataclasses.replace(message, **changed)


def _times(cls: type[Message], offset_ns: int, uncertainty_ns: int) -> list[tuple[str, int]]:
    return [(name, uncertainty_ns if grows else offset_ns) for name, grows in time_fields(cls)]


@functools.cache
def time_fields(cls: type[Message]) -> tuple[tuple[str, bool], ...]:
    """(field, whether it is an uncertainty) of all fields that hold nanoseconds."""
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
