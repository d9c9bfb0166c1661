"""`grd evaluate`: runs against truth and against each other.

Source: DESIGN, Command line.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated

import typer

from flow.link import LinkError
from links.cli.console import EXIT_FAILED, report_errors
from links.cli.options import Jobs, Scheduler
from links.evaluation.association import EvaluationLimits

PARQUET = ".parquet"
JSON_FILE, DEFAULTS = "evaluation.json", EvaluationLimits()
NEEDED = ("pandas", "matplotlib")  # evo is optional: without it its metrics are not evaluated

Against = Annotated[
    list[Path] | None, typer.Option("--against", help="A run to compare with, of the same recording; repeatable.")
]
By = Annotated[
    list[str] | None,
    typer.Option(
        "--by",
        metavar="FIELD",
        help="Group by a field of the recordings' names (2 of SCENE-RANGE-...), by several (2,3) or by "
        "configuration alone (config). Configurations are side by side in any case. Repeatable.",
    ),
]
TablesFile = Annotated[
    Path | None,
    typer.Option(
        "--paper-tables",
        help="Markdown file to write: the paper's Tables I and II with the runs of recordings named "
        "experiment_1 ... experiment_4-... next to them.",
    ),
]
MaxGap = Annotated[
    float, typer.Option("--max-gap", min=0.001, max=10, help="Truth is not interpolated over a longer gap [s].")
]
MaxAge = Annotated[float, typer.Option("--max-age", min=0.001, max=60, help="An output is current for this long [s].")]
Reach = Annotated[
    float, typer.Option("--reach", min=1, max=10_000, help="No output is expected beyond this range [m].")
]


@report_errors
def evaluate_runs(
    runs: Annotated[
        list[Path],
        typer.Argument(
            help="Folders written by `grd run` or `grd replay`, or TUM files; or Parquet files of --parquet."
        ),
    ],
    against: Against = None,
    truth: Annotated[
        Path | None, typer.Option("--truth", help="TUM file of the true T_vehicle_drone [default: the run's own].")
    ] = None,
    report: Annotated[Path | None, typer.Option("--report", help="Self-contained HTML report to write.")] = None,
    out_dir: Annotated[
        Path | None, typer.Option("--out", help=f"Folder for {JSON_FILE} [default: the report's folder].")
    ] = None,
    no_drone: Annotated[
        bool, typer.Option("--no-drone", help="There was no drone: every output is a false alarm.")
    ] = False,
    by: By = None,
    csv_file: Annotated[
        Path | None, typer.Option("--csv", help="CSV file of all metrics to write, a line a run.")
    ] = None,
    parquet_file: Annotated[
        Path | None,
        typer.Option("--parquet", help="The same as a Parquet file, which grd evaluate reads in place of RUNS."),
    ] = None,
    tables_file: TablesFile = None,
    max_gap_s: MaxGap = DEFAULTS.max_gap_s,
    max_age_s: MaxAge = DEFAULTS.max_age_s,
    reach_m: Reach = DEFAULTS.reach_m,
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
) -> None:
    """Evaluate runs against truth.

    Errors are evaluated at the outputs' own times and over all time with the last output held, so that a run does not
    improve by leaving outputs out. What could not be evaluated is listed with its reason. Exit code 1 when a run has a
    fault (false outputs, an overconfident covariance, a wrong yaw branch, no output at all). RUNS of several
    configurations are side by side; each of several drones is evaluated with the tracks that follow it.

    Example: grd evaluate out/street_sweep-estimate --against out/street_sweep-paper --report out/compare.html
    """
    _check_installed()
    if tables := [path for path in runs if path.suffix == PARQUET]:
        others = (against, truth, report, out_dir, csv_file, parquet_file, tables_file, no_drone or None)
        _show_tables(runs, tables, by or [], others)
        return
    if no_drone and truth is not None:
        raise LinkError("--no-drone and --truth contradict each other: give one of them")
    from links.cli.evaluate_output import Files, compare_and_show, evaluate_all, prepared
    from links.evaluation.groups import parse_by

    keys = [parse_by(text) for text in by or []]
    limits = EvaluationLimits(max_gap_s=max_gap_s, max_age_s=max_age_s, reach_m=reach_m)
    numbers = out_dir / JSON_FILE if out_dir else report and report.parent / JSON_FILE
    files = prepared(Files(numbers, report, csv_file, parquet_file, tables_file))
    own, compared = evaluate_all(runs, against or [], truth, no_drone, limits, scheduler or jobs)
    compare_and_show(own, compared, keys, files)
    if any(e.findings for e in own):
        raise typer.Exit(EXIT_FAILED)


def _show_tables(runs: list[Path], tables: list[Path], by: list[str], others: tuple[object, ...]) -> None:
    """Tables over the runs of Parquet files. `others`: values of other options, None where one is left out."""
    if len(tables) < len(runs) or any(option is not None for option in others):
        raise LinkError(f"{tables[0]} is a table of evaluated runs: give tables alone, with --by and no other option")
    from links.cli.evaluate_output import show_tables
    from links.evaluation.groups import parse_by

    show_tables(tables, [parse_by(text) for text in by])


def _check_installed() -> None:
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise LinkError(f"evaluating needs {' and '.join(missing)}, not installed: pip install -e '.[evaluate]'")
