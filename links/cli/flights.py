"""`grd flights`: closed-loop flights of an autopilot on grd's poses, as one table.

Source: ours.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flow.link import LinkError
from links.cli.console import EXIT_FAILED, out, progress_bar, report_errors


@report_errors
def fly_scenarios(
    scenarios: Annotated[list[Path], typer.Argument(help="Scenarios with an autopilot in the loop.")],
    closed_loop: Annotated[
        Path, typer.Option("--closed-loop", metavar="CONFIG", help="Configuration on whose poses the drone flies.")
    ],
    folder: Annotated[Path, typer.Option("--out", "-o", help="Folder for the outcomes and the table.")],
    seeds: Annotated[int, typer.Option("--seeds", min=1, max=1000, help="Number of seeds per scenario.")] = 3,
    first_seed: Annotated[int, typer.Option("--first-seed", min=0, help="First seed.")] = 1,
    sets: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a setting of all scenarios; repeatable."),
    ] = None,
    jobs: Annotated[int, typer.Option("--jobs", min=1, max=256, help="Number of processes.")] = 1,
) -> None:
    """Fly scenarios in closed loop and write a table: OUT/flights.md, and OUT/flights.csv with a line per flight.

    Outcomes of the same scenario, settings, CONFIG and seed are kept, so the command can be interrupted and repeated.
    Changed code is not detected: use another OUT after a change. Exit code 1 when a flight was lost or sent a wrong
    pose.

    Example: grd flights configs/scenarios/flight/matrix/*.yaml --closed-loop configs/sim_flight_fixes.yaml -o out/m
    """
    try:
        from links.simulated.matrix.flight_runs import fly_all
        from links.simulated.matrix.flight_table import markdown_table, write_csv
    except ModuleNotFoundError as missing:
        raise LinkError(f"simulating needs '{missing.name}', not installed: pip install -e '.[simulate]'") from None

    several = range(first_seed, first_seed + seeds)
    with progress_bar(f"{len(scenarios) * seeds} flights") as step:
        results = fly_all(scenarios, sets or (), closed_loop, several, folder, jobs, step)
    for result in results:
        out.print(str(result), markup=False)
    table = markdown_table(results)
    (folder / "flights.md").write_text(table, encoding="utf-8")
    write_csv(folder / "flights.csv", results)
    out.print(table, markup=False)
    if any(r.outcome is None or r.outcome["lost_s"] is not None or r.outcome["wrong_poses"] for r in results):
        raise typer.Exit(EXIT_FAILED)
