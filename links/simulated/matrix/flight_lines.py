"""Simulated flights for a table: a file with one line for each flight, which an interrupted command continues.

Source: ours.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from flow.jobs import Workers, run_all
from links.simulated.matrix.flights import Cell

FILE = "flights.jsonl"
Row = dict[str, Any]  # cell, seed, variant, and what a table needs


class Flight(Protocol):
    """One flight to simulate."""

    @property
    def name(self) -> str:
        """What happens: a cell, a scenario."""
        ...

    @property
    def seed(self) -> int:
        """Where."""
        ...

    @property
    def variant(self) -> str:
        """What differs between flights of the same cell and seed."""
        ...


V = TypeVar("V", bound=str)


@dataclass(frozen=True)
class CellFlight(Generic[V]):
    """A flight of a cell of the matrix."""

    cell: Cell
    seed: int
    variant: V

    @property
    def name(self) -> str:
        """Of the cell."""
        return self.cell.name


F = TypeVar("F", bound=Flight)


def flown(
    folder: Path, flights: Sequence[F], fly: Callable[[F, Callable[[float], None]], Row | None], jobs: int
) -> list[Row]:
    """All flights in FILE of `folder`, after those of `flights` that it lacks; a flight without a row is left out."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / FILE
    workers: Workers = jobs
    rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()] if file.exists() else []
    made = {(row["cell"], row["seed"], row["variant"]) for row in rows}
    new = [flight for flight in flights if (flight.name, flight.seed, flight.variant) not in made]
    for first in range(0, len(new), jobs):
        for row in run_all(fly, new[first : first + jobs], workers, lambda _: None):
            if row is not None:
                rows.append(row)
                with file.open("a", encoding="utf-8") as stream:
                    stream.write(json.dumps(row) + "\n")
    return rows


def write_table(folder: Path, table: str) -> None:
    """Write table.md into `folder`, and print it."""
    (folder / "table.md").write_text(table + "\n", encoding="utf-8")
    sys.stdout.write(table + "\n")


def flights_parser(description: str | None, cells: bool = True) -> argparse.ArgumentParser:
    """The options that choose seeds and, with `cells`, cells of the matrix."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help=f"folder for {FILE} and table.md")
    if cells:
        parser.add_argument("--only", action="append", help="cells whose name matches; may be repeated")
        parser.add_argument("--pairs", action="store_true", help="the small subset of `grd matrix --pairs`")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    return parser
