"""The HTML report: one file that needs nothing from outside. Every name in it is escaped.

Source: ours.
"""

from __future__ import annotations

from html import escape
from pathlib import Path

from links.evaluation.catalogue import Metric, Value, metric_of
from links.evaluation.compare import COMMON, Pair, pooled
from links.evaluation.judged import Evaluation
from links.evaluation.plots import plots
from links.evaluation.summaries import Summary
from links.evaluation.tables import (
    HEADLINES,
    cell,
    common_rmse,
    comparison_rows,
    label,
    median_columns,
    number,
    pooled_cell,
    ratio_cell,
    rows_that_matter,
    titled,
    word,
)

MAX_PICTURED = 40  # runs with pictures: more would make a file that no browser likes
STYLE = """
body{font:14px/1.45 system-ui,sans-serif;color:#223;background:#f6f7f9;margin:0 auto;max-width:1020px;padding:24px}
h1{font-size:24px;margin:0 0 4px}h2{font-size:19px;margin:36px 0 6px;border-bottom:2px solid #223;padding-bottom:3px}
h3{font-size:15px;margin:18px 0 4px}table{border-collapse:collapse;background:#fff;margin:8px 0}
th,td{padding:3px 10px;border:1px solid #dde2ea;text-align:right;white-space:nowrap}
th:first-child,td:first-child{text-align:left}tr.group td{background:#eef1f6;font-weight:600}
.wide{overflow-x:auto}.bad{color:#b01818}.good{color:#1b7f4b}.soft{color:#667}.cards{display:flex;gap:12px;flex-wrap:wrap}
.card{background:#fff;border:1px solid #dde2ea;border-radius:6px;padding:8px 14px;min-width:128px}
.card b{display:block;font-size:20px}ul{margin:4px 0;padding-left:20px}
svg{background:#fff;border:1px solid #dde2ea;margin:4px 4px 4px 0}svg text{font:11px system-ui,sans-serif;fill:#223}
svg text.title{font-weight:600;font-size:13px}
"""
CARDS = (
    ("right_share", "of the time right (within 1 m)"),
    ("fresh_share", "of the time with an output"),
    ("rmse_m", "3D RMSE of the outputs"),
    ("held_rmse_m", "3D RMSE, last output held"),
    ("first_right_s", "to the first right output"),
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
    summaries: list[Summary],
) -> None:
    """Write the report."""
    parts = ["<h1>grd evaluate</h1>", _how(own[0])]
    parts += [f'<p class="bad">{escape(text)}</p>' for text in warnings]
    parts += [_summary(summary) for summary in summaries]
    if pairs:
        parts.append(_comparison(pairs))
    if len(own) > 1:
        parts.append(_headlines(own))
        parts.append(_metrics("All metrics, medians over the runs", own, columns=[]))
    shown = [*own, *others][:MAX_PICTURED]
    parts += [_run(e, "" if index < len(own) else " (the other)") for index, e in enumerate(shown)]
    if len(own) + len(others) > MAX_PICTURED:
        parts.append(f"<p>{len(own) + len(others) - MAX_PICTURED} more runs are in the tables above only.</p>")
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>grd evaluate</title>'
    text = f"<!doctype html><html lang=en><head>{head}<style>{STYLE}</style></head><body>{''.join(parts)}</body></html>"
    path.write_text(text + "\n", encoding="utf-8")


def _how(e: Evaluation) -> str:
    limits = e.limits
    return (
        '<p class="soft">T_vehicle_drone against truth, in the vehicle frame, nothing aligned. Truth is interpolated '
        f"to each output's stamp, not over gaps of more than {limits.max_gap_s:g} s. An output counts as present for "
        f"{limits.max_age_s:g} s; <i>right</i> is present and within {limits.wrong_m:g} m; <i>held</i> errors are "
        "taken every 20 ms from the first output on with the last one, however old. A <i>false</i> output is farther "
        f"than {limits.wrong_m:g} m, whatever sigma it states, and <i>sure</i> if that is more than "
        f"{limits.wrong_sigmas:g} of it along the error. A sweep found the drone when its best detection is within "
        f"{limits.wrong_m:g} m of where the drone was at any moment of the sweep. In a median a run that gave nothing "
        "counts as the worst. Latency is not judged: a run's files hold measurement times only.</p>"
    )


def _summary(summary: Summary) -> str:
    head = "".join(f"<th>{escape(text).replace(chr(10), '<br>')}</th>" for text in summary.heads)
    rows = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in summary.rows)
    table = f'<div class="wide"><table><tr>{head}</tr>{rows}</table></div>'
    return f'<h2>{escape(summary.title)}</h2>{table}<p class="soft">{escape(summary.note)}</p>'


def _comparison(pairs: list[Pair]) -> str:
    one = len(pairs) == 1
    names = [label(pairs[0].own), label(pairs[0].other)] if one else ["RUN", "OTHER"]
    title = f"{names[0]} against {names[1]}" if one else f"RUN against OTHER: medians of {len(pairs)} pairs"
    rows: list[str] = []
    group = ""
    for key, row in comparison_rows(pairs):
        metric = metric_of(key)
        group = _group(rows, metric, group, 5)
        verdict = word(row, metric)
        css = {"better": "good", "worse": "bad"}.get(verdict, "")
        cells = [pooled_cell(row.own, metric), pooled_cell(row.other, metric), ratio_cell(row)]
        told = "".join(f"<td>{escape(text)}</td>" for text in cells)
        rows.append(f'<tr><td>{escape(titled(metric))}</td>{told}<td class="{css}">{verdict}</td></tr>')
    common = common_rmse(pairs)
    if common is not None:
        a, b = common
        ratio = f"{a / b:.2g}" if b > 0 else "-"
        rows.append(f"<tr><td>{COMMON} [m]</td><td>{a:.3f}</td><td>{b:.3f}</td><td>{ratio}</td><td></td></tr>")
    head = "".join(f"<th>{escape(name)}</th>" for name in ("metric", *names, "ratio", ""))
    return f'<h2>{escape(title)}</h2><div class="wide"><table><tr>{head}</tr>{"".join(rows)}</table></div>'


def _headlines(own: list[Evaluation]) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in ("run", *HEADLINES.values()))
    rows: list[str] = []
    for e in own:
        values = [(e.values[key], metric_of(key)) for key in HEADLINES]
        cells = "".join(f"<td{_css(value)}>{escape(_short(value, metric))}</td>" for value, metric in values)
        rows.append(f"<tr><td>{escape(label(e))}</td>{cells}</tr>")
    for name, several in median_columns(own):
        medians = "".join(f"<td><b>{escape(_median(several, key))}</b></td>" for key in HEADLINES)
        rows.append(f"<tr><td><b>{escape(name)}</b></td>{medians}</tr>")
    return f'<h2>Runs</h2><div class="wide"><table><tr>{head}</tr>{"".join(rows)}</table></div>'


def _median(own: list[Evaluation], key: str) -> str:
    median = pooled(own, key).median
    return "-" if median is None else number(median, metric_of(key))


def _short(value: Value, metric: Metric) -> str:
    if value.value is None:
        return "none" if value.failed else "-"
    return number(value.value, metric)


def _css(value: Value) -> str:
    return ' class="bad"' if value.failed else ""


def _metrics(title: str, evaluations: list[Evaluation], columns: list[Evaluation]) -> str:
    medians = median_columns(evaluations)
    names = [*(label(e) for e in columns), *([name for name, _ in medians] or ["n"])]
    rows: list[str] = []
    group = ""
    for key in rows_that_matter(evaluations):
        metric = metric_of(key)
        group = _group(rows, metric, group, len(names) + 1)
        cells = "".join(
            f'<td{_css(e.values[key])} title="{escape(e.values[key].note)}">{escape(cell(e.values[key], metric))}</td>'
            for e in columns
        )
        cells += "".join(f"<td>{escape(pooled_cell(pooled(e, key), metric))}</td>" for _, e in medians)
        if not medians:
            samples = evaluations[0].values[key].samples
            cells += f'<td class="soft">{"" if samples is None else samples}</td>'
        rows.append(f"<tr><td>{escape(titled(metric))}</td>{cells}</tr>")
    head = "".join(f"<th>{escape(name)}</th>" for name in ("metric", *names))
    return f'<h3>{escape(title)}</h3><div class="wide"><table><tr>{head}</tr>{"".join(rows)}</table></div>'


def _group(rows: list[str], metric: Metric, group: str, width: int) -> str:
    if metric.group != group:
        rows.append(f'<tr class="group"><td colspan="{width}">{escape(metric.group)}</td></tr>')
    return metric.group


def _run(e: Evaluation, aside: str) -> str:
    parts = [f"<h2>{escape(label(e) + aside)}</h2>", f'<p class="soft">{escape(e.run.name)}, output {e.output.name}, '
             f"{len(e.output.poses)} poses, recording {escape(e.run.recording)}</p>"]  # fmt: skip
    cards = [(e.values[key], metric_of(key), text) for key, text in CARDS]
    told = "".join(
        f'<div class="card"><b{_css(v)}>{escape(_card(v, m))}</b>{escape(text)}</div>'
        for v, m, text in cards
        if v.value is not None or v.failed
    )
    parts.append(f'<div class="cards">{told}</div>')
    parts.append(_list("What is wrong", e.findings, "bad"))
    parts.append("".join(plots(e)))
    parts.append(_metrics("All metrics", [e], [e]))
    parts.append(_list("How it was judged", e.remarks, ""))
    missing = [f"{', '.join(names)}: {reason}" for reason, names in e.not_evaluated().items()]
    parts.append(_list("Not evaluated", missing, "soft"))
    return "".join(parts)


def _card(value: Value, metric: Metric) -> str:
    return "none" if value.value is None else f"{number(value.value, metric)} {metric.unit}".strip()


def _list(title: str, texts: list[str], css: str) -> str:
    if not texts:
        return ""
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f'<h3>{escape(title)}</h3><ul class="{css}">{items}</ul>'
