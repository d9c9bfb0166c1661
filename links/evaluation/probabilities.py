"""How often it was a drone, of what the detector gave a probability to: does P mean what it says?

Each thing counts once in a row: at the first look at it after which its probability lay there; looks that miss it are
none. It was a drone when it was within `wrong_m` of one then. Runs of a configuration together; where truth has a gap
nothing counts.

Source: ours; after the reliability tables of weather forecasts, Murphy and Winkler, Applied Statistics 26 (1977).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from links.evaluation.associate import interpolate
from links.evaluation.compare import by_config
from links.evaluation.judged import Evaluation
from links.evaluation.run_data import RunData
from links.evaluation.said import Said
from links.evaluation.statistics import wilson_interval
from stages.geometry.frames import Array64

EDGES = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.95, 1.0)  # the detector accepts from .95 on


@dataclass(frozen=True, slots=True)
class Reliability:
    """What was said to be a drone with a probability from `low` to below `high`."""

    config: str
    low: float
    high: float
    things: int
    stated: float  # mean of the probabilities
    drones: int

    @property
    def share(self) -> float:
        """Of the things, those that were a drone."""
        return self.drones / self.things

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of that."""
        return wilson_interval(self.drones, self.things)


def reliabilities(evaluations: list[Evaluation]) -> list[Reliability]:
    """Rows by configuration, from improbable to sure; empty where no detector said a probability."""
    found: list[Reliability] = []
    for config, several in by_config(evaluations).items():
        runs = {e.run.name: e for e in several}.values()  # of several drones each is judged: the same things
        counted = [_counted(e.run, e.run.said, e.limits.wrong_m, round(1e9 * e.limits.max_gap_s)) for e in runs]
        bins, stated, drone = (np.concatenate([part[k] for part in counted]) for k in range(3))
        for k, (low, high) in enumerate(pairwise(EDGES)):
            here = bins == k
            if here.any():
                mean = float(stated[here].mean())
                found.append(Reliability(config, low, high, int(here.sum()), mean, int(drone[here].sum())))
    return found


def _counted(run: RunData, said: Said | None, near_m: float, gap_ns: int) -> tuple[Array64, Array64, Array64]:
    """Of all (thing, bin) that came about: the bin, the probability said first, and whether it was a drone."""
    if said is None or not len(said.stamps_ns) or (run.truth is None and not run.no_drone):
        return np.zeros(0), np.zeros(0), np.zeros(0)
    bins = np.clip(np.searchsorted(EDGES, said.probability, side="right") - 1, 0, len(EDGES) - 2)
    known, drone = np.ones(len(bins), dtype=np.bool_), np.zeros(len(bins), dtype=np.bool_)
    if not run.no_drone:
        for path in [drone.path for drone in run.drones if drone.path is not None]:
            told, xyz_m, _ = interpolate(said.stamps_ns, path.stamps_ns, path.xyz_m, None, gap_ns)
            known &= told
            drone |= told & (np.linalg.norm(said.xyz_m - xyz_m, axis=1) < near_m)
        known |= drone  # whatever is not known of another one
    bins, thing, stated, drone = bins[known], said.thing[known], said.probability[known], drone[known]
    first = np.unique(thing * len(EDGES) + bins, return_index=True)[1]
    return bins[first].astype(np.float64), stated[first], drone[first].astype(np.float64)
