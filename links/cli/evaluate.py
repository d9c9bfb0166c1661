"""`grd evaluate`: runs against truth and against each other.

Source: DESIGN, Command line.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from flow.link import LinkError
from links.cli.console import FINDING, err, in_words, out, progress_bar, show_table, warn
from links.evaluation import Evaluation, Limits, evaluate, read_run
from links.evaluation.compare import Pair, by_config, pair_up, uneven
from links.evaluation.csv_table import write_csv
from links.evaluation.groups import Key, groups, parse_by
from links.evaluation.no_drone import alarms
from links.evaluation.paper_tables import markdown, paper_tables
from links.evaluation.probabilities import reliabilities
from links.evaluation.report import write_report
from links.evaluation.rotation_groups import rotation_groups
from links.evaluation.summaries import (
    Summary,
    alarm_summary,
    group_summary,
    reliability_summary,
    rotation_summary,
)
from links.evaluation.tables import MAX_COLUMNS, as_json, comparison_table, headline_table, label, metrics_table
from links.evaluation.tracks import per_drone

JSON_FILE, DEFAULTS = "evaluation.json", Limits()
MAX_NAMED = 4  # runs named before a text that holds for them; the report names all


@in_words
def evaluate_runs(
    runs: Annotated[list[Path], typer.Argument(help="Folders written by `grd run` or `grd replay`, or TUM files.")],
    against: Annotated[
        list[Path] | None, typer.Option("--against", help="A run to compare with, of the same recording; repeatable.")
    ] = None,
    truth: Annotated[
        Path | None, typer.Option("--truth", help="TUM file of the true T_vehicle_drone [default: the run's own].")
    ] = None,
    report: Annotated[Path | None, typer.Option("--report", help="Self-contained HTML report to write.")] = None,
    out_dir: Annotated[
        Path | None, typer.Option("--out", help=f"Folder for {JSON_FILE} [default: beside the report].")
    ] = None,
    no_drone: Annotated[
        bool, typer.Option("--no-drone", help="There was no drone: all that a run says is a false alarm.")
    ] = False,
    by: Annotated[
        list[str] | None,
        typer.Option(
            "--by",
            metavar="WORD",
            help="Sum up by a word of the recordings' names (2 of SCENE-RANGE-...), by several (2,3) or by "
            "configuration alone (config); several configurations stand side by side. Repeatable.",
        ),
    ] = None,
    csv_file: Annotated[Path | None, typer.Option("--csv", help="Table of all metrics to write, a line a run.")] = None,
    tables_file: Annotated[
        Path | None,
        typer.Option(
            "--paper-tables",
            help="Markdown file to write: the paper's Tables I and II, with the runs of recordings named "
            "experiment_1 ... experiment_4-... beside them.",
        ),
    ] = None,
    max_gap_s: Annotated[
        float, typer.Option("--max-gap", min=0.001, max=10, help="Truth is not interpolated over a longer gap [s].")
    ] = DEFAULTS.max_gap_s,
    max_age_s: Annotated[
        float, typer.Option("--max-age", min=0.001, max=60, help="An output counts as present for this long [s].")
    ] = DEFAULTS.max_age_s,
    reach_m: Annotated[
        float, typer.Option("--reach", min=1, max=10_000, help="No output is asked for beyond this range [m].")
    ] = DEFAULTS.reach_m,
) -> None:
    """Judge runs by truth.

    Errors are told at the outputs' own times and over all time with the last output held, so that saying nothing is
    never better than being right. What could not be evaluated is listed with its reason. Exit code 1 when something
    is wrong with a run (false outputs, a covariance that promises too much, a wrong yaw branch, no output at all).
    RUNS of several configurations stand side by side; of several drones each is judged by the tracks that follow it.

    Example: grd evaluate out/street_sweep-replay --against out/street_sweep-paper --report out/compare.html
    """
    if no_drone and truth is not None:
        raise LinkError("--no-drone and --truth contradict each other: give one of them")
    keys = [parse_by(text) for text in by or []]
    limits = Limits(max_gap_s=max_gap_s, max_age_s=max_age_s, reach_m=reach_m)
    paths = [*runs, *(against or [])]
    judged: list[list[Evaluation]] = []
    with progress_bar(f"evaluate {len(paths)} runs") as step:
        for done, path in enumerate(paths):
            parts = per_drone(read_run(path, truth, no_drone), limits.max_gap_s)
            judged.append([evaluate(run, output, limits) for run in parts for output in run.outputs])
            step(done + 1, len(paths))
    own = [e for group in judged[: len(runs)] for e in group]
    others = [e for group in judged[len(runs) :] for e in group]
    pairs, warnings = pair_up(own, others) if others else ([], [])
    summaries = _summaries(own, keys)
    if tables_file is not None:
        summaries += _paper_tables(tables_file, own)
    warnings += uneven(own) if summaries else []
    for text in warnings:
        warn(text)
    for summary in summaries:
        show_table(summary.table())
    for note in dict.fromkeys(summary.note for summary in summaries if summary.note):
        out.print(note, markup=False)
    if not keys:
        _tell(own, pairs)
    _write(own, others, pairs, warnings, summaries, report, out_dir)
    if tables_file is not None:
        out.print(f"tables      {tables_file}", markup=False)
    if csv_file is not None:
        csv_file.parent.mkdir(parents=True, exist_ok=True)
        write_csv(csv_file, own)
        out.print(f"table       {csv_file}", markup=False)
    if any(e.findings for e in own):
        raise typer.Exit(FINDING)


def _paper_tables(file: Path, own: list[Evaluation]) -> list[Summary]:
    """Written, and shown with the others."""
    tables = paper_tables(own)
    if not tables:
        raise LinkError(
            "--paper-tables: no run is of a recording named experiment_1 ... experiment_4, nor -s1 and so on"
        )
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(markdown(tables), encoding="utf-8")
    return tables


def _summaries(own: list[Evaluation], keys: list[Key]) -> list[Summary]:
    """The tables that were asked for; without any, configurations side by side when there are several."""
    answers = [e for e in own if e.output is e.run.outputs[0]]
    flown = [e for e in answers if not e.run.no_drone]
    empty = [e for e in answers if e.run.no_drone]
    wanted = keys or ([()] if len(by_config(own)) > 1 else [])
    found = [group_summary(groups(flown, key), key) for key in wanted if flown]
    found += [rotation_summary(turned, key) for key in wanted if (turned := rotation_groups(flown, key))]
    if empty and (wanted or len(empty) > 1):
        found.append(alarm_summary(alarms(empty)))
    if said := reliabilities(answers) if wanted or len(answers) > 1 else []:
        found.append(reliability_summary(said))
    return found


def _tell(own: list[Evaluation], pairs: list[Pair]) -> None:
    if len(own) > MAX_COLUMNS:
        show_table(headline_table(own))
    if pairs:
        show_table(comparison_table(pairs))
    if not pairs or len(own) > 1:
        show_table(metrics_table(own))
    for text, names in _by_text(own, lambda e: [*e.remarks, *_not_evaluated(e)]):
        out.print(f"{names}: {text}", markup=False)
    for text, names in _by_text(own, lambda e: e.findings):
        err.print(f"{names}: {text}", markup=False, style="red")


def _not_evaluated(e: Evaluation) -> list[str]:
    return [f"not evaluated: {', '.join(names)}: {reason}" for reason, names in e.not_evaluated().items()]


def _by_text(own: list[Evaluation], texts: Callable[[Evaluation], list[str]]) -> list[tuple[str, str]]:
    """Each text once, with the runs it holds for."""
    found: dict[str, list[str]] = {}
    for e in own:
        for text in texts(e):
            found.setdefault(text, []).append(label(e))
    several = len(own) > 1
    return [
        (text, f"all {len(own)} runs" if several and len(names) == len(own) else _few(names))
        for text, names in found.items()
    ]


def _few(names: list[str]) -> str:
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return ", ".join(names[:MAX_NAMED]) + more


def _write(
    own: list[Evaluation],
    others: list[Evaluation],
    pairs: list[Pair],
    warnings: list[str],
    summaries: list[Summary],
    report: Path | None,
    out_dir: Path | None,
) -> None:
    folder = out_dir or (report.parent if report else None)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(as_json(own, pairs, warnings), indent=2, allow_nan=False)
        (folder / JSON_FILE).write_text(text + "\n", encoding="utf-8")
        out.print(f"numbers     {folder / JSON_FILE}", markup=False)
    if report is not None:
        report.parent.mkdir(parents=True, exist_ok=True)
        write_report(report, own, others, pairs, warnings, summaries)
        out.print(f"report      {report}", markup=False)
