"""Recent IMU intervals of the drone, and the motion between two times: measured, or a gap.

Source: ours.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from typing import NamedTuple

import numpy as np

from stages.geometry.frames import Array64
from stages.heading.inertial_state import ImuIntervals, InertialState, predict, predict_free
from stages.messages import DroneMotion, VisualMotion
from stages.odometry.drone.visual_trajectory import VisualTrajectory

KEPT = 1024  # intervals: 20 s at 50 Hz
HELD_NS = 150_000_000  # longest extrapolation with the newest interval's values
HELD_NOISE = (
    np.full(3, 0.3),
    np.full(3, 0.05),
)  # its noise densities: specific force [m/s^2 / sqrt(Hz)], rate [rad/s / sqrt(Hz)]
TURN_CHANGE_RADPS = 0.35  # one sigma, of the turn rate after the newest image, without an IMU
CURRENT_NS = 1_000_000_000  # age of the newest interval up to which the IMU is in use


class Gap(NamedTuple):
    """A time span without IMU data."""

    from_ns: int
    to_ns: int


class ImuBuffer:
    """IMU intervals in order of time; turns measured by images bridge the gaps."""

    def __init__(self) -> None:
        self._intervals: deque[DroneMotion] = deque(maxlen=KEPT)
        self._images = VisualTrajectory()

    @property
    def newest_ns(self) -> int | None:
        """End of the newest interval; None: no IMU so far."""
        return self._intervals[-1].stamp_ns if self._intervals else None

    @property
    def newest_image_ns(self) -> int | None:
        """Time of the newest image of the drone; None: none so far."""
        return self._images.newest_ns

    def is_current(self, now_ns: int) -> bool:
        """Whether intervals keep arriving."""
        return bool(self._intervals) and now_ns - self._intervals[-1].stamp_ns < CURRENT_NS

    def covers(self, stamp_ns: int) -> bool:
        """Whether the motion since a time is measured from its start."""
        return bool(self._intervals) and self._intervals[0].start_ns <= stamp_ns

    def clear(self) -> None:
        """Drop the intervals; the turns by images stay."""
        self._intervals.clear()

    def add(self, motion: DroneMotion) -> bool:
        """Add an interval. False: it is not later than the newest one."""
        newest_ns = self.newest_ns
        if motion.stamp_ns <= motion.start_ns or (newest_ns is not None and motion.stamp_ns <= newest_ns):
            return False
        self._intervals.append(motion)
        return True

    def add_visual_motion(self, motion: VisualMotion) -> None:
        """Add a turn by images."""
        self._images.add(motion)

    def between(self, from_ns: int, to_ns: int) -> list[ImuIntervals | Gap]:
        """The intervals from one time to a later one, cut at both."""
        out: list[ImuIntervals | Gap] = []
        rows: list[tuple[float, Array64, Array64, Array64, Array64]] = []
        at_ns = from_ns
        intervals = self._intervals
        first = bisect_right(intervals, from_ns, key=lambda m: m.stamp_ns)
        for i in range(first, len(intervals)):
            m = intervals[i]
            if m.start_ns >= to_ns:
                break
            if m.start_ns > at_ns + 1_000:  # rounding of the stamps
                _close(out, rows)
                out.append(Gap(at_ns, m.start_ns))
                at_ns = m.start_ns
            end_ns = min(m.stamp_ns, to_ns)
            rows.append(_row(m, end_ns - at_ns, m.specific_force_noise, m.angular_velocity_noise))
            at_ns = end_ns
        newest_ns = self.newest_ns
        if at_ns < to_ns and newest_ns is not None and newest_ns <= at_ns < newest_ns + HELD_NS:
            held_ns = min(newest_ns + HELD_NS, to_ns)
            rows.append(_row(intervals[-1], held_ns - at_ns, *HELD_NOISE))
            at_ns = held_ns
        _close(out, rows)
        if at_ns < to_ns:
            out.append(Gap(at_ns, to_ns))
        return out

    def propagate(self, state: InertialState, weight: Array64, from_ns: int, to_ns: int) -> InertialState:
        """The state at a later time; `weight` (n,) of the hypotheses."""
        for piece in self.between(from_ns, to_ns):
            state = self._bridged(state, piece) if isinstance(piece, Gap) else predict(state, piece, weight)
        return state

    def _bridged(self, state: InertialState, gap: Gap) -> InertialState:
        turn, image_ns = self._images.between(gap.from_ns, gap.to_ns), self._images.newest_ns
        seconds = (gap.to_ns - gap.from_ns) * 1e-9
        if turn is None:
            return predict_free(state, seconds, np.eye(3), None)
        variance = turn.variance_rad2
        if image_ns is not None and gap.to_ns > image_ns:  # the newest turn is continued
            variance = ((gap.to_ns - max(gap.from_ns, image_ns)) * 1e-9 * TURN_CHANGE_RADPS) ** 2
        return predict_free(state, seconds, turn.R_from_to, variance)


def _row(
    m: DroneMotion, step_ns: int, force: Array64, rate: Array64
) -> tuple[float, Array64, Array64, Array64, Array64]:
    return step_ns * 1e-9, m.specific_force_drone_mps2, m.angular_velocity_drone_radps, force, rate


def _close(out: list[ImuIntervals | Gap], rows: list[tuple[float, Array64, Array64, Array64, Array64]]) -> None:
    if rows:
        step, force, rate, force_noise, rate_noise = zip(*rows, strict=True)
        out.append(
            ImuIntervals(np.array(step), np.array(force), np.array(rate), np.array(force_noise), np.array(rate_noise))
        )
        rows.clear()
