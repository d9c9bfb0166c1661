"""Tables for people and programs: text tables for the terminal, HTML and Markdown, CSV, JSON.

Source: grd.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.table import Table as RichTable
from rich.text import Text

from links.evaluation.comparison import (
    OBJECT,
    Pair,
    Pooled,
    common_rmse_m,
    compare,
    keys_of,
    pooled,
    pools,
    runs_table,
    verdict,
)
from links.evaluation.evaluation import Evaluation, Status, Value
from links.evaluation.metrics import Better, Metric, metric_of

NOTHING = "-"
HTML_COLUMNS = 13  # without the labels, so that a page is not wider than a screen
MAX_COLUMNS = 4  # a terminal shows the metrics of so many runs in columns, of more as rows of headlines
COMMON = "3D RMSE in the time in which both have an output"
HEADLINES = {
    "track_accuracy": "track accuracy %",
    "availability": "output %",
    "held_rmse_m": "held RMSE m",
    "rmse_x_m": "x m",
    "rmse_y_m": "y m",
    "rmse_z_m": "z m",
    "rmse_m": "3D m",
    "max_m": "max m",
    "first_accurate_s": "first accurate s",
    "longest_gap_s": "gap s",
    "false_per_min": "false /min",
    "rmse_yaw_deg": "yaw deg",
    "nees_mean": "NEES",
    "inside_95_share": "in 95 %",
}


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text."""

    title: str
    frame: pd.DataFrame  # of str, headings may have line breaks
    labels: int = 1  # columns at the left that name the row
    note: str = ""
    sections: Sequence[str] | None = None  # (rows,) rows of one section follow each other
    classes: Sequence[str] | None = None  # (rows,) CSS class of each row

    def rich(self) -> RichTable:
        """For a terminal."""
        table = RichTable(title=self.title, title_justify="left")
        for index, head in enumerate(self.frame.columns):
            left = index < self.labels or head == ""
            table.add_column(Text(head), justify="left" if left else "right", no_wrap=index < self.labels)
        for row, (cells, section) in enumerate(self._rows()):
            if section:
                if row:
                    table.add_section()
                table.add_row(Text(section, style="bold"))
            table.add_row(*(Text(cell) for cell in cells))
        return table

    def html(self) -> str:
        """For a page: everything is escaped. A wide table is split into parts that each have the labels."""
        labels, rest = list(range(self.labels)), list(range(self.labels, self.frame.shape[1]))
        parts = [rest[i : i + HTML_COLUMNS] for i in range(0, len(rest), HTML_COLUMNS)]
        note = f'<p class="note">{escape(self.note)}</p>' if self.note else ""
        tables = "".join(self._html_part([*labels, *columns]) for columns in parts)
        return f"<h3>{escape(self.title)}</h3>{tables}{note}"

    def _html_part(self, columns: list[int]) -> str:
        head = "".join(f"<th>{escape(self.frame.columns[column])}</th>" for column in columns)
        rows: list[str] = []
        for row, (cells, section) in enumerate(self._rows()):
            if section:
                rows.append(f'<tr class="section"><td colspan="{len(columns)}">{escape(section)}</td></tr>')
            css = "" if self.classes is None else self.classes[row]
            tds = "".join(
                f"<td{' class=label' if column < self.labels else ''}>{escape(cells[column])}</td>"
                for column in columns
            )
            rows.append(f'<tr class="{css}">{tds}</tr>')
        return f"<table><tr>{head}</tr>{''.join(rows)}</table>"

    def markdown(self) -> str:
        """For a README."""
        heads = [head.replace("\n", " ") for head in self.frame.columns]
        lines = [heads, ["---"] * len(heads), *(cells for cells, _ in self._rows())]
        return "\n".join([f"{self.title}\n", *(f"| {' | '.join(cells)} |" for cells in lines)])

    def _rows(self) -> list[tuple[list[str], str]]:
        """Cells of each row and, in the first row of a section, its name."""
        names = [""] * len(self.frame) if self.sections is None else list(self.sections)
        first = [name if row == 0 or names[row - 1] != name else "" for row, name in enumerate(names)]
        return list(zip(self.frame.to_numpy().tolist(), first, strict=True))


def number_text(value: float, decimals: int, longer_than: float | None = None) -> str:
    """A number; NaN is NOTHING, inf is "never", or longer than a time [s] when that is given."""
    if math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "never" if longer_than is None else f">{longer_than:.0f}"
    return f"{value:.{decimals}f}"


def label(e: Evaluation) -> str:
    """Name of a run: its folder, and configuration, output and drone where these are not in its name."""
    run = e.run
    name = run.name.rstrip("/").split("/")[-1]
    name += f" ({run.config})" if name == run.recording and run.config else ""
    name += f" {e.output.kind}" if len(run.outputs) > 1 else ""
    return name + (f" drone {run.drone}" if len(run.drones) > 1 else "")


def number(value: float, metric: Metric) -> str:
    """A value with the decimals of its unit; three significant digits for times and counts."""
    if math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "failed"
    decimals = {"%": 1, "Hz": 1, "deg": 2, "m": 3}.get(metric.unit)
    if decimals is not None:
        return f"{value:.{decimals}f}"
    if metric.unit == "" and value == round(value):
        return f"{value:.0f}"
    return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"


def cell(value: Value | None, metric: Metric) -> str:
    """A value with its interval; the reason of a failure; NOTHING for another missing value."""
    if value is None or value.value is None:
        return value.note if value is not None and value.failed else NOTHING
    text = number(value.value, metric)
    if value.low is not None and value.high is not None:
        text += f" [{number(value.low, metric)}, {number(value.high, metric)}]"
    return text


def pooled_cell(pool: Pooled, metric: Metric) -> str:
    """`0.12`, `failed (3 of 5 failed)`, `0.12 (2 not evaluated)`."""
    if math.isnan(pool.median):
        return NOTHING
    details = [f"{pool.failed} of {pool.runs} failed"] if pool.failed and pool.runs > 1 else []
    details += [f"{pool.not_evaluated} not evaluated"] if pool.not_evaluated else []
    return number(pool.median, metric) + (f" ({', '.join(details)})" if details else "")


def median_columns(evaluations: list[Evaluation]) -> dict[str, list[Evaluation]]:
    """`median of 6`, for each configuration and output its own; empty for a single evaluation."""
    if len(evaluations) < 2:
        return {}
    found = pools(evaluations)
    if len(found) == 1:
        return {f"median of {len(evaluations)}": evaluations}
    return {f"{name}: median of {len(e)}" if len(e) > 1 else name: e for name, e in found.items()}


def metrics_table(title: str, own: list[Evaluation], shown: list[Evaluation], detailed: bool = False) -> Table:
    """Metrics down; across the runs in `shown`, then the medians over all. Compute times are the long ones alone.

    `detailed`, for a single run: all compute times, samples and notes.
    """
    medians = {name: runs for name, runs in median_columns(own).items() if len(runs) > 1 or not shown}
    tables = [runs_table(runs) for runs in medians.values()]
    rows: list[list[str]] = []
    sections: list[str] = []
    classes: list[str] = []
    for key in keys_of(own):
        values = [value for e in own if (value := e.values.get(key)) is not None]
        if not any(value.failed or value.value is not None for value in values) or not (detailed or _in_terminal(key)):
            continue
        metric = metric_of(key)
        cells = [cell(e.values.get(key), metric) for e in shown]
        cells += [pooled_cell(pooled(table.loc[:, key]), metric) if key in table else NOTHING for table in tables]
        if detailed:
            cells += ["" if values[0].samples is None else str(values[0].samples)]
            cells += ["" if values[0].failed else values[0].note]
        rows.append([metric.title, *cells])
        sections.append(metric.group)
        classes.append("failed" if any(value.failed for value in values) else "")
    heads = ["metric", *map(label, shown), *medians, *(["samples", "note"] if detailed else [])]
    return Table(title, _frame(rows, heads), sections=sections, classes=classes)


def _in_terminal(key: str) -> bool:
    return not key.endswith("_p50")


def headline_table(evaluations: list[Evaluation], medians: bool = False) -> Table:
    """Runs down, the most important metrics across; medians last."""
    rows: list[list[str]] = []
    for e in evaluations:
        values = [(e.values[key], metric_of(key)) for key in HEADLINES]
        rows.append(
            [
                label(e),
                *("none" if v.failed else number(math.nan if v.value is None else v.value, m) for v, m in values),
            ]
        )
    for name, several in median_columns(evaluations).items() if medians else []:
        table = runs_table(several)
        rows.append([name, *(number(pooled(table.loc[:, key]).median, metric_of(key)) for key in HEADLINES)])
    return Table("runs", _frame(rows, ["run", *HEADLINES.values()]))


def comparison_table(pairs: list[Pair]) -> Table:
    """RUN next to OTHER: medians over the pairs, the median ratio, and which side is better."""
    one = len(pairs) == 1
    names = [label(pairs[0].own), label(pairs[0].other)] if one else ["RUN", "OTHER"]
    title = "against the other run" if one else f"against the other runs, medians of {len(pairs)} pairs"
    rows: list[list[str]] = []
    sections: list[str] = []
    for key, compared in compare(pairs).items():
        metric = metric_of(key)
        if _in_terminal(key):
            ratio = NOTHING if compared.ratio is None else f"{compared.ratio:.2g}"
            sides = [pooled_cell(side, metric) for side in (compared.own, compared.other)]
            rows.append(
                [metric.title, *sides, ratio, verdict(compared.own.median, compared.other.median, metric.better)]
            )
            sections.append(metric.group)
    common = common_rmse_m(pairs)
    if common is not None:
        own, other = common
        ratio = f"{own / other:.2g}" if other > 0 else NOTHING
        rows.append([f"{COMMON} [m]", f"{own:.3f}", f"{other:.3f}", ratio, verdict(own, other, Better.LOW)])
        sections.append("common time")
    return Table(
        title, _frame(rows, ["metric", *names, "ratio", ""]), sections=sections, classes=[row[-1] for row in rows]
    )


def _frame(rows: list[list[str]], heads: list[str]) -> pd.DataFrame:
    frame = pd.DataFrame(rows, columns=range(len(heads)), dtype=object)
    frame.columns = pd.Index(heads)
    return frame


def write_csv(path: Path, evaluations: list[Evaluation]) -> None:
    """Write the metrics of all runs, one line for each. `inf` or `-inf` is a failure, empty is not evaluated."""
    runs_table(evaluations).drop(columns=OBJECT).to_csv(path, index=False, float_format="%.12g")


def as_json(evaluations: list[Evaluation], pairs: list[Pair], warnings: list[str]) -> dict[str, Any]:
    """Everything for programs. No NaN: a metric without a value has `null`, a status and a reason."""
    tree: dict[str, Any] = {
        "format": 2,
        "limits": dataclasses.asdict(evaluations[0].limits),
        "warnings": warnings,
        "runs": [_run_json(e) for e in evaluations],
    }
    keys = keys_of(evaluations)
    medians = {
        name: {key: _pooled_json(pooled(column)) for key, column in runs_table(several).reindex(columns=keys).items()}
        for name, several in pools(evaluations).items()
    }
    if len(medians) > 1:
        tree["median_by_config"] = medians
    elif len(evaluations) > 1:
        tree["median"] = next(iter(medians.values()))
    if pairs:
        tree["against"] = {
            "pairs": [
                {"recording": p.own.run.recording, "run": p.own.run.name, "other": p.other.run.name} for p in pairs
            ],
            "others": [_run_json(pair.other) for pair in pairs],
            "metrics": {
                key: {"run": _pooled_json(row.own), "other": _pooled_json(row.other), "ratio": row.ratio}
                for key, row in compare(pairs).items()
            },
            "rmse_m_while_both_have_output": common_rmse_m(pairs),
        }
    return tree


def _run_json(e: Evaluation) -> dict[str, Any]:
    return {
        "name": e.run.name,
        "recording": e.run.recording,
        "config": e.run.config,
        "drone": e.run.drone,
        "output": e.output.kind.value,
        "outputs": len(e.output.poses),
        "span_s": None if e.span_ns is None else [t / 1e9 for t in e.span_ns],
        "metrics": {key: _value_json(key, value) for key, value in e.values.items()},
        "findings": e.findings,
        "remarks": e.remarks,
        "not_evaluated": not_evaluated_names(e),
    }


def not_evaluated_names(e: Evaluation) -> dict[str, list[str]]:
    """Names of the metrics that were not evaluated by their reason. Failures of the run are not among them."""
    reasons: dict[str, list[str]] = {}
    for key, value in e.values.items():
        if value.status is Status.NOT_EVALUATED:
            reasons.setdefault(value.note, []).append(metric_of(key).name)
    return reasons


def _value_json(key: str, value: Value) -> dict[str, Any]:
    tree = {"value": value.value, "unit": metric_of(key).unit, "status": value.status.value}
    optional = {"samples": value.samples, "low": value.low, "high": value.high, "note": value.note or None}
    return tree | {name: content for name, content in optional.items() if content is not None}


def _pooled_json(pool: Pooled) -> dict[str, Any]:
    median = pool.median if np.isfinite(pool.median) else None
    counts = {"runs": pool.runs, "runs_failed": pool.failed, "runs_not_evaluated": pool.not_evaluated}
    return {"median": median, "failed": math.isinf(pool.median), **counts}
