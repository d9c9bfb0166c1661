"""How the drone's own word moves a track: what it says of its flight, turned by a yaw that is learnt on the way.

    p' = p + dt v + Rz(psi) (d - dt u),    v' = v + Rz(psi) w

d, w: how far the autopilot says it flew since, and how its velocity changed; u: its velocity then; psi: the yaw of its
frame in the local one. The track keeps a velocity of its own, so a drift of either odometry counts only as it changes.
Its word comes late: a prediction beyond the newest word is made good by the next one, which begins with the word that
this one ended with (`Word`), not with what was heard of that moment since.

psi is a grid of hypotheses, weighed by where the track was lately (stages/kernels/geometry/smooth_motion.py); one
more
says
that the track does not fly as told. Of the grid two moments are needed, m_1 = E exp(i psi), m_2 = E exp(2 i psi): a
level step
is a complex number z = a exp(i psi), and for two of them

    E z = a m_1,   E (z - Ez)(z' - Ez')* = a a'* (1 - |m_1|^2),   E (z - Ez)(z' - Ez') = a a' (m_2 - m_1^2)

So with psi unknown (m = 0) a drone that says it hangs is predicted to hang, and one that turns hard is predicted
widely; with psi known it is predicted where it went.

Source: ours; DESIGN, The graph: track "motion-predicted".
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

NO_ODOMETRY_PRIOR = 0.02  # prior of a track that does not fly as told
WINDOW_NS = 12_000_000_000
SPACING_NS = 100_000_000
MAX_POINTS = 32
TEMPER = 0.5  # neighbouring places err together
RETAINED_SHARE = 0.9  # of what is known of psi, for the next track


class OdometrySample(NamedTuple):
    """What was believed of the drone's own place and velocity when a state was predicted, in the autopilot's frame."""

    source: int
    resets: int
    xyz_m: Array64
    velocity_mps: Array64


class OdometryMotionModel:
    """Predicts tracks by the drone's word, and learns the yaw of that word from the confirmed one."""

    def __init__(self, source: int) -> None:
        """`source`: the number of the messages it comes from, should there be several."""
        self._source = source
        self.telemetry = DroneTelemetry()
        self._resets = 0  # of the frame whose yaw is learnt
        self._number = 0  # of the track learnt from
        self._positions: deque[tuple[int, Array64, float]] = deque()
        self._prior = np.full(YAWS, 1.0 / YAWS)
        self._p = (1.0 - NO_ODOMETRY_PRIOR) * self._prior
        self._confidence = float(self._p.sum())
        self._moments = 0j, 0j

    def _follow_resets(self) -> None:
        """What was learnt of psi is of no use once the autopilot's estimate jumped: it may have turned."""
        if self._resets != self.telemetry.resets:
            self._resets = self.telemetry.resets
            self._positions.clear()
            self._prior = np.full(YAWS, 1.0 / YAWS)
            self._p = (1.0 - NO_ODOMETRY_PRIOR) * self._prior
            self._confidence = float(self._p.sum())
            self._moments = 0j, 0j

    @property
    def confidence(self) -> float:
        """Probability that the track flies as told."""
        return self._confidence

    def learn(self, number: int, stamp_ns: int, xyz_map_m: Array64, sigma_m: float) -> None:
        """Where confirmed track `number` was, and how well that is known, one sigma an axis."""
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
        """The drone's word for a time; None when it was silent then."""
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
        """State (6,) and covariance (6, 6) of a track dt_s later, by the words for then and now.

        q_told: density of its acceleration that they leave. Without two words of one source, and back in time, it is
        q_free.
        """
        if before is None or after is None or before[:2] != after[:2] or dt_s <= 0:
            return predicted(x, P, dt_s, q_free)
        self._follow_resets()
        confidence = self.confidence
        x, covariance = predicted(x, P, dt_s, confidence * q_odometry + (1.0 - confidence) * q_free)
        add_odometry_motion(x, covariance, dt_s, *before[2:], *after[2:], confidence, *self._moments)
        return x, covariance
