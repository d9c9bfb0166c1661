"""Several runs together: medians in which a failure is the worst there is, and run against run on the same recording.

Source: DESIGN, evaluate; ours: pairs by recording, because two medians over different recordings compare recordings.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from flow.link import LinkError
from links.evaluation.catalogue import CATALOGUE, Better, metric_of
from links.evaluation.judged import Evaluation

COMMON = "3D RMSE in the time both have an output"
MAX_NAMED = 4  # recordings named in a warning


@dataclass(frozen=True, slots=True)
class Pooled:
    """The median of a metric over runs; +-inf when half of the runs or more failed it, None when none could tell."""

    median: float | None
    counted: int  # runs in the median, failures among them
    failed: int
    left_out: int  # runs in which it could not be evaluated


def keys_of(evaluations: list[Evaluation]) -> list[str]:
    """Every metric of any of them, in the catalogue's order, compute times last."""
    extra = dict.fromkeys(key for e in evaluations for key in e.values if key not in CATALOGUE)
    return [*CATALOGUE, *extra]


def pooled(evaluations: list[Evaluation], key: str) -> Pooled:
    """Median over runs."""
    better = metric_of(key).better
    values = [e.values[key] for e in evaluations if key in e.values]
    ranks = [rank for value in values if (rank := value.ranked(better)) is not None]
    failed = sum(value.failed for value in values)
    return Pooled(median(ranks), len(ranks), failed, len(evaluations) - len(ranks))


def by_config(evaluations: list[Evaluation]) -> dict[str, list[Evaluation]]:
    """Runs by what they were made with, in the order in which they were given."""
    found: dict[str, list[Evaluation]] = {}
    for e in evaluations:
        found.setdefault(e.run.config, []).append(e)
    return found


def alike(evaluations: list[Evaluation]) -> dict[str, list[Evaluation]]:
    """Runs whose numbers may be pooled: of one configuration, and of one output where runs have several."""
    found: dict[str, list[Evaluation]] = {}
    for e in evaluations:
        name = f"{e.run.config} {e.output.name}".strip() if len(e.run.outputs) > 1 else e.run.config
        found.setdefault(name, []).append(e)
    return found


def uneven(evaluations: list[Evaluation]) -> list[str]:
    """Warnings: recordings that some configurations were run on and others not, or that count twice."""
    configs = by_config(evaluations)
    counts = {name: Counter(_flight(e) for e in runs) for name, runs in configs.items()}
    warnings: list[str] = []
    every = sorted({recording for count in counts.values() for recording, *_ in count})
    for name, count in counts.items():
        run_on = {recording for recording, *_ in count}  # by any output: the paper's stages tell no pose
        missing = [recording for recording in every if recording not in run_on]
        twice = sorted({recording for (recording, *_), n in count.items() if n > 1})
        for flights, what in ((missing, "not run on"), (twice, "counted twice or more on")):
            if flights:
                names = ", ".join(flights[:MAX_NAMED])
                more = f" and {len(flights) - MAX_NAMED} more" if len(flights) > MAX_NAMED else ""
                warnings.append(f"{name or 'a configuration without a name'}: {what} {names}{more}")
    return warnings


def _flight(e: Evaluation) -> tuple[str, str, int]:
    return e.run.recording, e.output.name, e.run.drone


def median(ranks: list[float]) -> float | None:
    """Of an even number the mean of the middle two; the infinite one when one of them is."""
    if not ranks:
        return None
    ranks = sorted(ranks)
    low, high = ranks[(len(ranks) - 1) // 2], ranks[len(ranks) // 2]
    if math.isinf(low) or math.isinf(high):
        return low if math.isinf(low) else high
    return (low + high) / 2


@dataclass(frozen=True, slots=True)
class Pair:
    """Two evaluations of the same recording."""

    own: Evaluation
    other: Evaluation

    def common_rmse_m(self) -> tuple[float, float] | None:
        """Both 3D RMSE, last output held, over the moments at which both had one; None when there are none."""
        a, b = self.own.over, self.other.over
        if a is None or b is None:
            return None
        _, i, j = np.intersect1d(a.at_ns, b.at_ns, return_indices=True)
        both = a.fresh[i] & b.fresh[j]
        if not both.any():
            return None
        own, other = (float(np.sqrt(np.mean(np.square(m[both])))) for m in (a.held_m[i], b.held_m[j]))
        return own, other


def pair_up(own: list[Evaluation], others: list[Evaluation]) -> tuple[list[Pair], list[str]]:
    """Pairs by recording (and output, where both have it), and warnings. LinkError when nothing can be paired."""
    warnings: list[str] = []
    for side, name in ((own, "RUN"), (others, "--against")):
        twice = [key for key, count in Counter(_flight(e) for e in side).items() if count > 1]
        if twice:
            raise LinkError(
                f"{name}: two runs of recording '{twice[0][0]}'; runs are paired by recording, so give one of each "
                "(several configurations side by side: all as RUNS, with --by config)"
            )
    pairs = [Pair(a, b) for a in own for b in others if _key(a, b) == _key(b, a)]
    if not pairs and len({e.run.name for e in own}) == len({e.run.name for e in others}) == 1:
        pairs = [Pair(own[0], others[0])]
        names = [e.run.recording for e in (own[0], others[0])]
        if names[0] != names[1]:
            warnings.append(f"'{names[0]}' is compared with '{names[1]}', another recording: differences may be its")
    if not pairs:
        left, right = (", ".join(sorted({e.run.recording for e in side})) for side in (own, others))
        raise LinkError(f"no recording is in both: RUN has {left}; --against has {right}")
    paired = {e.run.recording for pair in pairs for e in (pair.own, pair.other)}
    alone = sorted({e.run.recording for e in (*own, *others)} - paired)
    if alone:
        warnings.append(f"on one side only, left out of the comparison: {', '.join(alone)}")
    warnings += [text for pair in pairs if (text := _same_flight(pair))]
    return pairs, warnings


def _key(evaluation: Evaluation, other: Evaluation) -> tuple[str, str, int]:
    """The outputs' names count only where both runs have both; a lone file stands for any output."""
    names = [{o.name for o in e.run.outputs} for e in (evaluation, other)]
    if names[0] & names[1]:
        return _flight(evaluation)
    first = evaluation.output.name == evaluation.run.outputs[0].name
    return evaluation.run.recording, "answer" if first else evaluation.output.name, evaluation.run.drone


def _same_flight(pair: Pair) -> str | None:
    a, b = pair.own, pair.other
    if a.run.truth is not None and b.run.truth is not None:
        same = len(a.run.truth) == len(b.run.truth) and np.allclose(a.run.truth.xyz_m, b.run.truth.xyz_m, atol=1e-3)
        if not same:
            return f"{a.run.name} and {b.run.name} have different truth: not the same flight, or not cut the same"
    if a.span_ns and b.span_ns and max(abs(x - y) for x, y in zip(a.span_ns, b.span_ns, strict=True)) > 5e8:
        return f"{a.run.name} and {b.run.name} are judged over different times"
    return None


@dataclass(frozen=True, slots=True)
class Compared:
    """One metric over all pairs."""

    own: Pooled
    other: Pooled
    ratio: float | None  # median of own / other over the pairs where both have a value
    ratio_pairs: int


def compared(pairs: list[Pair], key: str) -> Compared:
    """Medians of both sides over the pairs in which both could be judged, and the median ratio."""
    judged = [p for p in pairs if all(_ranked(e, key) is not None for e in (p.own, p.other))]
    ratios = [
        a / b
        for p in judged
        if (a := p.own.values[key].value) is not None and (b := p.other.values[key].value) is not None and b > 0
    ]
    own, other = (pooled(side, key) for side in ([p.own for p in judged], [p.other for p in judged]))
    return Compared(own, other, median(ratios), len(ratios))


def _ranked(evaluation: Evaluation, key: str) -> float | None:
    value = evaluation.values.get(key)
    return None if value is None else value.ranked(metric_of(key).better)


def verdict(own: float | None, other: float | None, better: Better) -> str:
    """`better`, `worse`, `same` or nothing, for a row of a comparison."""
    if own is None or other is None or better in ("none", "one"):
        return ""
    if own == other:
        return "same"
    return "better" if (own < other) == (better == "low") else "worse"
