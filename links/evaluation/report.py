"""The report as HTML (one file, figures first, then tables, every text escaped) and as JSON.

Source: grd.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from links.evaluation.comparison import Pair, common_rmse_m, compare, comparison_table
from links.evaluation.evaluation import Evaluation, Value
from links.evaluation.figures import reliability_figure, run_figures
from links.evaluation.groups import reliability
from links.evaluation.metrics import Metric, metric_of
from links.evaluation.tables import (
    Table,
    headline_table,
    keys_of,
    label,
    medians,
    metrics_table,
    not_evaluated_names,
    number,
    pools,
    ranks,
)

MAX_RUNS = 40  # runs with figures: a browser takes no larger file
STYLE = """
:root{color-scheme:light dark;--ink:#223;--page:#f6f7f9;--paper:#fff;--line:#dde2ea;--section:#eef1f6;--soft:#5b6475;
--bad:#b01818;--good:#1b7f4b}
body{font:14px/1.45 system-ui,sans-serif;color:var(--ink);background:var(--page);margin:0 auto;max-width:1180px;
padding:24px;overflow-wrap:anywhere}
h1{font-size:24px;margin:0 0 4px}h2{font-size:19px;margin:36px 0 6px;border-bottom:2px solid;padding-bottom:3px}
h3{font-size:15px;margin:18px 0 4px}table{border-collapse:collapse;background:var(--paper);margin:8px 0;max-width:100%}
th,td{padding:3px 7px;border:1px solid var(--line);text-align:right}
th{font-size:12px;vertical-align:bottom}td{overflow-wrap:break-word}td.label{text-align:left;overflow-wrap:anywhere}
tr.section td{background:var(--section);font-weight:600;text-align:left}.note{color:var(--soft)}
.bad,tr.failed td,tr.worse td:last-child{color:var(--bad)}tr.better td:last-child{color:var(--good)}
.cards{display:flex;gap:12px;flex-wrap:wrap}ul{margin:4px 0;padding-left:20px}
.card{background:var(--paper);border:1px solid var(--line);border-radius:6px;padding:8px 14px;min-width:128px}
.card b{display:block;font-size:20px}
svg{background:#fff;border:1px solid #dde2ea;margin:4px 0;width:100%;height:auto}
@media (prefers-color-scheme:dark){
:root{--ink:#dde2ea;--page:#14171c;--paper:#1d2128;--line:#39404b;--section:#272d36;--soft:#9aa4b5;--bad:#ff8f8f;
--good:#6fd39c}
svg{filter:invert(.89) hue-rotate(180deg)}}
"""
CARDS = (
    ("track_accuracy", "of the time accurate (within 1 m)"),
    ("availability", "of the time with an output"),
    ("rmse_m", "3D RMSE of the outputs"),
    ("held_rmse_m", "3D RMSE, last output held"),
    ("first_accurate_s", "to the first accurate output"),
    ("false_outputs", "false outputs"),
    ("false_alarms_per_h", "false alarms per hour"),
    ("inside_95_share", "inside the 95 % ellipsoid"),
)


def write_report(
    path: Path,
    own: list[Evaluation],
    others: list[Evaluation],
    pairs: list[Pair],
    warnings: list[str],
    summaries: Sequence[Table],
) -> None:
    """Write the report of the runs, those that they are compared with, and tables over several runs."""
    parts = ["<h1>grd evaluate</h1>", *(f'<p class="bad">{escape(text)}</p>' for text in warnings)]
    everything = [*own, *others]
    shown = everything[:MAX_RUNS]
    rows = reliability(own)
    for index, e in enumerate(shown):
        parts.append(f"<h2>{escape(label(e) + ('' if index < len(own) else ' (compared with)'))}</h2>")
        parts.append(_summary_of(e))
        parts += run_figures(e)
    if not rows.empty:
        parts += ["<h2>Reliability</h2>", reliability_figure(rows)]
    parts.append("<h2>Tables</h2>")
    parts += [summary.html() for summary in summaries]
    if pairs:
        parts.append(comparison_table(pairs).html())
    if len(own) > 1:
        parts.append(headline_table(own, with_medians=True).html())
        parts.append(metrics_table("all metrics, medians over the runs", own, []).html())
    for e in shown:
        parts.append(metrics_table(f"all metrics, {label(e)}", [e], [e], detailed=True).html())
        parts.append(_list("How it was evaluated", e.remarks))
        missing = [f"{', '.join(names)}: {reason}" for reason, names in not_evaluated_names(e).items()]
        parts.append(_list("Not evaluated", missing))
    if len(everything) > MAX_RUNS:
        parts.append(f"<p>{len(everything) - MAX_RUNS} more runs are in the tables over several runs only.</p>")
    parts.append(_definitions(own[0]))
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>grd evaluate</title>'
    text = f"<!doctype html><html lang=en><head>{head}<style>{STYLE}</style></head><body>{''.join(parts)}</body></html>"
    path.write_text(text + "\n", encoding="utf-8")


def _definitions(e: Evaluation) -> str:
    near, sigmas = f"{e.limits.false_m:g} m", f"{e.limits.overconfident_sigmas:g}"
    sentences = (
        "T_vehicle_drone is compared with truth in the vehicle frame; nothing is aligned.",
        f"Truth is interpolated to the stamp of each output, not over gaps of more than {e.limits.max_gap_s:g} s.",
        f"An output is current for {e.limits.max_age_s:g} s; it is accurate when it is current and within {near} of "
        "the drone, and false when it is farther than that.",
        f"A false output is overconfident when it is more than {sigmas} of its own sigmas off, along the error.",
        "Held errors are of the last output, however old, every 20 ms from the first output on.",
        f"A search detects the drone when its best candidate is within {near} of the drone at any time of the search.",
        "In a median a run that failed counts as the worst.",
        "Latency is not evaluated: the files of a run hold measurement times only.",
    )
    return _list("Definitions", list(sentences))


def _summary_of(e: Evaluation) -> str:
    about = f"{e.run.name}, output {e.output.kind}, {len(e.output.poses)} poses, recording {e.run.recording}"
    cards = [(e.values[key], metric_of(key), text) for key, text in CARDS]
    shown = "".join(
        f'<div class="card"><b{" class=bad" if v.failed else ""}>{escape(_card(v, m))}</b>{escape(text)}</div>'
        for v, m, text in cards
        if v.value is not None or v.failed
    )
    return f'<p class="note">{escape(about)}</p><div class="cards">{shown}</div>' + _list("Findings", e.findings, "bad")


def _card(value: Value, metric: Metric) -> str:
    return "none" if value.value is None else f"{number(value.value, metric)} {metric.unit}".strip()


def _list(title: str, texts: list[str], css: str = "note") -> str:
    if not texts:
        return ""
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f'<h3>{escape(title)}</h3><ul class="{css}">{items}</ul>'


def as_json(evaluations: list[Evaluation], pairs: list[Pair], warnings: list[str]) -> dict[str, Any]:
    """Everything for programs. No NaN: a metric without a value has `null`, a status and a reason."""
    tree: dict[str, Any] = {
        "format": 2,
        "limits": asdict(evaluations[0].limits),
        "warnings": warnings,
        "runs": [_run_json(e) for e in evaluations],
    }
    keys = keys_of(evaluations)
    pooled = {name: _medians_json(medians(ranks(several, keys))) for name, several in pools(evaluations).items()}
    if len(pooled) > 1:
        tree["median_by_config"] = pooled
    elif len(evaluations) > 1:
        tree["median"] = next(iter(pooled.values()))
    if pairs:
        compared = compare(pairs)
        own, other = _medians_json(compared.own), _medians_json(compared.other)
        ratio = {key: value if np.isfinite(value) else None for key, value in compared.ratio.items()}
        tree["against"] = {
            "pairs": [
                {"recording": p.own.run.recording, "run": p.own.run.name, "other": p.other.run.name} for p in pairs
            ],
            "others": [_run_json(pair.other) for pair in pairs],
            "metrics": {key: {"run": own[key], "other": other[key], "ratio": ratio[key]} for key in own},
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


def _value_json(key: str, value: Value) -> dict[str, Any]:
    tree = {"value": value.value, "unit": metric_of(key).unit, "status": value.status.value}
    optional = {"samples": value.samples, "low": value.low, "high": value.high, "note": value.note or None}
    return tree | {name: content for name, content in optional.items() if content is not None}


def _medians_json(pooled: pd.DataFrame) -> dict[str, dict[str, Any]]:
    named = pooled.rename(columns={"failed": "runs_failed", "not_evaluated": "runs_not_evaluated"})
    named.insert(1, "failed", np.isinf(named["median"]))
    return {
        str(key): row | {"median": row["median"] if np.isfinite(row["median"]) else None}
        for key, row in zip(named.index, named.to_dict("records"), strict=True)
    }
