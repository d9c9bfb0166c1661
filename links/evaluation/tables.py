"""The numbers as people read them in a terminal, and as machines read them in `evaluation.json`.

Source: ours.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from rich.table import Table
from rich.text import Text

from links.evaluation.catalogue import Metric, Value, metric_of
from links.evaluation.compare import COMMON, Compared, Pair, Pooled, alike, compared, keys_of, pooled, verdict
from links.evaluation.judged import Evaluation

MAX_COLUMNS = 4  # more runs than this are rows of a table of headlines
HEADLINES = {
    "right_share": "right %",
    "fresh_share": "output %",
    "held_rmse_m": "held RMSE m",
    "rmse_x_m": "x m",
    "rmse_y_m": "y m",
    "rmse_z_m": "z m",
    "rmse_m": "3D m",
    "max_m": "max m",
    "first_right_s": "first right s",
    "longest_gap_s": "gap s",
    "false_per_min": "false /min",
    "rmse_yaw_deg": "yaw deg",
    "nees_mean": "NEES",
    "inside_95_share": "in 95 %",
}


def label(evaluation: Evaluation) -> str:
    """A run's column: its folder's name, and configuration, output and drone where the name does not tell them."""
    run = evaluation.run
    name = run.name.rstrip("/").split("/")[-1]
    name += f" ({run.config})" if name == run.recording and run.config else ""
    name += f" {evaluation.output.name}" if len(run.outputs) > 1 else ""
    return name + (f" drone {run.drone}" if len(run.drones) > 1 else "")


def number(value: float, metric: Metric) -> str:
    """Three significant digits, never fewer than the unit asks for."""
    if math.isinf(value):
        return "failed"
    if metric.unit in ("%", "Hz"):
        return f"{value:.1f}"
    if metric.unit == "deg":
        return f"{value:.2f}"
    if metric.unit == "m":
        return f"{value:.3f}"
    if metric.unit == "" and value == round(value):
        return f"{value:.0f}"
    return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"


def cell(value: Value | None, metric: Metric) -> str:
    """A number with its interval; `none` for a failure, `-` for what could not be measured."""
    if value is None or (value.value is None and not value.failed):
        return "-"
    if value.value is None:
        return value.note
    text = number(value.value, metric)
    if value.low is not None and value.high is not None:
        text += f" [{number(value.low, metric)}, {number(value.high, metric)}]"
    return text


def rows_that_matter(evaluations: list[Evaluation]) -> list[str]:
    """Metrics that at least one run has a number for, or failed."""
    return [
        key
        for key in keys_of(evaluations)
        if any((v := e.values.get(key)) is not None and (v.value is not None or v.failed) for e in evaluations)
    ]


def metrics_table(evaluations: list[Evaluation]) -> Table:
    """Metrics down, runs across (up to MAX_COLUMNS), the medians over the runs of each configuration last."""
    shown = evaluations if len(evaluations) <= MAX_COLUMNS else []
    table = Table(title="against truth", title_justify="left")
    table.add_column("metric", no_wrap=True)
    for evaluation in shown:
        table.add_column(Text(label(evaluation)), justify="right")
    medians = [(name, several) for name, several in median_columns(evaluations) if len(several) > 1 or not shown]
    for name, _ in medians:
        table.add_column(Text(name), justify="right")
    group = ""
    for key in rows_that_matter(evaluations):
        if key.endswith("_p50"):
            continue  # of compute times the terminal shows the long ones
        metric = metric_of(key)
        if metric.group != group:
            group = metric.group
            table.add_section()
            table.add_row(Text(group, style="bold"))
        cells = [Text(cell(e.values.get(key), metric)) for e in shown]
        cells += [Text(pooled_cell(pooled(several, key), metric)) for _, several in medians]
        table.add_row(Text(titled(metric)), *cells)
    return table


def median_columns(evaluations: list[Evaluation]) -> list[tuple[str, list[Evaluation]]]:
    """`median of 6`, of each configuration and output its own; nothing for a single run."""
    if len(evaluations) < 2:
        return []
    pools = alike(evaluations)
    if len(pools) == 1:
        return [(f"median of {len(evaluations)}", evaluations)]
    return [(f"{name}: median of {len(e)}" if len(e) > 1 else name, e) for name, e in pools.items()]


def titled(metric: Metric) -> str:
    """`RMSE x [m]`."""
    return f"{metric.name} [{metric.unit}]" if metric.unit else metric.name


def pooled_cell(pool: Pooled, metric: Metric) -> str:
    """`0.12`, `failed (3 of 5 failed)`, `0.12 (2 not evaluated)`."""
    if pool.median is None:
        return "-"
    asides = [f"{pool.failed} of {pool.counted} failed"] if pool.failed and pool.counted > 1 else []
    asides += [f"{pool.left_out} not evaluated"] if pool.left_out else []
    return number(pool.median, metric) + (f" ({', '.join(asides)})" if asides else "")


def headline_table(evaluations: list[Evaluation]) -> Table:
    """Runs down, the most important metrics across."""
    table = Table(title="runs", title_justify="left")
    table.add_column("run")
    for name in HEADLINES.values():
        table.add_column(name, justify="right")
    for e in evaluations:
        cells = []
        for key in HEADLINES:
            value = e.values[key]
            given = "-" if value.value is None else number(value.value, metric_of(key))
            cells.append("none" if value.failed else given)
        table.add_row(Text(label(e)), *cells)
    return table


def comparison_table(pairs: list[Pair]) -> Table:
    """RUN beside OTHER, medians over pairs, and the ratio of each pair."""
    one = len(pairs) == 1
    table = Table(
        title="against the other" if one else f"against the others, medians of {len(pairs)} pairs", title_justify="left"
    )
    names = [label(pairs[0].own), label(pairs[0].other)] if one else ["RUN", "OTHER"]
    for name in ("metric", *names, "ratio", ""):
        table.add_column(
            Text(name),
            justify="left" if name in ("metric", "") else "right",
            no_wrap=name not in names,
            overflow="fold",
        )
    for key, row in comparison_rows(pairs):
        if key.endswith("_p50"):
            continue
        metric = metric_of(key)
        own, other = (pooled_cell(side, metric) for side in (row.own, row.other))
        table.add_row(Text(titled(metric)), Text(own), Text(other), ratio_cell(row), word(row, metric))
    common = common_rmse(pairs)
    if common is not None:
        a, b = common
        table.add_section()
        ratio = f"{a / b:.2g}" if b > 0 else "-"
        table.add_row(f"{COMMON} [m]", f"{a:.3f}", f"{b:.3f}", ratio, verdict(a, b, "low"))
    return table


def comparison_rows(pairs: list[Pair]) -> list[tuple[str, Compared]]:
    """Every metric that some pair has on both sides."""
    keys = keys_of([e for pair in pairs for e in (pair.own, pair.other)])
    rows = [(key, compared(pairs, key)) for key in keys]
    return [(key, row) for key, row in rows if row.own.median is not None]


def ratio_cell(row: Compared) -> str:
    """Median ratio; nothing when a side is 0 or failed."""
    return "-" if row.ratio is None else f"{row.ratio:.2g}"


def word(row: Compared, metric: Metric) -> str:
    """better, worse, same."""
    return verdict(row.own.median, row.other.median, metric.better)


def common_rmse(pairs: list[Pair]) -> tuple[float, float] | None:
    """Medians over the pairs that have such a time."""
    both = [errors for pair in pairs if (errors := pair.common_rmse_m()) is not None]
    if not both:
        return None
    middle = [sorted(side)[len(both) // 2] for side in zip(*both, strict=True)]
    return middle[0], middle[1]


def as_json(evaluations: list[Evaluation], pairs: list[Pair], warnings: list[str]) -> dict[str, Any]:
    """All of it for machines. No NaN: a metric without a value has `null` and a reason."""
    tree: dict[str, Any] = {
        "format": 1,
        "limits": dataclasses.asdict(evaluations[0].limits),
        "warnings": warnings,
        "runs": [_run_json(e) for e in evaluations],
    }
    pools = alike(evaluations)
    medians = {
        name: {key: _pooled_json(pooled(several, key)) for key in keys_of(evaluations)}
        for name, several in pools.items()
    }
    if len(pools) > 1:
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
                for key, row in comparison_rows(pairs)
            },
            "rmse_m_while_both_have_output": common_rmse(pairs),
        }
    return tree


def _run_json(e: Evaluation) -> dict[str, Any]:
    return {
        "name": e.run.name,
        "recording": e.run.recording,
        "config": e.run.config,
        "drone": e.run.drone,
        "output": e.output.name,
        "outputs": len(e.output.poses),
        "span_s": None if e.span_ns is None else [t / 1e9 for t in e.span_ns],
        "metrics": {key: _value_json(key, value) for key, value in e.values.items()},
        "findings": e.findings,
        "remarks": e.remarks,
        "not_evaluated": e.not_evaluated(),
    }


def _value_json(key: str, value: Value) -> dict[str, Any]:
    tree: dict[str, Any] = {"value": value.value, "unit": metric_of(key).unit}
    if value.value is None:
        tree |= {"failed": value.failed, "applies": value.applies}
    optional = {"samples": value.samples, "low": value.low, "high": value.high, "note": value.note or None}
    return tree | {name: content for name, content in optional.items() if content is not None}


def _pooled_json(pool: Pooled) -> dict[str, Any]:
    failed = pool.median is not None and math.isinf(pool.median)
    tree: dict[str, Any] = {"median": None if failed else pool.median, "failed": failed}
    return tree | {"runs": pool.counted, "runs_failed": pool.failed, "runs_not_evaluated": pool.left_out}
