"""The rotation by both cameras of many runs in few rows; grouped as in groups.py.

Source: ours. Errors are over all rotations of a group as one series: a run that refuses most weighs less in them, and
the share that was accepted stands beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from links.evaluation.groups import Key, Spread, grouped, pooled, spread
from links.evaluation.judged import Evaluation, p95, rms
from links.evaluation.rotation_errors import Off
from links.evaluation.statistics import chi2_quantile
from stages.geometry.frames import Array64


@dataclass(frozen=True, slots=True)
class Sizes:
    """Errors of a group's rotations [deg]; None without any."""

    rmse: float | None
    median: float | None
    p95: float | None
    rmse_rpy: tuple[float | None, float | None, float | None]  # roll, pitch, yaw


@dataclass(frozen=True, slots=True)
class RotationGroup:
    """Runs of one configuration in which a rotation was asked for, summed up."""

    words: tuple[str, ...]
    config: str
    runs: int
    accepted: tuple[int, int]  # of how many pictures
    given: Sizes  # errors of the branch given
    modulo: Sizes  # of the nearest branch
    inside_95: tuple[int, int]
    nees_of_1: (
        float | None
    )  # mean NEES / 3; None: without rotations, or with a covariance that is not positive definite
    resolved: int
    wrong_resolved: int | None  # None: truth is not known
    resolved_s: Spread  # to the first RESOLVED of each run
    resolved_m: Spread
    resolved_ground_m: Spread
    switches: int


def rotation_groups(evaluations: Sequence[Evaluation], key: Key) -> list[RotationGroup]:
    """The groups in which some run told a rotation; runs that told none are in no group."""
    asked = [e for e in evaluations if e.values["rotation_pictures"].value is not None]
    return [_group(*group) for group in grouped(asked, key)] if asked else []


def _group(words: tuple[str, ...], config: str, evaluations: list[Evaluation]) -> RotationGroup:
    turned = [e.turned for e in evaluations if e.turned is not None]
    nees = np.concatenate([t.nees for t in turned]) if turned else np.zeros(0)
    inside = np.nan_to_num(nees, nan=np.inf) <= chi2_quantile(0.95, 3)  # a broken covariance holds nothing
    return RotationGroup(
        words=words,
        config=config,
        runs=len(evaluations),
        accepted=pooled((e.counts for e in evaluations), "rotation_accepted_share"),
        given=_sizes([t.given for t in turned]),
        modulo=_sizes([t.modulo for t in turned]),
        inside_95=(int(np.count_nonzero(inside)), len(inside)),
        nees_of_1=float(nees.mean()) / 3 if np.isfinite(nees).all() and len(nees) else None,
        resolved=_total(evaluations, "rotation_resolved") or 0,
        wrong_resolved=_total(evaluations, "rotation_wrong_resolved"),
        resolved_s=spread(evaluations, "rotation_resolved_s"),
        resolved_m=spread(evaluations, "rotation_resolved_m"),
        resolved_ground_m=spread(evaluations, "rotation_resolved_ground_m"),
        switches=_total(evaluations, "rotation_switches") or 0,
    )


def _sizes(several: list[Off]) -> Sizes:
    angle = np.degrees(np.concatenate([off.angle_rad for off in several])) if several else np.zeros(0)
    if not len(angle):
        return Sizes(None, None, None, (None, None, None))
    euler: Array64 = np.degrees(np.concatenate([off.euler_rad for off in several]))
    roll, pitch, yaw = (rms(axis) for axis in euler.T)
    return Sizes(rms(angle), float(np.median(angle)), p95(angle), (roll, pitch, yaw))


def _total(evaluations: list[Evaluation], key: str) -> int | None:
    values = [value for e in evaluations if (value := e.values[key].value) is not None]
    return round(sum(values)) if values else None
