"""The sweep: to and fro over the whole travel, beside which things are glanced at, and in pieces between looks.

Source: ours, for P III.A.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

ARRIVED_RAD = math.radians(0.6)
STUCK_NS = 300_000_000  # no nearer to the goal for so long: it will not arrive
AT_END_RAD = math.radians(2.0)
BACK_RAD = math.radians(1.0)  # where a search was left off


@dataclass(slots=True, eq=False)
class Sweeping:
    """Where the sweep is and where it goes."""

    low_rad: float
    high_rad: float
    goal_rad: float | None = None
    up: bool = True
    beside_rad: float | None = None  # how far it has come while glances are taken beside it
    left_off_rad: float | None = None  # where a search between looks at tracks ended
    _nearest_rad: float = math.inf
    _nearer_ns: int = 0

    def stop(self) -> None:
        """Something is looked at: the next sweep begins anew from there."""
        self.goal_rad = None

    def glance_from(self, position_rad: float, step_rad: float) -> float:
        """Where the sweep is by the next turn of the rotor; it goes on while something is glanced at beside it."""
        at = position_rad if self.beside_rad is None else self.beside_rad
        if not self.low_rad <= at + (step_rad if self.up else -step_rad) <= self.high_rad:
            self.up = not self.up
        self.beside_rad = min(max(at + (step_rad if self.up else -step_rad), self.low_rad), self.high_rad)
        return self.beside_rad

    def goal(
        self, stamp_ns: int, position_rad: float, radps: float, back_radps: float | None
    ) -> tuple[float, float] | None:
        """A new goal [rad] and speed [rad/s], None while the last one holds.

        With back_radps a search that was left off is taken up again where that was.
        """
        self.beside_rad = None
        if back_radps is not None and self.left_off_rad is not None:
            if abs(self.left_off_rad - position_rad) > BACK_RAD:
                if self.goal_rad == self.left_off_rad:
                    return None
                self.goal_rad = self.left_off_rad
                return self.left_off_rad, back_radps
            self.left_off_rad, self.goal_rad = None, None
        left = math.inf if self.goal_rad is None else abs(self.goal_rad - position_rad)
        if left < self._nearest_rad:
            self._nearest_rad, self._nearer_ns = left, stamp_ns
        arrived = left < ARRIVED_RAD or stamp_ns - self._nearer_ns > STUCK_NS
        if self.goal_rad is not None:
            if not arrived:
                return None
            self.up = not self.up
        if self.low_rad + AT_END_RAD > position_rad:
            self.up = True
        elif self.high_rad - AT_END_RAD < position_rad:
            self.up = False
        self.goal_rad = self.high_rad if self.up else self.low_rad
        self._nearest_rad, self._nearer_ns = math.inf, stamp_ns
        return self.goal_rad, radps
