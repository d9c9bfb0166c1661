"""What `grd evaluate` prints and writes. It needs the packages of the extra `evaluate`.

Source: DESIGN, Command line.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import astuple, dataclass
from pathlib import Path

import pandas as pd

from flow.jobs import Workers, run_all
from flow.link import LinkError
from links.cli.console import check_output, err, out, progress_bar, show_table, warn
from links.evaluation.association import EvaluationLimits
from links.evaluation.comparison import (
    Pair,
    comparison_table,
    markdown,
    pair_up,
    paper_tables,
    uneven_warnings,
)
from links.evaluation.evaluation import Evaluation
from links.evaluation.groups import (
    Key,
    false_track_table,
    group_table,
    probability_score_table,
    reliability_table,
    rotation_table,
)
from links.evaluation.metrics import evaluate
from links.evaluation.report import as_json, write_report
from links.evaluation.run_data import per_drone, read_run
from links.evaluation.tables import (
    MAX_COLUMNS,
    Table,
    by_config,
    headline_table,
    label,
    metrics_table,
    not_evaluated_names,
    read_parquet,
    runs_table,
    some_of,
    write_csv,
    write_parquet,
)


@dataclass(frozen=True, slots=True)
class Files:
    """Files to write; None: not asked for."""

    numbers: Path | None
    report: Path | None
    csv: Path | None
    parquet: Path | None
    paper_tables: Path | None


@dataclass(frozen=True, slots=True)
class EvaluationTask:
    """A run to evaluate."""

    run: Path
    truth: Path | None
    no_drone: bool
    limits: EvaluationLimits


def evaluate_one(task: EvaluationTask, report: Callable[[float], None]) -> list[Evaluation]:
    """Evaluations of a run: of each output, for each drone with truth."""
    parts = per_drone(read_run(task.run, task.truth, task.no_drone), task.limits)
    return [evaluate(run, output, task.limits) for run in parts for output in run.outputs]


def evaluate_all(
    runs: list[Path],
    against: list[Path],
    truth: Path | None,
    no_drone: bool,
    limits: EvaluationLimits,
    workers: Workers = 1,
) -> tuple[list[Evaluation], list[Evaluation]]:
    """Evaluations of the runs, and of those that they are compared with."""
    tasks = [EvaluationTask(path, truth, no_drone, limits) for path in (*runs, *against)]
    with progress_bar(f"evaluate {len(tasks)} runs") as step:
        of_each = run_all(evaluate_one, tasks, workers, lambda shares: step(sum(shares), len(tasks)))
    own, others = of_each[: len(runs)], of_each[len(runs) :]
    return [e for part in own for e in part], [e for part in others for e in part]


def prepared(files: Files) -> Files:
    """The same files after their folders were made. LinkError when one cannot be written."""
    options = ("--out", "--report", "--csv", "--parquet", "--paper-tables")
    for option, file in zip(options, astuple(files), strict=True):
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            check_output(file, option, overwrite=True)
    return files


def compare_and_show(own: list[Evaluation], others: list[Evaluation], keys: list[Key], files: Files) -> None:
    """Print the tables and write the files. Without `keys` the tables of single runs are printed, too."""
    pairs, warnings = pair_up(own, others) if others else ([], [])
    summaries = _summaries(own, keys)
    if files.paper_tables is not None:
        summaries += _paper_tables(files.paper_tables, own)
    warnings += uneven_warnings(own) if summaries else []
    for text in warnings:
        warn(text)
    for summary in summaries:
        show_table(summary.rich())
    for note in dict.fromkeys(summary.note for summary in summaries if summary.note):
        out.print(note, markup=False)
    if not keys:
        _show(own, pairs)
    if files.numbers is not None:
        text = json.dumps(as_json(own, pairs, warnings), indent=2, allow_nan=False)
        files.numbers.write_text(text + "\n", encoding="utf-8")
    if files.report is not None:
        write_report(files.report, own, others, pairs, warnings, summaries)
    if files.csv is not None:
        write_csv(files.csv, own)
    if files.parquet is not None:
        write_parquet(files.parquet, own)
    named = (
        ("numbers", files.numbers),
        ("report", files.report),
        ("tables", files.paper_tables),
        ("table", files.csv),
        ("table", files.parquet),
    )
    for name, file in named:
        if file is not None:
            out.print(f"{name:11} {file}", markup=False)


def show_tables(files: list[Path], keys: list[Key]) -> None:
    """Print the tables over all runs of Parquet files, without reading the runs again."""
    runs = pd.concat([read_parquet(file) for file in files], ignore_index=True)
    primary = runs.query("primary == 1")
    flights, empty = primary.query("no_drone == 0"), primary.query("no_drone == 1")
    tables = [group_table(flights, key) for key in keys or [()] if len(flights)]
    for table in [*tables, *([false_track_table(empty)] if len(empty) else [])]:
        show_table(table.rich())
        out.print(table.note, markup=False)


def _summaries(own: list[Evaluation], keys: list[Key]) -> list[Table]:
    """Tables over several runs: those that were asked for, otherwise configurations when there are several."""
    primary = [e for e in own if e.output is e.run.outputs[0]]
    flights = [e for e in primary if not e.run.no_drone]
    empty = [e for e in primary if e.run.no_drone]
    wanted = keys or ([()] if len(by_config(own)) > 1 else [])
    tables = [group_table(runs_table(flights), key) for key in wanted if flights]
    tables += [table for key in wanted if (table := rotation_table(flights, key))]
    if empty and (wanted or len(empty) > 1):
        tables.append(false_track_table(runs_table(empty)))
    if (wanted or len(primary) > 1) and (table := reliability_table(primary)):
        tables.append(table)
    if (wanted or len(primary) > 1) and (table := probability_score_table(primary)):
        tables.append(table)
    return tables


def _paper_tables(file: Path, own: list[Evaluation]) -> list[Table]:
    """Write the paper's tables."""
    tables = paper_tables(own)
    if not tables:
        raise LinkError(
            "--paper-tables: no run is of a recording named experiment_1 ... experiment_4, nor of one with a suffix "
            "(experiment_1-s1)"
        )
    file.write_text(markdown(tables), encoding="utf-8")
    return tables


def _show(own: list[Evaluation], pairs: list[Pair]) -> None:
    """Print the tables of single runs, and each text once with the runs that it holds for."""
    if len(own) > MAX_COLUMNS:
        show_table(headline_table(own).rich())
    if pairs:
        show_table(comparison_table(pairs).rich())
    if not pairs or len(own) > 1:
        show_table(metrics_table("against truth", own, own if len(own) <= MAX_COLUMNS else []).rich())
    for text, names in _by_text(own, lambda e: [*e.remarks, *_not_evaluated(e)]):
        out.print(f"{names}: {text}", markup=False)
    for text, names in _by_text(own, lambda e: e.findings):
        err.print(f"{names}: {text}", markup=False, style="red")


def _not_evaluated(e: Evaluation) -> list[str]:
    return [f"not evaluated: {', '.join(names)}: {reason}" for reason, names in not_evaluated_names(e).items()]


def _by_text(own: list[Evaluation], texts: Callable[[Evaluation], list[str]]) -> list[tuple[str, str]]:
    """Each text once, with the runs that it holds for."""
    found: dict[str, list[str]] = {}
    for e in own:
        for text in texts(e):
            found.setdefault(text, []).append(label(e))
    everything = f"all {len(own)} {'runs' if len(own) == len({e.run.name for e in own}) else 'outputs'}"
    return [(text, everything if 1 < len(own) == len(names) else some_of(names)) for text, names in found.items()]
