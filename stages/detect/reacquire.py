"""A drone met again after a pause: not near where it was, but where it says it would be.

A beam meets a far or fast drone once in a passing of the fan, and again a second later, many metres on. What it was
before and what is met now are one thing if they lie as far apart, along and up, as the drone says that it has flown:

    | |x - x_0| level - |d - d_0| level |  and  | (x - x_0) up - (d - d_0) up |   within the noise of both

The yaw of its autopilot's frame is not known, so that is a ring; afterwards the two sightings tell it. What was there
before goes on beside the joined one: the sighting may be of something else.

Source: ours; DESIGN, The graph: `odometry` ("autopilot odometry when present").
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from stages.detect.candidate import Candidate, Sighting
from stages.detect.flight import scatter_m
from stages.geometry.frames import Array64
from stages.kernels.detect.candidate import SIGMA_M
from stages.kernels.detect.motion_log_ratios import DRIFT_MPS, DRIFT_UP_MPS
from stages.odometry.drone.telemetry import DroneTelemetry

SOONEST_NS, LATEST_NS = 250_000_000, 3_500_000_000  # the pause
LEAST_M = 0.6  # a drone that hardly moved is met where it was
GATE = 2.5  # sigmas
TWIN_LOOKS = 4  # in common: one thing
SPEED_SIGMA_MPS = 1.0  # of the velocity it says, turned by two sightings


def met_again(
    candidates: Iterable[Candidate], s: Sighting, telemetry: DroneTelemetry
) -> tuple[Candidate, Array64] | None:
    """The candidate that a sighting goes on with if it is the drone, and its velocity (3,) now; None: there is none."""
    now = telemetry.state(s.stamp_ns)
    if now is None:
        return None
    best, least, velocity = None, GATE**2, np.zeros(3)
    for c in candidates:
        if not c.told or c.among or c.big_looks or not SOONEST_NS < s.stamp_ns - c.seen_ns < LATEST_NS:
            continue
        then = telemetry.state(c.seen_ns)
        if then is None:
            continue
        way, said = s.xyz_map_m - c.path_m[-1], now[0] - then[0]
        level_m, said_m = math.hypot(way[0], way[1]), math.hypot(said[0], said[1])
        if said_m < LEAST_M:
            continue
        pause_s = (s.stamp_ns - c.seen_ns) * 1e-9
        scatter = math.sqrt(2.0) * (0.03 + scatter_m(s.range_m))
        level = (level_m - said_m) / math.hypot(scatter, DRIFT_MPS * pause_s)
        up = (way[2] - said[2]) / math.hypot(scatter, DRIFT_UP_MPS * pause_s)
        cost = level * level + up * up
        if cost < least:
            yaw = math.atan2(way[1], way[0]) - math.atan2(said[1], said[0])
            x, y, z = now[1]
            turned = math.cos(yaw) * x - math.sin(yaw) * y, math.sin(yaw) * x + math.cos(yaw) * y, z
            best, least, velocity = c, cost, np.array(turned)
    return None if best is None else (best, velocity)


def without_twins(candidates: Iterable[Candidate]) -> list[Candidate]:
    """Of a joined candidate and what shares its last sightings only the likelier one is kept."""
    kept: dict[tuple[int, ...], Candidate] = {}
    for c in candidates:
        key = tuple(c.path_ns[-TWIN_LOOKS:]) if len(c.path_ns) >= TWIN_LOOKS else (-c.number,)
        if key not in kept or c.odds > kept[key].odds:
            kept[key] = c
    return list(kept.values())


def joined(c: Candidate, number: int, s: Sighting, velocity_mps: Array64) -> Candidate:
    """A candidate that has been this one and is the sighting now; this one goes on as it was."""
    new = replace(
        c,
        number=number,
        stamp_ns=s.stamp_ns,
        seen_ns=s.stamp_ns,
        xyz_m=s.xyz_map_m,
        velocity_mps=velocity_mps,
        range_m=s.range_m,
        p=(SIGMA_M**2, 0.0, SPEED_SIGMA_MPS**2),
        hit_looks=c.hit_looks + 1,
        joined_at=c.hit_looks,
        joined_ns=s.stamp_ns,
        accepted=False,
        announced=False,
        free=c.free.copy(),
        path_ns=list(c.path_ns),
        path_m=list(c.path_m),
        beside_m=list(c.beside_m),
    )
    new.note(s)
    return new
