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
    """One BLAKE2b hash over every message of every output, each output's in order: equal for two replays.

    How messages of different outputs lie in time does not matter, so that a live run, in which many threads send, and
    its repetition have one hash. Threads may call `see` at the same time, for different outputs.
    """

    def __init__(self, settings: Settings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._hashes: dict[str, Any] = {}
        self._joined: dict[str, str] = {}

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Hash the run's clock and the whole message."""
        hasher = self._hashes.get(output)
        if hasher is None:
            hasher = self._hashes[output] = hashlib.blake2b(digest_size=16)
        hasher.update(b"@%d" % arrival_ns)
        hash_into(hasher, message)

    @property
    def told(self) -> dict[str, str]:
        """Each output's hash so far."""
        return {name: hasher.hexdigest() for name, hasher in self._hashes.items()} | self._joined

    def join(self, told: dict[str, str]) -> None:
        """Take in the hashes of outputs that another digest saw."""
        self._joined |= told

    def hexdigest(self) -> str:
        """32 hex digits, of the outputs' names and hashes."""
        parts = [f"{name} {told}" for name, told in sorted(self.told.items())]
        return hashlib.blake2b("\n".join(parts).encode(), digest_size=16).hexdigest()


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
