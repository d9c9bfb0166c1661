"""A source of small and large messages and a sink that prints them: the ends of edges between hosts."""

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
from links.clock.host_time import now_ns


@message
class Beat(Message):
    """A small message."""

    number: int
    monotonic: int  # clock shared by all processes of the machine, read with the stamp
    earlier_ns: int


@message
class Image(Message):
    """A large message of noise, which cannot be compressed."""

    number: int
    grey: Annotated[NDArray[np.uint8], Shape("h", "w")]


class BeatsSettings(SourceSettings):
    """Settings of `Beats`."""

    topic: str = "/beats"
    rate_hz: float = 100.0
    every: int = 10
    size_px: int = 64


class Beats(Source[BeatsSettings]):
    """Publishes beats, and an image every `every` beats."""

    def __init__(self, settings: BeatsSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._number: int = 0

    def decode(self, record: Record) -> Iterator[Beat | Image]:
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
            yield Image(stamp_ns=record.stamp_ns, number=self._number, grey=noise)

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
    """Returns each beat: a cycle through two hosts."""

    def on_beat(self, beat: Beat) -> Beat:
        return beat


class PrintSink(Link):
    """Prints a line of JSON per message: kind, number, age by its stamp, and age by the shared clock."""

    optional_inputs = frozenset({"beat", "image"})

    def on_beat(self, beat: Beat) -> None:
        self._print("beat", beat, beat.monotonic)

    def on_image(self, image: Image) -> None:
        self._print("image", image, None)

    def _print(self, kind: str, received: Beat | Image, monotonic: int | None) -> None:
        here_ns, here_monotonic = now_ns(), time.monotonic_ns()
        line = {"kind": kind, "number": received.number, "late_ms": (here_ns - received.stamp_ns) / 1e6}
        if isinstance(received, Beat) and monotonic is not None:
            line["true_late_ms"] = (here_monotonic - monotonic) / 1e6
            line["earlier_ms"] = (received.stamp_ns - received.earlier_ns) / 1e6
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
