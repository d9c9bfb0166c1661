"""The evaluation of one output of one run: its values, the reasons for missing ones, findings and remarks.

Source: grd.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
import pandas as pd

from links.evaluation.association import EvaluationInput, EvaluationLimits
from links.evaluation.errors import GRID_NS, wilson_interval
from links.evaluation.run_data import RunData, RunTrajectory
from links.evaluation.text_files import Flags, Stamps
from stages.geometry.frames import Array64

SLOWEST_HZ = 4.0  # ArduPilot's EKF drops external poses that come slower
WITHOUT_DRONE = "there was no drone"
NO_SPAN = "neither the recording's time nor truth is known"
NO_OUTPUT = "no output at all"


class MetricStatus(Enum):
    """Whether a metric has a value, and why not."""

    MEASURED = "measured"
    FAILED = "failed"  # the run is to blame: in statistics over runs it counts as the worst value
    NOT_EVALUATED = "not evaluated"  # it could not be measured: statistics over runs leave it out
    NOT_APPLICABLE = "not applicable"  # there was nothing to measure: so do they here


@dataclass(frozen=True, slots=True)
class Value:
    """The value of a metric, or the reason why there is none."""

    value: float | None
    samples: int | None = None
    low: float | None = None  # 95 % confidence interval, or 95 % bounds of a consistent estimator
    high: float | None = None
    note: str = ""
    status: MetricStatus = MetricStatus.MEASURED

    def __post_init__(self) -> None:
        if self.value is not None and not math.isfinite(self.value):
            raise ValueError(f"a metric is a finite number or has a reason why it is missing, not {self.value}")

    @property
    def failed(self) -> bool:
        """The run is to blame for the missing value."""
        return self.status is MetricStatus.FAILED


def failed(reason: str) -> Value:
    """No value, and the run is to blame."""
    return Value(None, note=reason, status=MetricStatus.FAILED)


def not_evaluated(reason: str) -> Value:
    """No value, because it could not be measured."""
    return Value(None, note=reason, status=MetricStatus.NOT_EVALUATED)


def not_applicable(reason: str) -> Value:
    """No value, because there was nothing to measure."""
    return Value(None, note=reason, status=MetricStatus.NOT_APPLICABLE)


@dataclass
class Evaluation:
    """One output of one run against truth. `errors` and `held` are None without truth."""

    run: RunData
    output: RunTrajectory
    limits: EvaluationLimits
    span_ns: tuple[int, int] | None  # evaluated time
    values: dict[str, Value] = field(default_factory=dict)  # by metric, in the order of the catalogue
    findings: list[str] = field(default_factory=list)  # faults of the run
    remarks: list[str] = field(default_factory=list)  # how it was evaluated and what was left out
    errors: pd.DataFrame | None = None  # `errors.output_errors`
    held: pd.DataFrame | None = None  # `errors.held_errors`, while the drone is in reach
    out_of_reach_ns: Stamps = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # each GRID_NS
    rotation_errors: pd.DataFrame | None = None  # `errors.rotation_errors`
    counts: dict[str, tuple[int, int]] = field(default_factory=dict)  # of shares: how many, of how many
    seconds: dict[str, tuple[float, float]] = field(default_factory=dict)  # of shares of time: how long, of how long
    reacquisition_s: list[float] = field(default_factory=list)  # after each occlusion; inf: not reacquired

    @property
    def duration_s(self) -> float | None:
        """Length of the evaluated time."""
        return None if self.span_ns is None else max((self.span_ns[1] - self.span_ns[0]) / 1e9, 6e-11)

    def put(self, key: str, value: float, samples: int | None = None, note: str = "") -> None:
        """Store the value of a metric."""
        self.values[key] = Value(float(value), samples, note=note)

    def put_all(self, values: Mapping[str, float], samples: int) -> None:
        """Store the values of several metrics with the same samples."""
        self.values.update({key: Value(float(value), samples) for key, value in values.items()})

    def put_none(self, why: Value, *keys: str) -> None:
        """Store the reason for missing values."""
        self.values.update(dict.fromkeys(keys, why))

    def put_share(self, key: str, flags: Flags | pd.Series) -> None:
        """Store the share of True [%]."""
        self.put(key, 100 * float(flags.mean()), len(flags))

    def put_counted_share(self, key: str, count: int, of: int) -> None:
        """Store a share [%] with its 95 % confidence interval, and its counts for statistics over runs."""
        low, high = wilson_interval(count, of)
        self.counts[key] = (count, of)
        self.values[key] = Value(100 * count / of, of, 100 * low, 100 * high)

    def put_timed_share(self, key: str, chosen: Flags, of: Flags, length_s: Array64) -> None:
        """Store the share of the time of some searches [%], and its counts and seconds for statistics over runs."""
        chosen_s, all_s = float(length_s[chosen & of].sum()), float(length_s[of].sum())
        self.counts[key] = int((chosen & of).sum()), int(of.sum())
        self.seconds[key] = chosen_s, all_s
        self.put(key, 100 * chosen_s / all_s, int(of.sum()))

    def no_truth(self) -> Value:
        """Why there is no error at all: no drone, or no truth."""
        if self.run.no_drone:
            return not_applicable(WITHOUT_DRONE)
        return not_evaluated(self.run.why_missing(EvaluationInput.TRUTH) or "no truth")

    def no_error(self) -> Value:
        """Why no output has an error although there is truth."""
        if not len(self.output.poses):
            return failed(NO_OUTPUT)
        n, gap_s = len(self.output.poses), self.limits.max_gap_s
        return not_evaluated(f"none of the {n} outputs has truth within {gap_s:g} s on both sides")

    def too_few(self, needed: int, what: str) -> Value:
        """Why a statistic of the errors is missing.

        The run has failed when it had the time for `needed` outputs at SLOWEST_HZ: a run with next to no outputs stays
        in the medians over runs.
        """
        n, times = (0 if frame is None else len(frame) for frame in (self.errors, self.held))
        reason = f"too few outputs with truth: {n}, {what} needs {needed}"
        return failed(reason) if times * GRID_NS / 1e9 >= needed / SLOWEST_HZ else not_evaluated(reason)
