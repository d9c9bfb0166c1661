"""Message of a pair of images: the rotation on its most probable branch, or why there is none; jumps are reported.

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.align.dead_reckoning import DeadReckonedYaw, DeadReckoning
from stages.align.refine import Refined
from stages.geometry.frames import Array64
from stages.heading.hypothesis_bank import NONE, HypothesisBank
from stages.messages import BranchState, RelativeRotation

JUMP_RAD = math.radians(30.0)  # change of the published yaw that counts as a jump


class Publisher:
    """Makes one message for each pair of images."""

    def __init__(self, bank: HypothesisBank, dead_reckoning: DeadReckoning, resolve_probability: float) -> None:
        self._bank, self._dead_reckoning = bank, dead_reckoning
        self._resolve_probability = resolve_probability
        self._branch = 0  # published branch: 90 deg turns from the tracked yaw
        self._published_rad: float | None = None  # last published yaw less the dead reckoned one
        self._switches = 0
        self._news = ""

    def add_news(self, news: str) -> None:
        """Add a text to the reason of the next rotation."""
        self._news = news

    def rotation(
        self, vehicle_ns: int, drone_ns: int, refined: Refined, dead_reckoned: DeadReckonedYaw, off_rad: Array64
    ) -> RelativeRotation:
        """Message with the most probable branch; `off_rad` (3,): rejected tilt difference, added to the covariance."""
        before, self._branch = self._branch, self._bank.best(self._branch)
        yaw_offset_rad = refined.yaw_rad + self._branch * math.pi / 2 - dead_reckoned.yaw_rad
        if self._published_rad is not None:
            jump_rad = math.remainder(yaw_offset_rad - self._published_rad, 2 * math.pi)
            if abs(jump_rad) > JUMP_RAD:
                self._switches += 1
                why = "by motion" if before != self._branch else "by vanishing points"
                self._news = f"JUMP: {why} {math.degrees(jump_rad):+.0f} deg; {self._news}".rstrip("; ")
        self._published_rad = yaw_offset_rad
        resolved = self._bank.resolved(self._branch, self._resolve_probability)
        left, right, stamp_ns, variance_rad2 = self._dead_reckoning.at_common_time(vehicle_ns, drone_ns)
        covariance = right.T @ (refined.covariance_rad2(self._branch) + np.outer(off_rad, off_rad)) @ right
        lines = f"{refined.directions} directions, {refined.vehicle_lines} and {refined.drone_lines} lines"
        known = f"{self._bank.windows} windows of motion, none right: {self._bank.probability[NONE]:.1g}"
        news, self._news = self._news, ""
        return RelativeRotation(
            stamp_ns=stamp_ns,
            R_vehicle_drone=left @ refined.R_vehicle_drone(self._branch) @ right,
            covariance_rad2=covariance + variance_rad2 * np.eye(3),
            branch_probability=self._probability(),
            state=BranchState.RESOLVED if resolved else BranchState.AMBIGUOUS,
            switches=self._switches,
            reason="; ".join(part for part in (news, lines, known) if part),
        )

    def none(self, stamp_ns: int, reason: str) -> RelativeRotation:
        """A message without a rotation, with the reason."""
        return RelativeRotation(
            stamp_ns=stamp_ns,
            R_vehicle_drone=None,
            covariance_rad2=None,
            branch_probability=self._probability(),
            state=BranchState.NONE,
            switches=self._switches,
            reason=reason,
        )

    def _probability(self) -> Array64:
        """(4,) branch probabilities, the published branch first."""
        return np.roll(self._bank.probability[:4], -self._branch)
