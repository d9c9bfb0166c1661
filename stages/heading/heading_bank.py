"""Yaw of the drone's odometry without vanishing points: hypotheses over the whole circle.

They are weighted by the same windows as the branches (hypothesis_bank.py). Where streets have many directions, the
heading by motion decides which of them both cameras see.

Source: ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.geometry.frames import Array64
from stages.heading.hypothesis_bank import BranchSettings, HypothesisBank

HEADING_STEP_DEG = 2.5
MAX_NONE = 0.01
WORST_HEADING_RAD = math.radians(4.0)  # one sigma: directions of streets differ by 14 deg or more


@dataclass(frozen=True)
class Heading:
    """Yaw that turns the odometry into `map`, on the whole circle."""

    turn_rad: float
    sigma_rad: float


class HeadingBank(HypothesisBank):
    """Hypotheses in steps of HEADING_STEP_DEG, at first all equally probable."""

    HYPOTHESES = round(360 / HEADING_STEP_DEG)

    def __init__(self, settings: BranchSettings) -> None:
        super().__init__(settings, self.HYPOTHESES)

    def _first(self, none: float) -> Array64:
        """Weights (h + 1,): all headings, then `none`."""
        return np.append(np.full(len(self._R), (1 - none) / len(self._R)), none)

    @property
    def heading(self) -> Heading | None:
        """Mean heading; None while the spread is too large, the windows are too few, or `none` is probable."""
        weight = self._weight[:-1]
        if self.windows < self.settings.least_windows or self._weight[-1] > MAX_NONE:
            return None
        mean = complex((weight * np.exp(1j * self._turns_rad)).sum() / weight.sum())
        sigma_rad = math.sqrt(-2.0 * math.log(min(abs(mean), 1.0))) if abs(mean) > 0.5 else math.inf
        sigma_rad = math.hypot(sigma_rad, math.radians(HEADING_STEP_DEG) / math.sqrt(12.0))
        return Heading(math.atan2(mean.imag, mean.real), sigma_rad) if sigma_rad < WORST_HEADING_RAD else None
