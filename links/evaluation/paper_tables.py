"""Tables I and II of the paper, with what a run of the same-named experiment gave beside them.

Runs of recordings named `experiment_J` or `experiment_J-...` are taken; of each configuration the medians over its runs
stand there. An RMSE is over a run's outputs, as the paper's is, so the share of the time in which it was right stands
beside it: a run that says nothing has no error. The paper's flights are not published; ours are simulated and like them
in distance, speed and initial yaw, so the published row is no ruler for ours: `paper.yaml` over the same flights is.

Source: P VI, Tables I and II; medians as in groups.py.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from links.evaluation.compare import by_config, median
from links.evaluation.groups import Spread, spread
from links.evaluation.judged import Evaluation, rms
from links.evaluation.summaries import Summary

EXPERIMENT = re.compile(r"experiment_([1-4])(?:-.*)?")
PAPERS = "paper"  # configurations of the paper's method begin so
POSITION = ("rmse_x_m", "rmse_y_m", "rmse_z_m", "rmse_m")
ROTATION = ("rmse_roll_deg", "rmse_pitch_deg", "rmse_yaw_deg", "rmse_angle_deg")
BY_CAMERAS = (
    "rotation_given_rmse_roll_deg",
    "rotation_given_rmse_pitch_deg",
    "rotation_given_rmse_yaw_deg",
    "rotation_given_rmse_deg",
)
PUBLISHED_M = {1: (0.150, 0.151, 0.087), 2: (0.250, 0.310, 0.137), 3: (0.291, 0.412, 0.232), 4: (0.552, 0.448, 0.240)}
PUBLISHED_DEG = {1: (3.6, 1.6, 5.5), 2: (2.1, 1.8, 5.9), 3: (2.4, 2.1, 5.3), 4: (1.4, 3.0, 3.4)}
NOTE = (
    "Medians over runs, of which one without any output counts as infinite ('none'); RMSE over a run's own outputs. "
    "right: share of the time with an output that is within 1 m. those right: RMSE of outputs within 1 m alone, of "
    "runs that have any. times: the paper's method's RMSE over the same experiments by this one, of the whole error: "
    "it is large where that method follows something else. published: the paper's own flights, which are others."
)


@dataclass(frozen=True, slots=True)
class Errors:
    """Of one configuration in one experiment: medians over its runs; None: not measured, inf: failed."""

    config: str
    runs: int
    right_share: float | None
    axes: tuple[float | None, ...]  # three, and of the whole
    of_right: float | None = None  # of the whole, outputs within 1 m alone


def paper_tables(evaluations: Sequence[Evaluation]) -> list[Summary]:
    """Table I (position) and II (rotation), of those that have any row; empty without such runs."""
    found: dict[int, list[Evaluation]] = {}
    for e in evaluations:
        named = EXPERIMENT.fullmatch(e.run.recording)
        if named and e.output is e.run.outputs[0]:
            found.setdefault(int(named[1]), []).append(e)
    if not found:
        return []
    position = {j: [_position(config, own) for config, own in by_config(es).items()] for j, es in found.items()}
    rotation = {j: [_rotation(config, own) for config, own in by_config(es).items()] for j, es in found.items()}
    return [
        _table("Table I: RMSE of the position in m", ("x", "y", "z", "3D", "those\nright"), position, PUBLISHED_M, 3),
        _table("Table II: RMSE of the rotation in deg", ("roll", "pitch", "yaw", "angle"), rotation, PUBLISHED_DEG, 2),
    ]


def markdown(tables: Sequence[Summary]) -> str:
    """Tables for a README."""
    parts: list[str] = []
    for table in tables:
        heads = [head.replace("\n", " ") for head in table.heads]
        lines = [heads, ["---"] * len(heads), *table.rows]
        parts.append("\n".join([f"{table.title}\n", *(f"| {' | '.join(cells)} |" for cells in lines)]))
    return "\n\n".join([*parts, NOTE, ""])


def _position(config: str, own: list[Evaluation]) -> Errors:
    """With the errors of the outputs that are right, which tell how good a method is while it follows the drone."""
    of_right: list[float] = []
    for e in own:
        if e.at is not None and (near := e.at.distance_m[e.at.distance_m <= e.limits.wrong_m]).size:
            of_right.append(rms(near))
    return replace(_errors(config, own, POSITION), of_right=median(of_right))


def _rotation(config: str, own: list[Evaluation]) -> Errors:
    """Of the pose given out; of a configuration that gives none, of what its cameras told."""
    errors = _errors(config, own, ROTATION)
    if all(axis is None for axis in errors.axes):
        return _errors(config, own, BY_CAMERAS)
    return errors


def _errors(config: str, own: list[Evaluation], keys: tuple[str, ...]) -> Errors:
    right = Spread(tuple(sorted(v for e in own if (v := e.values["right_share"].value) is not None)))
    axes = tuple(spread(own, key).median if any(key in e.values for e in own) else None for key in keys)
    return Errors(config, len(own), right.median, axes)


def _table(
    title: str,
    axes: tuple[str, ...],
    found: dict[int, list[Errors]],
    published: dict[int, tuple[float, float, float]],
    digits: int,
) -> Summary:
    rows: list[list[str]] = []
    for number in sorted(found):
        told = found[number]
        papers = [e.axes[-1] for e in told if e.config.startswith(PAPERS) and e.axes[-1] is not None]
        known = [_digits(v, digits) for v in published[number]]
        rows.append([str(number), "published", "1", "-", *known, *["-"] * (len(axes) - len(known) + 1)])
        for e in told:
            whole = e.axes[-1]
            times = "-"
            if papers and whole and not e.config.startswith(PAPERS):
                times = _digits(min(papers) / whole, 1) if math.isfinite(whole) else "-"
            cells = [_digits(v, digits) for v in (*e.axes, e.of_right)][: len(axes)]
            rows.append([str(number), e.config or "run", str(e.runs), _digits(e.right_share, 0), *cells, times])
    heads = ["experiment", "method", "runs", "right\n[%]", *axes, "times"]
    return Summary(title, heads, rows, 2, NOTE)


def _digits(value: float | None, digits: int) -> str:
    if value is None:
        return "-"
    return f"{value:.{digits}f}" if math.isfinite(value) else "none"
