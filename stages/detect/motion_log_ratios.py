"""What the drone itself says of its flight, and how well a candidate's path fits it.

The autopilot tells its position in a frame of its own: z up, north anywhere, drifting slowly. A candidate that is the
drone moves as it says, turned by a yaw psi that nobody knows:

    drone      x_i = c + Rz(psi) d_i + u t_i + noise           u: drift of both odometries, decimetres a second
    still      x_i = c + u t_i + noise                         a lamp; or scattered, or met farther and farther along
                                                               something long (a wire: as fast as one looks along it)
    flier      x_i = c + v t_i + a t_i^2 / 2 + noise           v, a of a bird, or of a balloon, on a string or loose

Each is a Gaussian over the path's n points, c and psi are integrated out; ln of the ratio of two marginal likelihoods
is the evidence. Speeds and heights alone tell the drone from a bird in a few looks, whatever psi is. A drone that hangs
still says nothing against a lamp.

Source: ours; DESIGN, The graph: `odometry` ("autopilot odometry when present").
"""

from __future__ import annotations

from bisect import bisect_left
from typing import NamedTuple

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.detect.motion_log_ratios import weigh
from stages.odometry.drone.telemetry import KEPT_NS, DroneTelemetry

MOST_POINTS = 14
SILENT_NS = 2_000_000_000  # by then a path may have gone over from one thing to another
DENIED = -3.0  # nats
MOST_MISFIT = 4.0  # beyond it is none of these, and nothing speaks for the drone; drones come to 1.3


class Heard(NamedTuple):
    """ln of how much likelier a path is as the drone's than as something else's, psi not known."""

    over_still: float
    over_bird: float
    over_balloon: float
    over_wire: float  # over what is met farther and farther along it, at any speed: the aim looks where it expects
    misfit: float  # by how many squared sigmas a coordinate it is off the drone's way at the best yaw
    way_m: float  # how far the drone says it has been from where it was at first; up, where only heights are compared

    @property
    def denied(self) -> bool:
        """Whether it clearly does not fly as the drone says."""
        return min(self.over_still, self.over_bird, self.over_balloon) < DENIED


def hear(
    telemetry: DroneTelemetry, path_ns: list[int], path_m: list[Array64], sigma_m: float, level_known: bool
) -> Heard | None:
    """Compare a path (n, 3) in a frame that stands still and is level with what the drone says; None: nothing to say.

    Sightings at which the drone was silent are left out; when it is silent by now it says nothing at all.

    `level_known` False: the vehicle's motion is not known, so only heights are compared. sigma_m: of a sighting.
    """
    heard_ns = telemetry.span_ns
    if heard_ns is None or len(path_ns) < 2 or path_ns[-1] > heard_ns[1] + SILENT_NS:
        return None
    first = bisect_left(path_ns, max(path_ns[-1] - KEPT_NS // 2, heard_ns[0]))
    if len(path_ns) - first < 2:
        return None
    rows = list(range(first, len(path_ns)))
    if len(rows) > MOST_POINTS:
        last = len(rows) - 1
        rows = [rows[round(i * last / (MOST_POINTS - 1))] for i in range(MOST_POINTS)]
    states = {k: telemetry.state(path_ns[k]) for k in rows}
    places = {k: state[0] for k, state in states.items() if state is not None}
    if len(places) < 2:
        return None
    rows, told = list(places), np.array(list(places.values()))
    t = (np.array([path_ns[k] for k in rows]) - path_ns[rows[-1]]) * 1e-9
    compared_m = told if level_known else told[:, 2:]
    way_m = float(np.sqrt(((compared_m - compared_m[0]) ** 2).sum(axis=1).max()))
    heard = Heard(*weigh(t, np.array([path_m[k] for k in rows]), told, sigma_m, level_known), way_m)
    if heard.misfit <= MOST_MISFIT:
        return heard
    still, bird, balloon, wire = (min(ratio, 0.0) for ratio in heard[:4])
    return Heard(still, bird, balloon, wire, heard.misfit, way_m)
