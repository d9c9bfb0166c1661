"""Outcomes of flights as a table: one row per scenario over its seeds, and a CSV with one line per flight.

Source: ours.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from links.simulated.matrix.flight_runs import FlightResult

HEAD = (
    "scenario",
    "flown",
    "failsafe, crash",
    "wrong of sent",
    "95 % [m]: median, worst",
    "hover scatter [m]: median, worst",
    "yaw RMS [deg]: median, worst",
    "in 95 % ellipsoid [%]: position, yaw",
    "heading [s]: median, worst",
    "longest gap [s]: median, worst",
)
NONE = "-"
Outcome = dict[str, Any]


def markdown_table(results: Sequence[FlightResult]) -> str:
    """The table, one row per scenario in the order of the flights."""
    lines = [HEAD, ["---"] * len(HEAD)]
    for name in dict.fromkeys(result.scenario for result in results):
        lines.append(_row(name, [r for r in results if r.scenario == name]))
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def write_csv(file: Path, results: Sequence[FlightResult]) -> None:
    """One line per flight, with every field of its outcome."""
    flown = [r.outcome for r in results if r.outcome is not None]
    fields = [name for name in (flown[0] if flown else {}) if name not in ("made", "events", "text")]
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["scenario", "seed", *fields, "text"])
        for result in results:
            outcome = result.outcome or {}
            values = [outcome.get(name, "") for name in fields]
            writer.writerow([result.scenario, result.seed, *values, result.error or outcome.get("text", "")])


def _row(name: str, results: Sequence[FlightResult]) -> list[str]:
    outcomes = [r.outcome for r in results if r.outcome is not None]
    failed = len(results) - len(outcomes)
    crashed = sum(o["crashed"] for o in outcomes)
    lost = sum(o["lost_s"] is not None for o in outcomes)
    sent = sum(o["sent_poses"] for o in outcomes)
    return [
        name,
        f"{len(outcomes) - lost} of {len(outcomes)}" + (f" ({failed} not possible)" if failed else ""),
        f"{lost - crashed}, {crashed}" if lost else "0",
        f"{sum(o['wrong_poses'] for o in outcomes)} of {sent}",
        _median_worst(outcomes, "sent_95_m", ".2f"),
        _median_worst(outcomes, "hover_scatter_m", ".2f"),
        _median_worst(outcomes, "sent_yaw_rms_deg", ".1f"),
        f"{_share(outcomes, 'inside_share')}, {_share(outcomes, 'yaw_inside_share')}",
        _median_worst(outcomes, "heading_s", ".1f", never=math.inf),
        _median_worst(outcomes, "longest_gap_s", ".1f"),
    ]


def _median_worst(outcomes: Sequence[Outcome], name: str, form: str, never: float | None = None) -> str:
    """Median and worst over flights; without `never` flights that have no such value do not count."""
    given = [o[name] if o[name] is not None else never for o in outcomes]
    values = [value for value in given if value is not None]

    def show(value: float) -> str:
        return "never" if math.isinf(value) else format(value, form)

    return f"{show(float(np.median(values)))}, {show(max(values))}" if values else NONE


def _share(outcomes: Sequence[Outcome], name: str) -> str:
    """Share [%] over all poses."""
    weighted = [(o[name], o["sent_poses"]) for o in outcomes if o[name] is not None]
    total = sum(weight for _, weight in weighted)
    return f"{100 * sum(share * weight for share, weight in weighted) / total:.0f}" if total else NONE
