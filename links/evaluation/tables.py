"""The table of all runs with medians over them, and tables of text for the terminal, HTML and Markdown.

Source: grd. No value is ever filled in: in a median a failed run counts as the worst value, other missing ones are left
out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
import pandas as pd
from rich.table import Table as RichTable
from rich.text import Text

from flow.link import LinkError
from links.evaluation.evaluation import Evaluation, MetricStatus, Value
from links.evaluation.metrics import CATALOGUE, Metric, metric_of, rank

NOTHING = "-"
MAX_NAMED = 4  # names in a text
MAX_COLUMNS = 4  # a terminal shows the metrics of so many runs in columns, of more as rows of headlines
HTML_COLUMNS = 13  # without the labels, so that a page is not wider than a screen
OBJECT = "evaluation"  # column of `runs_table` with the Evaluation itself
REACQUISITIONS = "reacquisition_times_s"  # column of `runs_table` with a list: after each occlusion, inf: never
TABLE_VERSION = "1"  # of a Parquet table; another one has other columns
TIMED_SHARES = ("detection_rate", "observable_detection_rate", "return_share", "observable_share")
COUNTED_SHARES = (*TIMED_SHARES, "precision", "inside_95_share", "rotation_accepted_share", "rotation_inside_95_share")
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


def keys_of(evaluations: Sequence[Evaluation]) -> list[str]:
    """Every metric of any evaluation, in the order of the catalogue, compute times last."""
    return [*CATALOGUE, *dict.fromkeys(key for e in evaluations for key in e.values if key not in CATALOGUE)]


def ranks(evaluations: Sequence[Evaluation], keys: Sequence[str] = ()) -> pd.DataFrame:
    """Metrics across, runs down; a failure is the worst value (inf or -inf), other missing values are NaN."""
    betters = {key: metric_of(key).better for key in keys or keys_of(evaluations)}
    return pd.DataFrame(
        [{key: rank(e.values.get(key), better) for key, better in betters.items()} for e in evaluations]
    )


def runs_table(evaluations: Sequence[Evaluation]) -> pd.DataFrame:
    """One row for each evaluation: what it is of, all metrics (`ranks`), and what shares are pooled by over runs.

    `KEY_count` and `KEY_of` are the counts of a share, `KEY_s` and `KEY_of_s` the seconds of a share of time, whose
    counts are of searches, which differ in length.
    """
    about = pd.DataFrame({"recording": [e.run.recording for e in evaluations]})
    about["config"] = [e.run.config for e in evaluations]
    about["output"] = [e.output.kind.value for e in evaluations]
    about["primary"] = [int(e.output is e.run.outputs[0]) for e in evaluations]
    about["drone"] = [e.run.drone for e in evaluations]
    about["run"] = [e.run.name for e in evaluations]
    about["no_drone"] = [int(e.run.no_drone) for e in evaluations]
    about["span_s"] = [math.nan if e.duration_s is None else e.duration_s for e in evaluations]
    about["outputs"] = [len(e.output.poses) for e in evaluations]
    about["detections"] = [sum(len(s.accepted_xyz_m) for s in e.run.searches or ()) for e in evaluations]
    about[REACQUISITIONS] = [list(e.reacquisition_s) for e in evaluations]
    pooled: dict[str, object] = {}
    for key in COUNTED_SHARES:
        for index, what in enumerate(("count", "of")):
            pooled[f"{key}_{what}"] = pd.array([e.counts.get(key, (None, None))[index] for e in evaluations], "Int64")
    for key in TIMED_SHARES:
        for index, what in enumerate(("s", "of_s")):
            pooled[f"{key}_{what}"] = [e.seconds.get(key, (math.nan, math.nan))[index] for e in evaluations]
    return pd.concat([about, ranks(evaluations), pd.DataFrame(pooled | {OBJECT: list(evaluations)})], axis=1)


def medians(values: pd.DataFrame) -> pd.DataFrame:
    """Median of each column of `ranks`, and how many runs are in it, failed, or were not evaluated.

    The median is +-inf when half of the runs or more failed, NaN when no run has a value.
    """
    counts = {"runs": values.count(), "failed": np.isinf(values).sum(), "not_evaluated": values.isna().sum()}
    return pd.DataFrame({"median": values.median()} | counts)


def by_config(evaluations: Sequence[Evaluation]) -> dict[str, list[Evaluation]]:
    """Evaluations by configuration, in the order in which they were given."""
    return _by(evaluations, lambda e: e.run.config)


def pools(evaluations: Sequence[Evaluation]) -> dict[str, list[Evaluation]]:
    """Evaluations that may be pooled: of one configuration, and of one output where runs have several."""
    return _by(evaluations, lambda e: f"{e.run.config} {e.output.kind if len(e.run.outputs) > 1 else ''}".strip())


def _by(evaluations: Sequence[Evaluation], name: Callable[[Evaluation], str]) -> dict[str, list[Evaluation]]:
    found: dict[str, list[Evaluation]] = {}
    for e in evaluations:
        found.setdefault(name(e), []).append(e)
    return found


def write_csv(path: Path, evaluations: list[Evaluation]) -> None:
    """Write the metrics of all runs, one line for each. `inf` or `-inf` is a failure, empty is not evaluated."""
    runs_table(evaluations).drop(columns=[OBJECT, REACQUISITIONS]).to_csv(path, index=False, float_format="%.12g")


def write_parquet(path: Path, evaluations: list[Evaluation]) -> None:
    """The same as a Parquet file, with the times to reacquire as lists; `read_parquet` reads it."""
    runs = runs_table(evaluations).drop(columns=OBJECT)
    runs.attrs["grd_table"] = TABLE_VERSION
    runs.to_parquet(path, index=False)


def read_parquet(path: Path) -> pd.DataFrame:
    """A table of runs that `write_parquet` wrote, without the evaluations themselves. LinkError: it is none."""
    if not path.is_file():
        raise LinkError(f"{path}: no such file: check the name")
    try:
        runs = pd.read_parquet(path)
    except (OSError, ValueError) as error:
        raise LinkError(f"{path}: not a Parquet table: {error}") from None
    if runs.attrs.get("grd_table") != TABLE_VERSION:
        raise LinkError(f"{path}: not a table of this version of grd: write it with grd evaluate RUNS --parquet FILE")
    return runs


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text."""

    title: str
    frame: pd.DataFrame  # of str, headings may have line breaks
    labels: int = 1  # columns at the left that name the row
    note: str = ""
    sections: Sequence[str] = ()  # (rows,) rows of one section follow each other
    classes: Sequence[str] = ()  # (rows,) CSS class of each row

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
        tables = "".join(self._html_part([*labels, *columns]) for columns in parts)
        note = f'<p class="note">{escape(self.note)}</p>' if self.note else ""
        return f"<h3>{escape(self.title)}</h3>{tables}{note}"

    def _html_part(self, columns: list[int]) -> str:
        head = "".join(f"<th>{escape(self.frame.columns[column])}</th>" for column in columns)
        rows: list[str] = []
        for row, (cells, section) in enumerate(self._rows()):
            if section:
                rows.append(f'<tr class="section"><td colspan="{len(columns)}">{escape(section)}</td></tr>')
            kinds = ["label" if column < self.labels else "" for column in columns]
            tds = (f'<td class="{kind}">{escape(cells[c])}</td>' for kind, c in zip(kinds, columns, strict=True))
            rows.append(f'<tr class="{self.classes[row] if self.classes else ""}">{"".join(tds)}</tr>')
        return f"<table><tr>{head}</tr>{''.join(rows)}</table>"

    def markdown(self) -> str:
        """For a README."""
        heads = [head.replace("\n", " ") for head in self.frame.columns]
        lines = [heads, ["---"] * len(heads), *(cells for cells, _ in self._rows())]
        return "\n".join([f"{self.title}\n", *(f"| {' | '.join(cells)} |" for cells in lines)])

    def _rows(self) -> list[tuple[list[str], str]]:
        """Cells of each row and, in the first row of a section, its name."""
        names = [*self.sections] or [""] * len(self.frame)
        first = [name if row == 0 or names[row - 1] != name else "" for row, name in enumerate(names)]
        return list(zip(self.frame.to_numpy().tolist(), first, strict=True))


def text_frame(rows: list[list[str]], heads: list[str]) -> pd.DataFrame:
    """Rows of text as a frame; headings may be equal."""
    return pd.DataFrame(rows, columns=range(len(heads)), dtype=object).set_axis(heads, axis=1)


def some_of(names: list[str]) -> str:
    """`a, b, c, d and 3 more`."""
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return ", ".join(names[:MAX_NAMED]) + more


def label(e: Evaluation) -> str:
    """Name of a run: its folder, and configuration, output and drone where these are not in its name."""
    run = e.run
    name = run.name.rstrip("/").split("/")[-1]
    name += f" ({run.config})" if name == run.recording and run.config else ""
    name += f" {e.output.kind}" if len(run.outputs) > 1 else ""
    return name + (f" drone {run.drone}" if len(run.drones) > 1 else "")


def number_text(value: float, decimals: int, longer_than: float | None = None) -> str:
    """A number; NaN is NOTHING, inf is "never", or longer than a time [s] when that is given."""
    if math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "never" if longer_than is None else f">{longer_than:.0f}"
    return f"{value:.{decimals}f}"


def number(value: float, metric: Metric) -> str:
    """A value with the decimals of its unit; three significant digits for times and counts."""
    if math.isnan(value) or math.isinf(value):
        return NOTHING if math.isnan(value) else "failed"
    decimals = {"%": 1, "Hz": 1, "deg": 2, "m": 3}.get(metric.unit)
    if decimals is None and metric.unit == "" and value == round(value):
        decimals = 0
    if decimals is not None:
        return f"{value:.{decimals}f}"
    return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"


def cell(value: Value | None, metric: Metric) -> str:
    """A value with its interval; the reason of a failure; NOTHING for another missing value."""
    if value is None or value.value is None:
        return value.note if value is not None and value.failed else NOTHING
    text = number(value.value, metric)
    if value.low is not None and value.high is not None:
        text += f" [{number(value.low, metric)}, {number(value.high, metric)}]"
    return text


def median_cell(pool: pd.Series, metric: Metric) -> str:
    """A row of `medians`: `0.12`, `failed (3 of 5 failed)`, `0.12 (2 not evaluated)`."""
    if math.isnan(pool.loc["median"]):
        return NOTHING
    details = [f"{pool.failed:.0f} of {pool.runs:.0f} failed"] if pool.failed and pool.runs > 1 else []
    details += [f"{pool.not_evaluated:.0f} not evaluated"] if pool.not_evaluated else []
    return number(pool.loc["median"], metric) + (f" ({', '.join(details)})" if details else "")


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
    keys = keys_of(own)
    columns = {name: runs for name, runs in median_columns(own).items() if len(runs) > 1 or not shown}
    pooled = [medians(ranks(runs, keys)) for runs in columns.values()]
    rows: list[list[str]] = []
    sections: list[str] = []
    classes: list[str] = []
    for key in keys:
        values = [value for e in own if (value := e.values.get(key)) is not None]
        if not any(value.failed or value.value is not None for value in values) or not (detailed or in_terminal(key)):
            continue
        metric = metric_of(key)
        cells = [cell(e.values.get(key), metric) for e in shown]
        cells += [median_cell(pool.loc[key], metric) for pool in pooled]
        if detailed:
            samples = "" if values[0].samples is None else str(values[0].samples)
            cells += [samples, "" if values[0].failed else values[0].note]
        rows.append([metric.title, *cells])
        sections.append(metric.group)
        classes.append("failed" if any(value.failed for value in values) else "")
    heads = ["metric", *map(label, shown), *columns, *(["samples", "note"] if detailed else [])]
    return Table(title, text_frame(rows, heads), sections=sections, classes=classes)


def in_terminal(key: str) -> bool:
    """Whether a terminal shows a metric: of compute times the long ones alone."""
    return not key.endswith("_p50")


def headline_table(evaluations: list[Evaluation], with_medians: bool = False) -> Table:
    """Runs down, the most important metrics across; medians last."""
    metrics = [metric_of(key) for key in HEADLINES]
    rows = [
        [label(e), *("none" if math.isinf(v) else number(v, m) for v, m in zip(values, metrics, strict=True))]
        for e, values in zip(evaluations, ranks(evaluations, list(HEADLINES)).to_numpy(), strict=True)
    ]
    for name, several in median_columns(evaluations).items() if with_medians else ():
        values = medians(ranks(several, list(HEADLINES)))["median"]
        rows.append([name, *(number(v, m) for v, m in zip(values, metrics, strict=True))])
    return Table("runs", text_frame(rows, ["run", *HEADLINES.values()]))


def not_evaluated_names(e: Evaluation) -> dict[str, list[str]]:
    """Names of the metrics that were not evaluated by their reason. Failures of the run are not among them."""
    reasons: dict[str, list[str]] = {}
    for key, value in e.values.items():
        if value.status is MetricStatus.NOT_EVALUATED:
            reasons.setdefault(value.note, []).append(metric_of(key).name)
    return reasons
