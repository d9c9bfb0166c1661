"""Several runs together: the table of all runs, medians over them, and pairs of runs of one recording.

Source: DESIGN, evaluate. Runs are compared by recording: medians over different recordings compare the recordings.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import pandas as pd

from flow.link import LinkError
from links.evaluation.errors import rms
from links.evaluation.evaluation import Evaluation
from links.evaluation.metrics import CATALOGUE, Better, metric_of, rank

MAX_NAMED = 4  # names in a warning
OBJECT = "evaluation"  # column of `runs_table` with the Evaluation itself
TIMED_SHARES = ("detection_rate", "observable_detection_rate", "return_share", "observable_share")
COUNTED_SHARES = (*TIMED_SHARES, "inside_95_share", "rotation_accepted_share", "rotation_inside_95_share")


def keys_of(evaluations: list[Evaluation]) -> list[str]:
    """Every metric of any evaluation, in the order of the catalogue, compute times last."""
    return [*CATALOGUE, *dict.fromkeys(key for e in evaluations for key in e.values if key not in CATALOGUE)]


def runs_table(evaluations: list[Evaluation]) -> pd.DataFrame:
    """One row for each evaluation with all metrics; a failure is the worst value (inf or -inf), other gaps are NaN.

    A share that can be pooled over runs has its counts in `KEY_count` and `KEY_of`, one of time also its seconds in
    `KEY_s` and `KEY_of_s`: the counts are of searches, which differ in length.
    """
    keys = keys_of(evaluations)
    rows: list[dict[str, object]] = []
    for e in evaluations:
        row: dict[str, object] = {"recording": e.run.recording, "config": e.run.config, "output": e.output.kind.value}
        row |= {"drone": e.run.drone, "run": e.run.name, "no_drone": int(e.run.no_drone)}
        row["span_s"] = math.nan if e.span_ns is None else (e.span_ns[1] - e.span_ns[0]) / 1e9
        row["outputs"] = len(e.output.poses)
        row |= {key: rank(e.values.get(key), metric_of(key).better) for key in keys}
        for key in COUNTED_SHARES:
            row[f"{key}_count"], row[f"{key}_of"] = e.counts.get(key, (None, None))
        for key in TIMED_SHARES:
            row[f"{key}_s"], row[f"{key}_of_s"] = e.seconds.get(key, (math.nan, math.nan))
        rows.append(row | {OBJECT: e})
    return pd.DataFrame(rows).astype({f"{key}_{what}": "Int64" for key in COUNTED_SHARES for what in ("count", "of")})


@dataclass(frozen=True, slots=True)
class Pooled:
    """Median of a metric over runs."""

    median: float  # +-inf when half of the runs or more failed, NaN when no run has a value
    runs: int  # in the median, failures among them
    failed: int
    not_evaluated: int


def pooled(ranks: pd.Series) -> Pooled:
    """Median of a column of `runs_table`."""
    return Pooled(float(ranks.median()), int(ranks.count()), int(np.isinf(ranks).sum()), int(ranks.isna().sum()))


def by_config(evaluations: list[Evaluation]) -> dict[str, list[Evaluation]]:
    """Evaluations by configuration, in the order in which they were given."""
    return _by(evaluations, lambda e: e.run.config)


def pools(evaluations: list[Evaluation]) -> dict[str, list[Evaluation]]:
    """Evaluations that may be pooled: of one configuration, and of one output where runs have several."""
    return _by(evaluations, lambda e: f"{e.run.config} {e.output.kind if len(e.run.outputs) > 1 else ''}".strip())


def _by(evaluations: list[Evaluation], name: Callable[[Evaluation], str]) -> dict[str, list[Evaluation]]:
    found: dict[str, list[Evaluation]] = {}
    for e in evaluations:
        found.setdefault(name(e), []).append(e)
    return found


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


def some_of(names: list[str]) -> str:
    """`a, b, c, d and 3 more`."""
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return ", ".join(names[:MAX_NAMED]) + more


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
class Compared:
    """A metric over the pairs in which both sides have a value or failed."""

    own: Pooled
    other: Pooled
    ratio: float | None  # median of own / other over the pairs in which both have a value


def compare(pairs: list[Pair]) -> dict[str, Compared]:
    """Every metric that some pair has on both sides."""
    keys = keys_of([e for pair in pairs for e in (pair.own, pair.other)])
    own, other = runs_table([pair.own for pair in pairs]), runs_table([pair.other for pair in pairs])
    found: dict[str, Compared] = {}
    for key in (key for key in keys if key in own and key in other):
        a, b = own.loc[:, key], other.loc[:, key]
        both, measured = a.notna() & b.notna(), np.isfinite(a) & np.isfinite(b) & (b > 0)
        if both.any():
            ratio = float((a / b).loc[measured].median()) if measured.any() else None
            found[key] = Compared(pooled(a.loc[both]), pooled(b.loc[both]), ratio)
    return found


def common_rmse_m(pairs: list[Pair]) -> tuple[float, float] | None:
    """Medians over the pairs of both errors in the time in which both have an output; None without such a time."""
    both = [errors for pair in pairs if (errors := pair.common_rmse_m()) is not None]
    if not both:
        return None
    own, other = (sorted(side)[len(both) // 2] for side in zip(*both, strict=True))
    return own, other
