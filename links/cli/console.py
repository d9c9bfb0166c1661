"""Parts of all commands: the two consoles, errors with exit codes, a progress bar, tables.

Source: ours.
"""

from __future__ import annotations

import functools
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

import typer
from rich.console import Console
from rich.measure import Measurement
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from flow.config_error import ConfigError
from flow.link import LinkError
from flow.ports import RunError

EXIT_FAILED, EXIT_USAGE = 1, 2
BAR_DELAY_S, LINE_PERIOD_S = 1.0, 10.0
UNBOUNDED_WIDTH = 100_000  # columns

out = Console(highlight=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, soft_wrap=True)

F = TypeVar("F", bound=Callable[..., Any])


def report_errors(command: F) -> F:
    """Decorator of a command: prints configuration and link errors without a traceback.

    Exit code 2; 1 when a stage failed."""

    @functools.wraps(command)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        try:
            return command(*args, **kwargs)
        except ConfigError as error:
            for config_error in error.errors:
                err.print(str(config_error), markup=False, style="red")
            raise typer.Exit(EXIT_USAGE) from None
        except LinkError as error:
            err.print(str(error), markup=False, style="red")
            raise typer.Exit(EXIT_USAGE) from None
        except RunError as error:
            err.print(str(error), markup=False, style="red")
            raise typer.Exit(EXIT_FAILED) from error
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            err.print(f"{where}{error.strerror or error}.", markup=False, style="red")
            raise typer.Exit(EXIT_USAGE) from None
        except KeyboardInterrupt:
            err.print("stopped.")
            raise typer.Exit(130) from None

    return cast(F, wrapped)


@contextmanager
def progress_bar(label: str, *, at_once: bool = False) -> Iterator[Callable[[float, float], None]]:
    """`with progress_bar("replay") as step: step(done, total)`: progress on stderr, however long a step takes.

    A bar on a terminal; in a log a line, and one more every LINE_PERIOD_S. The first appears after BAR_DELAY_S, or
    `at_once`.
    """
    progress = _ProgressBar(label) if err.is_terminal else _ProgressLines(label)
    ended = threading.Event()

    def show() -> None:
        if not at_once and ended.wait(BAR_DELAY_S):
            return
        progress.show(ended)

    thread = threading.Thread(target=show, name="progress", daemon=True)
    thread.start()
    try:
        yield progress.step
    finally:
        ended.set()
        thread.join()


class _ProgressBar:
    """Progress as a bar that vanishes at the end."""

    def __init__(self, label: str) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=err, transient=True, refresh_per_second=5)
        self._task = self._bar.add_task(label, total=None)

    def step(self, done: float, total: float) -> None:
        """Take how much is done."""
        self._bar.update(self._task, completed=done, total=total)

    def show(self, ended: threading.Event) -> None:
        """Show the bar until the end."""
        with self._bar:
            ended.wait()


class _ProgressLines:
    """Progress as lines of a log."""

    def __init__(self, label: str) -> None:
        self._label, self._begin_s, self._share = label, time.monotonic(), 0.0

    def step(self, done: float, total: float) -> None:
        """Take how much is done."""
        self._share = done / total if total else 0.0

    def show(self, ended: threading.Event) -> None:
        """Print lines until the end."""
        while True:
            percent = f", {100 * self._share:.0f} %" if self._share else ""
            err.print(f"{self._label}: {time.monotonic() - self._begin_s:.0f} s{percent}", markup=False)
            if ended.wait(LINE_PERIOD_S):
                return


def warn(text: str) -> None:
    """Print a warning on stderr."""
    err.print(f"warning: {text}", markup=False, style="yellow")


def check_output(file: Path, option: str, *, overwrite: bool) -> None:
    """LinkError when a file cannot be written, or exists and must not be overwritten; `option` names another file."""
    if file.is_dir():
        raise LinkError(f"{file} is a folder: name a file with {option}")
    if file.exists() and not overwrite:
        raise LinkError(f"{file} exists already: give another name with {option}, or --overwrite")
    if not file.parent.is_dir():
        raise LinkError(f"{file}: there is no folder {file.parent}: create it first, or name another with {option}")
    if not os.access(file if file.exists() else file.parent, os.W_OK):
        raise LinkError(f"{file} cannot be written: name another with {option}")


def show_table(table: Table) -> None:
    """Print a table as wide as its cells, even in a narrower window or a pipe, so that no number is cut."""
    table.width = Measurement.get(out, out.options.update(width=UNBOUNDED_WIDTH), table).maximum
    out.print(table, crop=False)
