"""One output of one run as it is judged, and why a number may be missing.

Source: ours. A number that a run failed to earn is a failure, one that nobody could measure is not.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from links.evaluation.catalogue import CATALOGUE, Value, failure, not_applicable, not_evaluated
from links.evaluation.errors import GRID_NS, AtOutputs, Limits, OverTime
from links.evaluation.output import Output
from links.evaluation.rotation_errors import RotationErrors
from links.evaluation.run_data import RunData
from links.evaluation.statistics import wilson_interval
from stages.geometry.frames import Array64

SLOWEST_HZ = 4.0  # ArduPilot's EKF drops external poses that come slower
NO_DRONE = "there was no drone"
NO_SPAN = "neither the recording's time nor truth is known"


@dataclass
class Evaluation:
    """One output of one run, judged."""

    run: RunData
    output: Output
    limits: Limits
    span_ns: tuple[int, int] | None
    values: dict[str, Value] = field(default_factory=dict)  # by metric key, in the catalogue's order
    findings: list[str] = field(default_factory=list)  # faults of the run
    remarks: list[str] = field(default_factory=list)  # how it was judged, and what was left out
    at: AtOutputs | None = None
    over: OverTime | None = None
    counts: dict[str, tuple[int, int]] = field(default_factory=dict)  # of some shares: (how many, of how many)
    seconds: dict[str, tuple[float, float]] = field(default_factory=dict)  # of others: (for how long, of how long)
    turned: RotationErrors | None = None  # of both cameras' rotations
    reappeared_s: list[float] = field(default_factory=list)  # time to find it again, each time; inf: never

    def cannot(self, reason: str, *keys: str) -> None:
        """These could not be evaluated, and why."""
        self.values.update((key, not_evaluated(reason)) for key in keys)

    def does_not_apply(self, reason: str, *keys: str) -> None:
        """There was nothing to measure."""
        self.values.update((key, not_applicable(reason)) for key in keys)

    def not_evaluated(self) -> dict[str, list[str]]:
        """Reason -> names of the metrics that have no value for it; failures of the run are not among them."""
        reasons: dict[str, list[str]] = {}
        for key, value in self.values.items():
            if value.value is None and value.applies and not value.failed:
                reasons.setdefault(value.note, []).append(CATALOGUE[key].name if key in CATALOGUE else key)
        return reasons


def counted_share(judged: Evaluation, key: str, count: int, of: int) -> None:
    """A share with its 95 % interval, kept as counts too so that runs can be pooled."""
    low, high = wilson_interval(count, of)
    judged.counts[key] = (count, of)
    judged.values[key] = Value(100 * count / of, of, 100 * low, 100 * high)


def timed_share(
    judged: Evaluation, key: str, chosen: NDArray[np.bool_], of: NDArray[np.bool_], length_s: Array64
) -> None:
    """The share of the time of some searches, kept as seconds too so that runs can be pooled; and as counts."""
    some_s, all_s = float(length_s[chosen & of].sum()), float(length_s[of].sum())
    judged.counts[key] = int((chosen & of).sum()), int(of.sum())
    judged.seconds[key] = some_s, all_s
    judged.values[key] = Value(100 * some_s / all_s, int(of.sum()))


def no_truth(judged: Evaluation, *keys: str) -> None:
    """Truth is missing: nothing applies when there was no drone, else it could not be evaluated."""
    if judged.run.no_drone:
        judged.does_not_apply(NO_DRONE, *keys)
    else:
        judged.cannot(judged.run.missing.get("truth", "no truth"), *keys)


def too_few(judged: Evaluation, needed: int, what: str) -> Value:
    """Why a statistic has no value: the run's failure when it had time for `needed` outputs at 4 Hz, else nobody's.

    A run that says next to nothing may not drop out of the medians that it would spoil.
    """
    n = 0 if judged.at is None else len(judged.at.index)
    asked_s = 0.0 if judged.over is None else len(judged.over.at_ns) * GRID_NS / 1e9
    text = f"too few outputs with truth: {n}, {what} needs {needed}"
    return failure(text) if asked_s >= needed / SLOWEST_HZ else not_evaluated(text)


def no_error(judged: Evaluation, at: AtOutputs) -> Value:
    """Why there is no error at all."""
    if len(judged.output.poses):
        return not_evaluated(
            f"none of the {at.unknown} outputs has truth within {judged.limits.max_gap_s:g} s on both sides"
        )
    return failure("no output at all")


def share(flags: NDArray[np.bool_]) -> Value:
    """Percent of True."""
    return Value(100 * float(flags.mean()), len(flags))


def rms(values: Array64) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def p95(values: Array64) -> float:
    """95 % point."""
    return float(np.percentile(values, 95))


def minutes(span_ns: tuple[int, int]) -> float:
    """Length of a span [min]."""
    return max((span_ns[1] - span_ns[0]) / 60e9, 1e-12)
