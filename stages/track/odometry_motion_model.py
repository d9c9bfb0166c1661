"""Motion model of a track from the drone's odometry, rotated by a yaw that is estimated from the track.

    p' = p + dt v + Rz(psi) (d - dt u),    v' = v + Rz(psi) w

d, w: change of position and velocity over dt by the drone's odometry; u: its velocity at the start; psi: yaw of frame
odom in frame map. The track has a velocity of its own, so that a constant velocity drift of either odometry has no
effect. The odometry is delayed: a prediction beyond the newest message is extrapolated. The next prediction corrects
it, because it starts from the odometry that the last one ended with (`OdometrySample`), not from a newer value for that
time.

psi is a grid of hypotheses, weighted by the recent positions of the track (stages/kernels/geometry/smooth_motion.py).
One more hypothesis is that the track does not follow the odometry. Two moments of the grid are needed,
m_1 = E exp(i psi) and m_2 = E exp(2 i psi): a horizontal step is a complex number z = a exp(i psi), and for two of them

    E z = a m_1,   E (z - Ez)(z' - Ez')* = a a'* (1 - |m_1|^2),   E (z - Ez)(z' - Ez') = a a' (m_2 - m_1^2)

With psi unknown (m = 0) a drone that hovers by its odometry is predicted to hover, and one that manoeuvres gets a large
covariance; with psi known its manoeuvre is predicted.

Source: ours.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.track.odometry_motion_model import YAWS, add_odometry_motion, weigh_yaws
from stages.odometry.drone.telemetry import DroneTelemetry
from stages.track.kalman import predicted

NO_ODOMETRY_PRIOR = 0.02  # prior probability that the track does not follow the odometry
WINDOW_NS = 12_000_000_000
SPACING_NS = 100_000_000
MAX_POINTS = 32
TEMPER = 0.5  # exponent of the likelihood: errors of successive positions are correlated
RETAINED_SHARE = 0.9  # weight of the last track's psi in the prior of the next track, the rest is uniform


class OdometrySample(NamedTuple):
    """Position and velocity by the drone's odometry at the time of a prediction, in frame odom."""

    source: int
    resets: int
    xyz_m: Array64
    velocity_mps: Array64


class OdometryMotionModel:
    """Predicts tracks by the drone's odometry, and estimates the yaw of frame odom from the confirmed track."""

    def __init__(self, source: int) -> None:
        """`source`: number of the odometry source, of several."""
        self._source = source
        self.telemetry = DroneTelemetry()
        self._resets = 0  # of frame odom, whose yaw is estimated
        self._number = 0  # of the track that the yaw is estimated from
        self._positions: deque[tuple[int, Array64, float]] = deque()
        self._prior = np.full(YAWS, 1.0 / YAWS)
        self._p = (1.0 - NO_ODOMETRY_PRIOR) * self._prior
        self._confidence = float(self._p.sum())
        self._moments = 0j, 0j

    def _follow_resets(self) -> None:
        """Reset psi after a reset of the autopilot's estimate, which may have changed its yaw."""
        if self._resets != self.telemetry.resets:
            self._resets = self.telemetry.resets
            self._positions.clear()
            self._prior = np.full(YAWS, 1.0 / YAWS)
            self._p = (1.0 - NO_ODOMETRY_PRIOR) * self._prior
            self._confidence = float(self._p.sum())
            self._moments = 0j, 0j

    @property
    def confidence(self) -> float:
        """Probability that the track follows the odometry."""
        return self._confidence

    def learn(self, number: int, stamp_ns: int, xyz_map_m: Array64, sigma_m: float) -> None:
        """Add a position of confirmed track `number`, with one sigma per axis."""
        self._follow_resets()
        if number != self._number:
            confidence = self.confidence
            known = self._p / confidence if confidence > 0.9 else np.full(YAWS, 1.0 / YAWS)
            self._prior = RETAINED_SHARE * known + (1.0 - RETAINED_SHARE) / YAWS
            self._number = number
            self._positions.clear()
        if self._positions and stamp_ns - self._positions[-1][0] < SPACING_NS:
            return
        if self.telemetry.state(stamp_ns) is None:
            return
        self._positions.append((stamp_ns, xyz_map_m, sigma_m))
        while stamp_ns - self._positions[0][0] > WINDOW_NS:
            self._positions.popleft()
        self._weigh()

    def _weigh(self) -> None:
        positions = list(self._positions)
        last = len(positions) - 1
        if last >= MAX_POINTS:
            positions = [positions[round(i * last / (MAX_POINTS - 1))] for i in range(MAX_POINTS)]
        states = [self.telemetry.state(stamp) for stamp, _, _ in positions]
        rows = [k for k, state in enumerate(states) if state is not None]
        if len(rows) < 2:
            return
        t_s = np.array([positions[k][0] - positions[rows[-1]][0] for k in rows]) * 1e-9
        x_m = np.array([positions[k][1] for k in rows])
        odometry_m = np.array([state[0] for state in states if state is not None])
        sigma_m = float(np.mean([positions[k][2] for k in rows]))
        log_turned, log_free = weigh_yaws(t_s, x_m, odometry_m, sigma_m)
        log_w = TEMPER * log_turned + np.log((1.0 - NO_ODOMETRY_PRIOR) * self._prior)
        free = TEMPER * log_free + math.log(NO_ODOMETRY_PRIOR)
        top = max(float(log_w.max()), free)
        w = np.exp(log_w - top)
        self._p = w / (w.sum() + math.exp(free - top))
        self._confidence = float(self._p.sum())
        turn = np.exp(1j * math.tau * np.arange(YAWS) / YAWS)
        self._moments = complex(self._p @ turn), complex(self._p @ turn**2)

    def sample(self, stamp_ns: int) -> OdometrySample | None:
        """Odometry at a time; None when there is none."""
        state = self.telemetry.state(stamp_ns)
        return None if state is None else OdometrySample(self._source, self.telemetry.resets, *state)

    def predicted(
        self,
        x: Array64,
        P: Array64,
        dt_s: float,
        before: OdometrySample | None,
        after: OdometrySample | None,
        q_free: float,
        q_odometry: float,
    ) -> tuple[Array64, Array64]:
        """State (6,) and covariance (6, 6) of a track dt_s later, given the odometry before and after.

        `q_odometry` and `q_free`: density of its acceleration [m^2/s^3] with and without odometry. Without two samples
        of the same source and segment, and for negative dt_s, the prediction has constant velocity and q_free.
        """
        if before is None or after is None or before[:2] != after[:2] or dt_s <= 0:
            return predicted(x, P, dt_s, q_free)
        self._follow_resets()
        confidence = self.confidence
        x, covariance = predicted(x, P, dt_s, confidence * q_odometry + (1.0 - confidence) * q_free)
        add_odometry_motion(x, covariance, dt_s, *before[2:], *after[2:], confidence, *self._moments)
        return x, covariance
