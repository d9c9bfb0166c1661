"""A source that beats and takes pictures, and a sink that tells what came: the two ends of edges that cross hosts."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from flow.link import Link, Record, Source, SourceSettings
from flow.message import Message, Shape, message
from flow.stage import Stage
from links.host_time import now_ns


@message
class Beat(Message):
    """A small message."""

    number: int
    monotonic: int  # the clock that all processes of a machine share, read with the stamp
    earlier_ns: int


@message
class Picture(Message):
    """A big one, with noise that no line compresses."""

    number: int
    grey: Annotated[NDArray[np.uint8], Shape("h", "w")]


class BeatsSettings(SourceSettings):
    """Settings of `Beats`."""

    topic: str = "/beats"
    rate_hz: float = 100.0
    every: int = 10
    size_px: int = 64


class Beats(Source[BeatsSettings]):
    """Gives a beat, and each `every` beats a picture."""

    def __init__(self, settings: BeatsSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._number: int = 0

    def decode(self, record: Record) -> Iterator[Beat | Picture]:
        settings = self.settings
        self._number += 1
        yield Beat(
            stamp_ns=record.stamp_ns,
            number=self._number,
            monotonic=int(record.data),
            earlier_ns=record.stamp_ns - 1_000_000,
        )
        if self._number % settings.every == 0:
            noise = np.random.default_rng(self._number).integers(0, 255, (settings.size_px, settings.size_px), np.uint8)
            yield Picture(stamp_ns=record.stamp_ns, number=self._number, grey=noise)

    @contextmanager
    def listen(self) -> Iterator[Iterator[Record]]:
        closing = threading.Event()

        def beats() -> Iterator[Record]:
            next_s = time.monotonic()
            while not closing.wait(max(next_s - time.monotonic(), 0.0)):
                next_s += 1.0 / self.settings.rate_hz
                stamp_ns, monotonic = now_ns(), time.monotonic_ns()
                yield Record(self.settings.topic, stamp_ns, stamp_ns, str(monotonic).encode())

        try:
            yield beats()
        finally:
            closing.set()


class Echo(Stage):
    """Gives each beat back: its way there and back is a cycle through hosts."""

    def on_beat(self, beat: Beat) -> Beat:
        return beat


class Teller(Link):
    """Writes a line of JSON for each message: what came, how late, and how wrong its stamp is by the shared clock."""

    optional_inputs = frozenset({"beat", "picture"})

    def on_beat(self, beat: Beat) -> None:
        self._tell("beat", beat, beat.monotonic)

    def on_picture(self, picture: Picture) -> None:
        self._tell("picture", picture, None)

    def _tell(self, kind: str, told: Beat | Picture, monotonic: int | None) -> None:
        here_ns, here_monotonic = now_ns(), time.monotonic_ns()
        said = {"kind": kind, "number": told.number, "late_ms": (here_ns - told.stamp_ns) / 1e6}
        if isinstance(told, Beat) and monotonic is not None:
            said["true_late_ms"] = (here_monotonic - monotonic) / 1e6
            said["earlier_ms"] = (told.stamp_ns - told.earlier_ns) / 1e6
        sys.stdout.write(json.dumps(said) + "\n")
        sys.stdout.flush()
