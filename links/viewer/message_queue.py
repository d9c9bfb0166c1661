"""Messages between the run and the logging thread: a bounded queue, packets joined to slices, clouds thinned.

Rerun's log() can block on a stalled viewer or a slow disk, so no stage may call it: the run puts messages into
`MessageQueue`. Packets arrive 754 times a second; `Slicer` joins them so that the viewer draws ten clouds a second.

Source: ours.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from flow.message import Message, array_fields
from stages.messages import LidarFirings, SweptPoints, SweptPulses

T = TypeVar("T")

POLL_S = 0.05  # period at which the consumer polls: a wake-up per message would cost the run more than the message

JOINED: dict[type[Message], tuple[str, ...]] = {
    LidarFirings: ("lost_packets",),
    SweptPoints: ("pulses", "unplaced"),
    SweptPulses: (),
}
"""Message types that arrive per packet, with the fields to sum; their arrays with a row per point are concatenated."""


class MessageQueue(Generic[T]):
    """A FIFO of at most `size` items. When full it drops the oldest item or, if `lossless`, blocks `put`.

    `put` blocks for at most `timeout_s`. After a timeout the consumer counts as stalled, and items are dropped and
    counted until it takes some.
    """

    def __init__(self, size: int, *, lossless: bool, timeout_s: float) -> None:
        self._size = size
        self._lossless = lossless
        self._timeout_s = timeout_s
        self._stalled = False
        self._closed = False
        self._items: deque[tuple[str, T]] = deque()
        self._changed = threading.Condition()
        self.dropped: Counter[str] = Counter()  # by tag

    def put(self, tag: str, item: T) -> None:
        """Add an item. `tag` is the key under which it is counted when it is dropped."""
        with self._changed:
            if len(self._items) >= self._size and self._lossless and not self._stalled:
                self._changed.notify_all()
                self._stalled = not self._changed.wait_for(
                    lambda: len(self._items) < self._size or self._closed, self._timeout_s
                )
            if self._closed:
                self.dropped[tag] += 1
                return
            if len(self._items) >= self._size:
                self.dropped[self._items.popleft()[0]] += 1
            self._items.append((tag, item))

    def take(self) -> list[tuple[str, T]] | None:
        """All items so far, oldest first, after waiting at most `POLL_S`; None when closed and empty."""
        with self._changed:
            deadline = time.monotonic() + POLL_S
            while not self._closed and len(self._items) < self._size:
                if not self._changed.wait(max(0.0, deadline - time.monotonic())):
                    break
            items = list(self._items)
            self._items.clear()
            self._stalled = False
            self._changed.notify_all()
            return None if self._closed and not items else items

    def close(self) -> None:
        """Accept no more items: `put` counts them as dropped, `take` returns the remaining ones."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


def join(messages: Sequence[Message]) -> Message:
    """One message with the content of several of one type in `JOINED`; its stamp is that of the first."""
    first = messages[0]
    changes: dict[str, Any] = {
        name: np.concatenate([getattr(message, name) for message in messages])
        for name, _, shape in array_fields(type(first))
        if shape.dims[0] == "n"
    }
    for name in JOINED[type(first)]:
        changes[name] = sum(getattr(message, name) for message in messages)
    return dataclasses.replace(first, **changes)


class Slicer:
    """Collects messages of the `JOINED` types per output until a slice is complete; passes all others at once."""

    def __init__(self, slice_s: float) -> None:
        self._slice_ns = int(slice_s * 1e9)
        self._open: dict[str, list[Message]] = {}

    def add(self, output: str, message: Message) -> Iterator[tuple[str, int, Message]]:
        """(output, time on the timeline [ns], message) of what is complete. A slice is logged at its last stamp."""
        if type(message) not in JOINED:
            yield output, message.stamp_ns, message
            return
        waiting = self._open.setdefault(output, [])
        if waiting and not 0 <= message.stamp_ns - waiting[0].stamp_ns < self._slice_ns:
            yield output, waiting[-1].stamp_ns, join(waiting)
            waiting.clear()
        waiting.append(message)

    def finish(self) -> Iterator[tuple[str, int, Message]]:
        """The incomplete slices."""
        for output, waiting in self._open.items():
            if waiting:
                yield output, waiting[-1].stamp_ns, join(waiting)
        self._open.clear()


def thin(xyz_m: NDArray[np.float32], at_most: int, voxel_m: float = 0.1) -> NDArray[np.intp]:
    """Indices (m,), in order, of one point per voxel; the voxel size doubles until m <= at_most.

    An isolated return, such as one of a drone, is alone in its voxel: thinning removes points of walls, not this one.
    """
    keep = np.flatnonzero((np.abs(xyz_m) < 1e4).all(axis=1))  # drops NaN and implausible values
    while keep.size > at_most:
        cell = np.floor(xyz_m[keep].astype(np.float64) / voxel_m).astype(np.int64)
        cell -= cell.min(axis=0)
        key = (cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]) * (cell[:, 2].max() + 1) + cell[:, 2]
        keep = keep[np.sort(np.unique(key, return_index=True)[1])]
        voxel_m *= 2
    return keep
