"""Small stages and links for tests of the engine."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from pydantic import Field

from flow.link import Link, LinkError, Record, Run, Source, SourceSettings, Tap
from flow.message import Message, PerPointF32, message
from flow.stage import Settings, Stage


@message
class Number(Message):
    """A number."""

    value: float


@message
class Sum(Message):
    """A running sum."""

    total: float
    last: PerPointF32


@message
class Text(Message):
    """Something else than a number."""

    words: str


class NumbersSettings(SourceSettings):
    """Settings of `Numbers`."""

    topic: str = "/numbers"


class Numbers(Source[NumbersSettings]):
    """Brings in numbers written as text."""

    def decode(self, record: Record) -> Number | None:
        if record.data == b"refuse":
            raise LinkError("no numbers here: is the counter plugged in?")
        return Number(stamp_ns=record.stamp_ns, value=float(record.data)) if record.data else None


class WordsSettings(SourceSettings):
    """Settings of `Words`."""

    topic: str = "/words"


class Words(Source[WordsSettings]):
    """Brings in texts."""

    def decode(self, record: Record) -> Text:
        return Text(stamp_ns=record.stamp_ns, words=record.data.decode())


class Printer(Link):
    """Takes sums out."""

    def on_sum(self, sum: Sum) -> None:
        raise AssertionError("a replay sends nothing out")


class DoubleSettings(Settings):
    """Settings of `Double`."""

    factor: float = Field(2.0, gt=0)
    unused_option: bool = False


class Stamps(Tap):
    """Writes the stamp of every message to a file in the run's folder."""

    def open(self, run: Run) -> None:
        self._file = (run.out_dir / "stamps.txt").open("w", encoding="utf-8")

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        self._file.write(f"{output} {message.stamp_ns} {arrival_ns}\n")

    def close(self) -> None:
        self._file.close()


class Double(Stage[DoubleSettings]):
    """Multiplies by `factor`."""

    def __init__(self, settings: DoubleSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._doubled: int = 0

    def on_number(self, number: Number) -> Number:
        self._doubled += 1
        return Number(stamp_ns=number.stamp_ns, value=number.value * self.settings.factor)

    @property
    def counters(self) -> dict[str, int]:
        return {"doubled": self._doubled}


class AddSettings(Settings):
    """Settings of `Add`."""

    window: int = Field(3, ge=1, le=100)
    name: str


class Add(Stage[AddSettings]):
    """Adds two streams; gives a sum for each number and a text when it finishes."""

    optional_inputs = frozenset({"words"})

    def __init__(self, settings: AddSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._seen: list[float] = []

    def on_left(self, number: Number) -> Iterator[Sum]:
        self._seen.append(number.value)
        tail = np.asarray(self._seen[-self.settings.window :], dtype=np.float32)
        yield Sum(stamp_ns=number.stamp_ns, total=sum(self._seen), last=tail)

    def on_right(self, number: Number) -> Iterator[Sum]:
        yield from self.on_left(number)

    def on_words(self, text: Text) -> None:
        if text.words == "fail":
            raise ZeroDivisionError("on request")

    def finish(self) -> Text:
        return Text(stamp_ns=0, words=f"{self.settings.name} ends with {sum(self._seen)}")


class WrongArray(Stage):
    """Declares a sum of float32 and gives float64."""

    def on_number(self, number: Number) -> Sum:
        return Sum(stamp_ns=number.stamp_ns, total=0.0, last=np.zeros(2))


class Undeclared(Stage):
    """Gives a message that it does not declare."""

    def on_number(self, number: Number) -> Sum | None:
        return Text(stamp_ns=0, words="wrong type")  # type: ignore[return-value]


class Untyped(Stage):
    """A port without a type."""

    def on_number(self, number): ...


GRAPH = """\
stages:
  double:
    use: tests.flow.toys.Double
    inputs: {number: numbers.number}
  add:
    use: tests.flow.toys.Add
    config: {name: adder}
    inputs:
      left: numbers.number
      right: double.number
links:
  numbers: {use: tests.flow.toys.Numbers}
"""
