"""Trajectory of a sweep over the servo's travel, continued across observations of candidates and tracks.

Source: ours, for P III.A.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

GOAL_TOLERANCE_RAD = math.radians(0.6)
STALL_NS = 300_000_000  # a servo that comes no nearer to its goal for this long counts as arrived
END_TOLERANCE_RAD = math.radians(2.0)  # from an end of the travel this near, the sweep starts away from it
RESUME_TOLERANCE_RAD = math.radians(1.0)
OUTSIDE_RAD = math.radians(2.0)  # from the limits: the servo first moves to the nearer one


@dataclass(slots=True, eq=False)
class SweepTrajectory:
    """Goals of a sweep between two servo positions."""

    low_rad: float
    high_rad: float
    goal_rad: float | None = None  # None: no sweep is under way
    increasing: bool = True  # direction of the servo position
    nominal_rad: float | None = None  # position of the sweep during observations that do not interrupt it
    resume_rad: float | None = None  # where the last search segment between observations of tracks ended
    passes: int = 0  # completed, from one end to the other
    _approaches: bool = False  # the goal is a limit, approached from outside of both
    _min_distance_rad: float = math.inf  # to the goal, since the goal was set
    _min_distance_ns: int = 0  # when that minimum last decreased

    def stop(self) -> None:
        """End the sweep. The next one starts from the servo position at that time."""
        self.goal_rad = None

    def limit(self, low_rad: float, high_rad: float) -> None:
        """Sweep between these positions from now on."""
        if (low_rad, high_rad) != (self.low_rad, self.high_rad):
            self.low_rad, self.high_rad = low_rad, high_rad
            self.stop()

    def advance(self, position_rad: float, step_rad: float) -> float:
        """Nominal position [rad] of the sweep one step later, reflected at the ends of the travel."""
        start_rad = position_rad if self.nominal_rad is None else self.nominal_rad
        if not self.low_rad <= start_rad + (step_rad if self.increasing else -step_rad) <= self.high_rad:
            self.increasing = not self.increasing
        nominal_rad = start_rad + (step_rad if self.increasing else -step_rad)
        self.nominal_rad = min(max(nominal_rad, self.low_rad), self.high_rad)
        return self.nominal_rad

    def goal(
        self,
        stamp_ns: int,
        position_rad: float,
        speed_radps: float,
        resume_radps: float | None,
        approach_radps: float | None = None,
    ) -> tuple[float, float] | None:
        """A new goal [rad] and speed [rad/s], or None while the last goal holds.

        With `resume_radps` the servo first returns to `resume_rad` at that speed. With `approach_radps` it first moves
        at that speed to the nearer limit, from outside of both. An approach that stalls counts as a pass and is
        repeated.
        """
        self.nominal_rad = None
        if resume_radps is not None and self.resume_rad is not None:
            if abs(self.resume_rad - position_rad) > RESUME_TOLERANCE_RAD:
                if self.goal_rad == self.resume_rad:
                    return None
                self.goal_rad = self.resume_rad
                return self.resume_rad, resume_radps
            self.resume_rad, self.goal_rad = None, None
        distance_rad = math.inf if self.goal_rad is None else abs(self.goal_rad - position_rad)
        if distance_rad < self._min_distance_rad:
            self._min_distance_rad, self._min_distance_ns = distance_rad, stamp_ns
        stalled = stamp_ns - self._min_distance_ns > STALL_NS
        near_rad = OUTSIDE_RAD if self._approaches else GOAL_TOLERANCE_RAD
        if self.goal_rad is not None:
            if distance_rad >= near_rad and not stalled:
                return None
            if not self._approaches:
                self.increasing = not self.increasing
            if not self._approaches or distance_rad >= near_rad:
                self.passes += 1
        nearest_rad = min(max(position_rad, self.low_rad), self.high_rad)
        self._approaches = approach_radps is not None and abs(position_rad - nearest_rad) > OUTSIDE_RAD
        self._min_distance_rad, self._min_distance_ns = math.inf, stamp_ns
        if approach_radps is not None and self._approaches:
            self.goal_rad = nearest_rad
            return nearest_rad, approach_radps
        if self.low_rad + END_TOLERANCE_RAD > position_rad:
            self.increasing = True
        elif self.high_rad - END_TOLERANCE_RAD < position_rad:
            self.increasing = False
        self.goal_rad = self.high_rad if self.increasing else self.low_rad
        return self.goal_rad, speed_radps
