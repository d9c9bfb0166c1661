"""Packets come 754 times a second; a viewer wants pictures. Join packet messages to slices and thin their points.

Source: ours.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flow.message import Message, array_fields
from stages.messages import LidarFirings, SweptPoints, SweptPulses

JOINED: dict[type[Message], tuple[str, ...]] = {
    LidarFirings: ("lost_packets",),
    SweptPoints: ("pulses", "unplaced"),
    SweptPulses: (),
}
"""Message types that come packet by packet, with the fields that add up; their arrays are strung together."""


def join(messages: Sequence[Message]) -> Message:
    """One message with the content of several of a type in `JOINED`; its stamp is the first one's."""
    first = messages[0]
    changes: dict[str, Any] = {
        name: np.concatenate([getattr(message, name) for message in messages])
        for name, _, _ in array_fields(type(first))
    }
    for name in JOINED[type(first)]:
        changes[name] = sum(getattr(message, name) for message in messages)
    return dataclasses.replace(first, **changes)


class Slicer:
    """Collects joined message types per output until a slice is full; passes all others on at once."""

    def __init__(self, slice_s: float) -> None:
        self._slice_ns = int(slice_s * 1e9)
        self._open: dict[str, list[Message]] = {}

    def add(self, output: str, message: Message) -> Iterator[tuple[str, int, Message]]:
        """(output, time on the timeline [ns], message) of what is ready. A slice stands at its last stamp."""
        if type(message) not in JOINED:
            yield output, message.stamp_ns, message
            return
        waiting = self._open.setdefault(output, [])
        if waiting and not 0 <= message.stamp_ns - waiting[0].stamp_ns < self._slice_ns:
            yield output, waiting[-1].stamp_ns, join(waiting)
            waiting.clear()
        waiting.append(message)

    def finish(self) -> Iterator[tuple[str, int, Message]]:
        """The slices still open."""
        for output, waiting in self._open.items():
            if waiting:
                yield output, waiting[-1].stamp_ns, join(waiting)
        self._open.clear()


def thin(xyz_m: NDArray[np.float32], at_most: int, voxel_m: float = 0.1) -> NDArray[np.intp]:
    """Indices (m,), in order, of one point per voxel; the voxel doubles until m <= at_most.

    A lone return, as a drone gives, is alone in its voxel: thinning takes from walls, not from it.
    """
    keep = np.flatnonzero((np.abs(xyz_m) < 1e4).all(axis=1))  # not NaN, not a wild value
    while keep.size > at_most:
        cell = np.floor(xyz_m[keep].astype(np.float64) / voxel_m).astype(np.int64)
        cell -= cell.min(axis=0)
        key = (cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]) * (cell[:, 2].max() + 1) + cell[:, 2]
        keep = keep[np.sort(np.unique(key, return_index=True)[1])]
        voxel_m *= 2
    return keep
