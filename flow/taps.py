"""Taps that need nothing from outside but a folder: the hash of all messages, and one CSV file per output.

Source: ours.
"""

from __future__ import annotations

import csv
import dataclasses
import enum
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flow.link import Run, Tap
from flow.message import Message, array_fields, hash_into
from flow.stage import Settings

FORMULA_STARTERS = ("=", "+", "-", "@")  # a spreadsheet would run such a text


class Digest(Tap):
    """The output hash of a run: every message of every output, each output's in order. Equal for two equal runs.

    It has two halves, `values-texts`: all values, and the texts for people. Neither depends on the names of classes,
    fields, nodes and outputs. How messages of different outputs interleave does not matter, so that a live run, in
    which many threads publish, and its repetition have one hash. Threads may call `see` at the same time, for
    different outputs.
    """

    def __init__(self, settings: Settings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._hashes: dict[str, tuple[str, Any, Any]] = {}
        self._joined: dict[str, str] = {}

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Hash the run's clock and the whole message."""
        known = self._hashes.get(output)
        if known is None:
            hashers = hashlib.blake2b(digest_size=16), hashlib.blake2b(digest_size=16)
            known = self._hashes[output] = (type(message).schema, *hashers)
        _, values, texts = known
        values.update(b"@%d" % arrival_ns)
        hash_into(values, texts, message)

    @property
    def outputs(self) -> dict[str, str]:
        """Each output's message type and hashes so far: `schema values texts`."""
        seen = {
            name: f"{schema} {values.hexdigest()} {texts.hexdigest()}"
            for name, (schema, values, texts) in self._hashes.items()
        }
        return seen | self._joined

    def join(self, outputs: dict[str, str]) -> None:
        """Take in the outputs that another digest saw."""
        self._joined |= outputs

    def hexdigest(self) -> str:
        """`values-texts`, 16 hex digits each."""
        outputs = [hashes.split(" ") for hashes in self.outputs.values()]
        halves = ((schema, values) for schema, values, _ in outputs), ((schema, texts) for schema, _, texts in outputs)
        return "-".join(hashlib.blake2b(repr(sorted(half)).encode(), digest_size=8).hexdigest() for half in halves)


class CsvSettings(Settings):
    """Settings of `Csv`."""

    max_array: int = Field(16, ge=0, le=10_000)


class Csv(Tap[CsvSettings]):
    """Each output's numbers and texts as `csv/<node>.<output>.csv`; arrays without a fixed size give their shape."""

    def __init__(self, settings: CsvSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._folder = Path()
        self._files: dict[str, TextIO] = {}
        self._writers: dict[str, Any] = {}

    def open(self, run: Run) -> None:
        """Make the folder `csv` in the run's."""
        self._folder = run.out_dir / "csv"
        self._folder.mkdir(parents=True, exist_ok=True)

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """One line; the first message of an output writes the header."""
        cells = dict(self._cells(message))
        if output not in self._writers:
            stream = self._files[output] = (self._folder / f"{output}.csv").open("w", newline="", encoding="utf-8")
            self._writers[output] = csv.writer(stream)
            self._writers[output].writerow(["arrival_ns", *cells])
        self._writers[output].writerow([arrival_ns, *cells.values()])

    def _cells(self, message: Message) -> Iterator[tuple[str, Any]]:
        fixed = {name for name, _, shape in array_fields(type(message)) if all(isinstance(d, int) for d in shape.dims)}
        for field in dataclasses.fields(message):
            value = getattr(message, field.name)
            if isinstance(value, np.ndarray):
                array = cast("NDArray[Any]", value)
                if field.name in fixed and array.size <= self.settings.max_array:
                    for index in np.ndindex(array.shape):
                        yield f"{field.name}[{','.join(map(str, index))}]", array[index]
                else:
                    yield field.name, f"array {array.shape}"
            elif isinstance(value, enum.Enum):
                yield field.name, value.name
            elif isinstance(value, str | tuple):
                text = str(cast("Any", value))
                yield field.name, f"'{text}" if text.startswith(FORMULA_STARTERS) else text
            else:
                yield field.name, value

    def close(self) -> None:
        """Close all files."""
        for stream in self._files.values():
            stream.close()
        self._files.clear()
