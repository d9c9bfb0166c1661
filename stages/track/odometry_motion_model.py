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
from stages.kernels.track.odometry_motion_model import YAWS, move_as_told, weigh_yaws
from stages.odometry.drone.telemetry import DroneTelemetry
from stages.track.kalman import predicted

NONE = 0.02  # prior of a track that does not fly as told
WINDOW_NS = 12_000_000_000
APART_NS = 100_000_000
MOST_POINTS = 32
TEMPER = 0.5  # neighbouring places err together
KEPT_SHARE = 0.9  # of what is known of psi, for the next track


class Word(NamedTuple):
    """What was believed of the drone's own place and velocity when a state was predicted, in the autopilot's frame."""

    source: int
    resets: int
    xyz_m: Array64
    velocity_mps: Array64


class ToldMotion:
    """Predicts tracks by the drone's word, and learns the yaw of that word from the confirmed one."""

    def __init__(self, source: int) -> None:
        """`source`: the number of the messages it comes from, should there be several."""
        self._source = source
        self.told = DroneTelemetry()
        self._resets = 0  # of the frame whose yaw is learnt
        self._number = 0  # of the track learnt from
        self._places: deque[tuple[int, Array64, float]] = deque()
        self._prior = np.full(YAWS, 1.0 / YAWS)
        self._p = (1.0 - NONE) * self._prior
        self._sure = float(self._p.sum())
        self._moments = 0j, 0j

    def _of_this_frame(self) -> None:
        """What was learnt of psi is of no use once the autopilot's estimate jumped: it may have turned."""
        if self._resets != self.told.resets:
            self._resets = self.told.resets
            self._places.clear()
            self._prior = np.full(YAWS, 1.0 / YAWS)
            self._p = (1.0 - NONE) * self._prior
            self._sure = float(self._p.sum())
            self._moments = 0j, 0j

    @property
    def sure(self) -> float:
        """Probability that the track flies as told."""
        return self._sure

    def learn(self, number: int, stamp_ns: int, xyz_map_m: Array64, sigma_m: float) -> None:
        """Where confirmed track `number` was, and how well that is known, one sigma an axis."""
        self._of_this_frame()
        if number != self._number:
            sure = self.sure
            known = self._p / sure if sure > 0.9 else np.full(YAWS, 1.0 / YAWS)
            self._prior = KEPT_SHARE * known + (1.0 - KEPT_SHARE) / YAWS
            self._number = number
            self._places.clear()
        if self._places and stamp_ns - self._places[-1][0] < APART_NS:
            return
        if self.told.state(stamp_ns) is None:
            return
        self._places.append((stamp_ns, xyz_map_m, sigma_m))
        while stamp_ns - self._places[0][0] > WINDOW_NS:
            self._places.popleft()
        self._weigh()

    def _weigh(self) -> None:
        places = list(self._places)
        last = len(places) - 1
        if last >= MOST_POINTS:
            places = [places[round(i * last / (MOST_POINTS - 1))] for i in range(MOST_POINTS)]
        states = [self.told.state(stamp) for stamp, _, _ in places]
        rows = [k for k, state in enumerate(states) if state is not None]
        if len(rows) < 2:
            return
        t_s = np.array([places[k][0] - places[rows[-1]][0] for k in rows]) * 1e-9
        x_m = np.array([places[k][1] for k in rows])
        told_m = np.array([state[0] for state in states if state is not None])
        sigma_m = float(np.mean([places[k][2] for k in rows]))
        log_turned, log_free = weigh_yaws(t_s, x_m, told_m, sigma_m)
        log_w = TEMPER * log_turned + np.log((1.0 - NONE) * self._prior)
        free = TEMPER * log_free + math.log(NONE)
        top = max(float(log_w.max()), free)
        w = np.exp(log_w - top)
        self._p = w / (w.sum() + math.exp(free - top))
        self._sure = float(self._p.sum())
        turn = np.exp(1j * math.tau * np.arange(YAWS) / YAWS)
        self._moments = complex(self._p @ turn), complex(self._p @ turn**2)

    def word(self, stamp_ns: int) -> Word | None:
        """The drone's word for a time; None when it was silent then."""
        state = self.told.state(stamp_ns)
        return None if state is None else Word(self._source, self.told.resets, *state)

    def predicted(
        self, x: Array64, P: Array64, dt_s: float, before: Word | None, after: Word | None, q_free: float, q_told: float
    ) -> tuple[Array64, Array64]:
        """State (6,) and covariance (6, 6) of a track dt_s later, by the words for then and now.

        q_told: density of its acceleration that they leave. Without two words of one source, and back in time, it is
        q_free.
        """
        if before is None or after is None or before[:2] != after[:2] or dt_s <= 0:
            return predicted(x, P, dt_s, q_free)
        self._of_this_frame()
        sure = self.sure
        x, covariance = predicted(x, P, dt_s, sure * q_told + (1.0 - sure) * q_free)
        move_as_told(x, covariance, dt_s, *before[2:], *after[2:], sure, *self._moments)
        return x, covariance
