"""What the drone itself says of its flight, and how well a candidate's path fits it.

The autopilot tells its position in a frame of its own: z up, north anywhere, drifting slowly. A candidate that is the
drone moves as it says, turned by a yaw psi that nobody knows:

    drone      x_i = c + Rz(psi) d_i + u t_i + noise           u: drift of both odometries, decimetres a second
    still      x_i = c + u t_i + noise                         a lamp; or scattered, or met farther and farther along
                                                               something long
    flier      x_i = c + v t_i + a t_i^2 / 2 + noise           v, a of a bird, or of a balloon

Each is a Gaussian over the path's n points, c and psi are integrated out; ln of the ratio of two marginal likelihoods
is the evidence. Speeds and heights alone tell the drone from a bird in a few looks, whatever psi is. A drone that hangs
still says nothing against a lamp.

Source: ours; DESIGN, The graph: `odometry` ("autopilot odometry when present").
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from typing import NamedTuple

import numpy as np

from stages.compiled import compiled
from stages.geometry import Array64

KEPT_NS = 20_000_000_000
AHEAD_NS = 500_000_000  # beyond the newest word it is not known any more
JUMP_M = 1.0  # a step that its velocity does not explain: the autopilot's estimate was reset
YAWS = 72  # steps of 5 deg: coarser, a fast straight flight fits none
MOST_POINTS = 14
ANYWHERE_M = 100.0
DRIFT_MPS = 0.3  # of the autopilot's velocity and the vehicle's, together, level
DRIFT_UP_MPS = 0.1
SCATTERED_M = 0.45  # sightings of something long
SLIDING_MPS = 0.5  # or how fast looks at it wander along
CRUISING, CRUISE_MPS, CRUISE_SIGMA_MPS = 0.8, 10.0, 2.5  # share of birds' time, speed; else anything up to it
BIRD = (6.0, 3.0, 1.5, 1.0)  # sigma of speed [m/s] and acceleration [m/s^2], level; the same, up
BALLOON = (0.7, 0.7, 0.3, 0.4)


class Heard(NamedTuple):
    """ln of how much likelier a path is as the drone's than as something else's, psi not known."""

    over_still: float
    over_bird: float
    over_balloon: float


class DroneTelemetry:
    """Where the drone says it has been, lately."""

    def __init__(self) -> None:
        self._ns: deque[int] = deque()
        self._xyz_m: deque[Array64] = deque()
        self._v_mps: deque[Array64] = deque()

    def add(self, stamp_ns: int, xyz_m: Array64, v_mps: Array64) -> None:
        """One word of it, in the autopilot's level frame; older than the newest is left out."""
        if self._ns:
            dt = (stamp_ns - self._ns[-1]) * 1e-9
            if dt <= 0:
                return
            left = xyz_m - self._xyz_m[-1] - 0.5 * dt * (v_mps + self._v_mps[-1])
            if float(np.linalg.norm(left)) > JUMP_M + dt:
                for kept in (self._ns, self._xyz_m, self._v_mps):
                    kept.clear()
        self._ns.append(stamp_ns)
        self._xyz_m.append(xyz_m)
        self._v_mps.append(v_mps)
        while stamp_ns - self._ns[0] > KEPT_NS:
            for kept in (self._ns, self._xyz_m, self._v_mps):
                kept.popleft()

    def speed_mps(self, stamp_ns: int) -> tuple[float, float] | None:
        """(level, up) at a time; None when it is silent."""
        if not self._ns or abs(stamp_ns - self._ns[-1]) > AHEAD_NS:
            return None
        x, y, z = self._v_mps[-1]
        return math.hypot(x, y), float(z)

    def at(self, stamps_ns: list[int]) -> Array64 | None:
        """Positions (n, 3) [m] in the autopilot's frame; None when it was silent then."""
        if len(self._ns) < 2 or stamps_ns[0] < self._ns[0]:
            return None
        known = list(self._ns)
        found = np.empty((len(stamps_ns), 3))
        for i, stamp in enumerate(stamps_ns):
            k = min(bisect_left(known, stamp), len(known) - 1)
            near = k - 1 if k and abs(known[k - 1] - stamp) < abs(known[k] - stamp) else k
            if abs(known[near] - stamp) > AHEAD_NS:
                return None
            found[i] = self._xyz_m[near] + (stamp - known[near]) * 1e-9 * self._v_mps[near]
        return found


def hear(
    telemetry: DroneTelemetry, path_ns: list[int], path_m: list[Array64], sigma_m: float, level_known: bool
) -> Heard | None:
    """Compare a path (n, 3) in a frame that stands still and is level with what the drone says; None: nothing to say.

    `level_known` False: the vehicle's motion is not known, so only heights are compared. sigma_m: of a sighting.
    """
    first = bisect_left(path_ns, path_ns[-1] - KEPT_NS // 2)
    rows = list(range(first, len(path_ns)))
    if len(rows) > MOST_POINTS:
        last = len(rows) - 1
        rows = [rows[round(i * last / (MOST_POINTS - 1))] for i in range(MOST_POINTS)]
    if len(rows) < 2:
        return None
    told = telemetry.at([path_ns[k] for k in rows])
    if told is None:
        return None
    t = (np.array([path_ns[k] for k in rows]) - path_ns[rows[-1]]) * 1e-9
    return Heard(*weigh(t, np.array([path_m[k] for k in rows]), told, sigma_m, level_known))


@compiled
def weigh(t_s: Array64, x_m: Array64, told_m: Array64, sigma_m: float, level_known: bool) -> tuple[float, float, float]:
    """The evidence (see Heard) of a path x (n, 3) at times t (n,) against what the drone told of itself (n, 3)."""
    x, d = x_m.copy(), told_m.copy()
    for axis in range(3):
        x[:, axis] -= x[:, axis].mean()
        d[:, axis] -= d[:, axis].mean()
    as_drone = _model(t_s, sigma_m, DRIFT_MPS, 0.0)
    as_long = _model(t_s, SCATTERED_M, 0.0, 0.0)
    as_sliding = _model(t_s, sigma_m, SLIDING_MPS, 0.0)
    up = x[:, 2].copy()
    upright = _model(t_s, sigma_m, DRIFT_UP_MPS, 0.0)
    drone = _log_p(upright, t_s, up - d[:, 2])
    still, long = _log_p(upright, t_s, up), _log_p(as_long, t_s, up)  # what stands drifts alike
    sliding = still
    bird = _log_p(_model(t_s, sigma_m, BIRD[2], BIRD[3]), t_s, up)
    balloon = _log_p(_model(t_s, sigma_m, BALLOON[2], BALLOON[3]), t_s, up)
    if level_known:
        as_cruising = _model(t_s, sigma_m, CRUISE_SIGMA_MPS, BIRD[1])
        as_wheeling = _model(t_s, sigma_m, BIRD[0], BIRD[1])
        as_balloon = _model(t_s, sigma_m, BALLOON[0], BALLOON[1])
        turned, cruising, wheeling = np.empty(YAWS), np.empty(YAWS), 0.0
        for k in range(YAWS):
            c, s = math.cos(math.tau * k / YAWS), math.sin(math.tau * k / YAWS)
            turned[k] = _log_p(as_drone, t_s, x[:, 0] - c * d[:, 0] + s * d[:, 1])
            turned[k] += _log_p(as_drone, t_s, x[:, 1] - s * d[:, 0] - c * d[:, 1])
            cruising[k] = _log_p(as_cruising, t_s, x[:, 0] - CRUISE_MPS * c * t_s)
            cruising[k] += _log_p(as_cruising, t_s, x[:, 1] - CRUISE_MPS * s * t_s)
        drone += _log_mean(turned)
        for axis in range(2):
            e = x[:, axis].copy()
            still += _log_p(as_drone, t_s, e)
            long += _log_p(as_long, t_s, e)
            sliding += _log_p(as_sliding, t_s, e)
            wheeling += _log_p(as_wheeling, t_s, e)
            balloon += _log_p(as_balloon, t_s, e)
        cruise = math.log(CRUISING) + _log_mean(cruising)
        wheeling += math.log(1.0 - CRUISING)
        bird += max(cruise, wheeling) + math.log1p(math.exp(-abs(cruise - wheeling)))
    return drone - _log_mean(np.array([still, long, sliding])), drone - bird, drone - balloon


@compiled
def _model(t: Array64, sigma: float, speed: float, acceleration: float) -> Array64:
    """What `_log_p` needs of e (n,) = c + v t + a t^2 / 2 + noise: (4, 3), a Cholesky factor L and what is constant.

    c, v, a are normal about zero with sigmas ANYWHERE_M, speed, acceleration; 0: there is none.
        ln p = -(e.e / sigma^2 - b.A^-1 b) / 2 - ln|A Q| / 2 - n ln sigma
        A = B'B / sigma^2 + Q^-1 = L L', b = B'e / sigma^2, B = (1, t, t^2 / 2)
    but for n ln(2 pi) / 2.
    """
    model, power = np.zeros((4, 3)), np.empty(3)
    q = (ANYWHERE_M, speed, acceleration)
    k = 1 + (speed > 0.0) + (acceleration > 0.0)
    for i in range(len(t)):
        power[0], power[1], power[2] = 1.0, t[i], 0.5 * t[i] * t[i]
        for r in range(k):
            for c in range(r + 1):
                model[r, c] += power[r] * power[c] / (sigma * sigma)
    constant = -len(t) * math.log(sigma)
    for r in range(k):
        for c in range(r + 1):
            left = model[r, c] + (1.0 / (q[r] * q[r]) if r == c else 0.0)
            for m in range(c):
                left -= model[r, m] * model[c, m]
            model[r, c] = math.sqrt(left) if r == c else left / model[c, c]
        constant -= math.log(model[r, r] * q[r])
    model[3, 0], model[3, 1], model[3, 2] = constant, 1.0 / (sigma * sigma), k
    return model


@compiled
def _log_p(model: Array64, t: Array64, e: Array64) -> float:
    """ln of the marginal likelihood of e (n,); see `_model`."""
    b0 = b1 = b2 = square = 0.0
    for i in range(len(t)):
        square += e[i] * e[i]
        b0 += e[i]
        b1 += e[i] * t[i]
        b2 += 0.5 * e[i] * t[i] * t[i]
    weight = model[3, 1]
    y = b0 * weight / model[0, 0]
    gained = y * y
    if model[3, 2] > 1.0:
        z = (b1 * weight - model[1, 0] * y) / model[1, 1]
        gained += z * z
        if model[3, 2] > 2.0:
            gained += ((b2 * weight - model[2, 0] * y - model[2, 1] * z) / model[2, 2]) ** 2
    return model[3, 0] - 0.5 * square * weight + 0.5 * gained


@compiled
def _log_mean(values: Array64) -> float:
    top = values.max()
    return top + math.log(np.exp(values - top).mean())
