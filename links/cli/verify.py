"""`grd verify`: compares the output hashes of the committed recordings with the pinned ones.

Source: ours.
"""

from __future__ import annotations

import os
from typing import Annotated

import typer

from links.cli.console import EXIT_FAILED, out, progress_bar, report_errors
from links.runs.output_hashes import PinResult, measure, read_pins, write_pins
from links.runs.shipped import CONFIGS, RECORDINGS


@report_errors
def verify(
    recordings: Annotated[
        list[str] | None, typer.Argument(help="Names in recordings/, without .mcap [default: all].")
    ] = None,
    values: Annotated[bool, typer.Option("--values", help="Compare values only; reason texts may differ.")] = False,
    update: Annotated[
        bool, typer.Option("--update", help="Write the current hashes to recordings/hashes.json.")
    ] = False,
    jobs: Annotated[int | None, typer.Option("--jobs", min=1, help="Parallel replays [default: one per core].")] = None,
) -> None:
    """Replay the committed recordings and compare their output hashes with recordings/hashes.json.

    Exit code 1 when a hash differs or is not pinned.

    Example: grd verify street_sweep
    """
    pins = read_pins(RECORDINGS, CONFIGS, tuple(recordings or ()))
    outcomes: list[PinResult] = []
    with progress_bar("verify") as step:
        for outcome in measure(pins, jobs or os.cpu_count() or 1):
            outcomes.append(outcome)
            step(len(outcomes), len(pins))
    outcomes.sort(key=lambda outcome: (outcome.pin.recording.name, outcome.pin.config.name))
    for outcome in outcomes:
        out.print(f"{outcome.pin.recording.stem:20} {outcome.pin.config.stem:10} {_comparison(outcome)}", markup=False)
    if update:
        write_pins(RECORDINGS, outcomes)
        out.print(f"pinned in {RECORDINGS / 'hashes.json'}", markup=False)
    elif not all(outcome.values_match if values else outcome.matches for outcome in outcomes):
        raise typer.Exit(EXIT_FAILED)


def _comparison(outcome: PinResult) -> str:
    if outcome.matches:
        return f"{outcome.actual}  same"
    if outcome.pin.expected is None:
        return f"{outcome.actual}  not pinned"
    what = "texts differ" if outcome.values_match else "VALUES DIFFER"
    return f"{outcome.actual}  {what}, pinned {outcome.pin.expected}"
