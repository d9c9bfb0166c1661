"""Tables I and II of the paper next to the runs of the experiments of the same names.

Runs of recordings named `experiment_J` or `experiment_J-...` count, with medians over the runs of each configuration.
As in the paper, the RMSE is over the outputs of a run: the share of the time in which it is accurate is in the table,
too, because a run without outputs has no error. The paper's flights are not published; those of grd are simulated, with
similar distance, speed and initial yaw. A fair comparison is with `paper.yaml` over the same flights.

Source: P VI, Tables I and II.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import pandas as pd

from links.evaluation.comparison import by_config, runs_table
from links.evaluation.errors import rms
from links.evaluation.evaluation import Evaluation
from links.evaluation.tables import NOTHING, Table

EXPERIMENT = re.compile(r"experiment_([1-4])(?:-.*)?")
PAPER_CONFIGS = "paper"  # prefix of configurations of the paper's method
POSITION = ["rmse_x_m", "rmse_y_m", "rmse_z_m", "rmse_m"]
ROTATION = ["rmse_roll_deg", "rmse_pitch_deg", "rmse_yaw_deg", "rmse_angle_deg"]
BY_CAMERAS = [f"rotation_published_rmse_{name}deg" for name in ("roll_", "pitch_", "yaw_", "")]
PUBLISHED_M = {1: (0.150, 0.151, 0.087), 2: (0.250, 0.310, 0.137), 3: (0.291, 0.412, 0.232), 4: (0.552, 0.448, 0.240)}
PUBLISHED_DEG = {1: (3.6, 1.6, 5.5), 2: (2.1, 1.8, 5.9), 3: (2.4, 2.1, 5.3), 4: (1.4, 3.0, 3.4)}
NOTE = (
    "Medians over runs; a run without outputs counts as infinite ('none'). RMSE over the outputs of a run. Track "
    "accuracy: share of the time with a current output within 1 m. Accurate outputs: RMSE of the outputs within 1 m "
    "alone, of runs that have any. Factor: RMSE of the paper's method over the same experiments divided by this one, "
    "both of the whole error; it is large where that method follows something else. Published: the paper's own flights."
)


def paper_tables(evaluations: Sequence[Evaluation]) -> list[Table]:
    """Table I (position) and II (rotation); empty without runs of the experiments."""
    found: dict[int, list[Evaluation]] = {}
    for e in evaluations:
        named = EXPERIMENT.fullmatch(e.run.recording)
        if named and e.output is e.run.outputs[0]:
            found.setdefault(int(named[1]), []).append(e)
    if not found:
        return []
    position_heads, rotation_heads = ["x", "y", "z", "3D", "accurate\noutputs"], ["roll", "pitch", "yaw", "angle"]
    experiments = sorted(found.items())
    position = [row for number, own in experiments for row in _rows(number, own, _position, PUBLISHED_M[number], 3)]
    rotation = [row for number, own in experiments for row in _rows(number, own, _rotation, PUBLISHED_DEG[number], 2)]
    return [
        _table("Table I: RMSE of the position in m", position_heads, position),
        _table("Table II: RMSE of the rotation in deg", rotation_heads, rotation),
    ]


def markdown(tables: Sequence[Table]) -> str:
    """The tables for a README."""
    return "\n\n".join([*(table.markdown() for table in tables), NOTE, ""])


def _position(runs: pd.DataFrame, own: list[Evaluation]) -> list[float]:
    """Medians of x, y, z and the whole error, and of the whole error of accurate outputs."""
    accurate = [e.errors.distance[~e.errors.false] for e in own if e.errors is not None]
    return [*runs[POSITION].median(), pd.Series([rms(m) for m in accurate if m.size], dtype=float).median()]


def _rotation(runs: pd.DataFrame, own: list[Evaluation]) -> list[float]:
    """Medians of roll, pitch, yaw and the angle: of the pose, or by both cameras when no pose has a rotation."""
    of_pose = runs[ROTATION].median()
    return list(runs[BY_CAMERAS].median() if of_pose.isna().all() else of_pose)


def _rows(number: int, own: list[Evaluation], medians, published: tuple[float, ...], decimals: int) -> list[list[str]]:
    """The published row and one row for each configuration."""
    tables = {config: (runs_table(runs), runs) for config, runs in by_config(own).items()}
    errors = {config: medians(*table) for config, table in tables.items()}
    whole = {config: values[3] for config, values in errors.items()}
    papers = [value for config, value in whole.items() if config.startswith(PAPER_CONFIGS) and not math.isnan(value)]
    width = len(next(iter(errors.values())))
    cells = [_text(value, decimals) for value in published]
    rows = [[str(number), "published", "1", NOTHING, *cells, *[NOTHING] * (width - len(cells) + 1)]]
    for config, values in errors.items():
        factor = math.nan
        if papers and math.isfinite(whole[config]) and whole[config] and not config.startswith(PAPER_CONFIGS):
            factor = min(papers) / whole[config]
        runs, _ = tables[config]
        accuracy = _text(runs.track_accuracy.median(), 0)
        cells = [_text(value, decimals) for value in values]
        rows.append([str(number), config or "run", str(len(runs)), accuracy, *cells, _text(factor, 1)])
    return rows


def _table(title: str, axes: list[str], rows: list[list[str]]) -> Table:
    heads = ["experiment", "method", "runs", "track\naccuracy [%]", *axes, "factor"]
    return Table(title, pd.DataFrame(rows, columns=pd.Index(heads)), 2, NOTE)


def _text(value: float, decimals: int) -> str:
    if math.isnan(value):
        return NOTHING
    return f"{value:.{decimals}f}" if math.isfinite(value) else "none"
