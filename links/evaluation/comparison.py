"""Runs against other runs of the same recording, and against the published tables of the paper.

Runs are paired by recording: medians over different recordings would compare the recordings.

The paper's Tables I and II are next to runs of recordings named `experiment_J` or `experiment_J-...`, with medians over
the runs of each configuration. As in the paper, the RMSE is over the outputs of a run: the track accuracy is in the
table, too, because a run without outputs has no error. The paper's flights are not published; those of grd are
simulated, with similar distance, speed and initial yaw. A fair comparison is with `paper.yaml` over the same flights.

Source: DESIGN, evaluate; P VI, Tables I and II.
"""

from __future__ import annotations

import math
import re
import statistics
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import pandas as pd

from flow.link import LinkError
from links.evaluation.errors import rms
from links.evaluation.evaluation import Evaluation
from links.evaluation.metrics import Better, metric_of
from links.evaluation.tables import (
    NOTHING,
    Table,
    by_config,
    in_terminal,
    keys_of,
    label,
    median_cell,
    medians,
    ranks,
    runs_table,
    some_of,
    text_frame,
)

COMMON = "3D RMSE in the time in which both have an output"
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


def uneven_warnings(evaluations: list[Evaluation]) -> list[str]:
    """Warnings of recordings that a configuration was not run on or that it counts twice."""
    warnings: list[str] = []
    every = {e.run.recording for e in evaluations}
    for name, runs in by_config(evaluations).items():
        counts = Counter(_flight(e) for e in runs)
        missing = sorted(every - {e.run.recording for e in runs})
        repeated = sorted({recording for (recording, *_), n in counts.items() if n > 1})
        for recordings, what in ((missing, "not run on"), (repeated, "counted twice or more on")):
            if recordings:
                warnings.append(f"{name or 'a configuration without a name'}: {what} {some_of(recordings)}")
    return warnings


def _flight(e: Evaluation) -> tuple[str, str, int]:
    return e.run.recording, e.output.kind.value, e.run.drone


@dataclass(frozen=True, slots=True)
class Pair:
    """Two evaluations of the same recording."""

    own: Evaluation
    other: Evaluation

    def common_rmse_m(self) -> tuple[float, float] | None:
        """3D RMSE of both, last output held, over the time in which both have an output; None without such a time."""
        if self.own.held is None or self.other.held is None:
            return None
        own, other = (held[held.current] for held in (self.own.held, self.other.held))
        both = own.merge(other, on="stamp_ns")
        return (rms(both.distance_x), rms(both.distance_y)) if len(both) else None


def pair_up(own: list[Evaluation], others: list[Evaluation]) -> tuple[list[Pair], list[str]]:
    """Pairs by recording (and output, where both have it), and warnings. LinkError when nothing can be paired."""
    for side, name in ((own, "RUN"), (others, "--against")):
        repeated = [key for key, count in Counter(map(_flight, side)).items() if count > 1]
        if repeated:
            raise LinkError(
                f"{name}: two runs of recording '{repeated[0][0]}'; runs are paired by recording, so give one of each "
                "(several configurations side by side: all as RUNS, with --by config)"
            )
    warnings: list[str] = []
    recordings = [sorted({e.run.recording for e in side}) for side in (own, others)]
    pairs = [Pair(a, b) for a in own for b in others if _pair_key(a, b) == _pair_key(b, a)]
    if not pairs and len({e.run.name for e in own}) == len({e.run.name for e in others}) == 1:
        pairs = [Pair(own[0], others[0])]
        names = own[0].run.recording, others[0].run.recording
        if names[0] != names[1]:
            warnings.append(
                f"'{names[0]}' is compared with '{names[1]}', another recording: differences may be due to that"
            )
    if not pairs:
        left, right = map(", ".join, recordings)
        raise LinkError(f"no recording is in both: RUN has {left}; --against has {right}")
    paired = {e.run.recording for pair in pairs for e in (pair.own, pair.other)}
    if alone := sorted({*recordings[0], *recordings[1]} - paired):
        warnings.append(f"on one side only, left out of the comparison: {', '.join(alone)}")
    return pairs, [*warnings, *(text for pair in pairs for text in _flight_warnings(pair))]


def _pair_key(e: Evaluation, other: Evaluation) -> tuple[str, str, int]:
    """Outputs are distinguished only where both runs have an output of one kind; a TUM file pairs with any output."""
    kinds = [{output.kind for output in x.run.outputs} for x in (e, other)]
    if kinds[0] & kinds[1] or e.output.kind is not e.run.outputs[0].kind:
        return _flight(e)
    return e.run.recording, "primary", e.run.drone


def _flight_warnings(pair: Pair) -> Iterator[str]:
    a, b, names = pair.own, pair.other, f"{pair.own.run.name} and {pair.other.run.name}"
    if a.run.truth is not None and b.run.truth is not None:
        same = len(a.run.truth) == len(b.run.truth) and np.allclose(a.run.truth.xyz_m, b.run.truth.xyz_m, atol=1e-3)
        if not same:
            yield f"{names} have different truth: not the same flight, or not cut the same"
            return
    if a.span_ns and b.span_ns and max(abs(x - y) for x, y in zip(a.span_ns, b.span_ns, strict=True)) > 5e8:
        yield f"{names} are evaluated over different times"


class Verdict(StrEnum):
    """Result of a comparison, of the own side."""

    BETTER = "better"
    WORSE = "worse"
    SAME = "same"
    NONE = ""


def verdict(own: float, other: float, better: Better) -> Verdict:
    """Result of comparing two values of a metric."""
    if better is Better.NEITHER:
        return Verdict.NONE
    if own == other:
        return Verdict.SAME
    return Verdict.BETTER if (own < other) == (better is Better.LOW) else Verdict.WORSE


@dataclass(frozen=True, slots=True)
class Comparison:
    """Metrics over the pairs in which both sides have a value or failed; one row for each metric with such pairs."""

    own: pd.DataFrame  # `medians`
    other: pd.DataFrame
    ratio: pd.Series  # median of own / other over the pairs in which both have a value; NaN without such a pair


def compare(pairs: list[Pair]) -> Comparison:
    """Compare all metrics."""
    keys = keys_of([e for pair in pairs for e in (pair.own, pair.other)])
    a, b = ranks([pair.own for pair in pairs], keys), ranks([pair.other for pair in pairs], keys)
    both = a.notna() & b.notna()
    ratio = (a / b).where(np.isfinite(a) & np.isfinite(b) & (b > 0)).median()
    own, other = (medians(side.where(both)).assign(not_evaluated=0).loc[both.any()] for side in (a, b))
    return Comparison(own, other, ratio.loc[both.any()])


def common_rmse_m(pairs: list[Pair]) -> tuple[float, float] | None:
    """Medians over the pairs of both errors in the time in which both have an output; None without such a time."""
    both = [errors for pair in pairs if (errors := pair.common_rmse_m()) is not None]
    if not both:
        return None
    own, other = (statistics.median(side) for side in zip(*both, strict=True))
    return own, other


def comparison_table(pairs: list[Pair]) -> Table:
    """RUN next to OTHER: medians over the pairs, the median ratio, and which side is better."""
    one = len(pairs) == 1
    names = [label(pairs[0].own), label(pairs[0].other)] if one else ["RUN", "OTHER"]
    title = "against the other run" if one else f"against the other runs, medians of {len(pairs)} pairs"
    compared = compare(pairs)
    rows: list[list[str]] = []
    sections: list[str] = []
    for key in filter(in_terminal, map(str, compared.ratio.index)):
        metric, own, other = metric_of(key), compared.own.loc[key], compared.other.loc[key]
        result = verdict(own["median"], other["median"], metric.better)
        rows.append(
            [
                metric.title,
                median_cell(own, metric),
                median_cell(other, metric),
                _ratio(compared.ratio.loc[key]),
                result,
            ]
        )
        sections.append(metric.group)
    common = common_rmse_m(pairs)
    if common is not None:
        a, b = common
        rows.append(
            [f"{COMMON} [m]", f"{a:.3f}", f"{b:.3f}", _ratio(a / b if b else math.nan), verdict(a, b, Better.LOW)]
        )
        sections.append("common time")
    frame = text_frame(rows, ["metric", *names, "ratio", ""])
    return Table(title, frame, sections=sections, classes=[row[-1] for row in rows])


def _ratio(ratio: float) -> str:
    return NOTHING if math.isnan(ratio) else f"{ratio:.2g}"


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
