"""Reacquisition: continue a candidate after a pause, at the position that the drone's odometry predicts.

A beam observes a far or fast drone once in a passing of the fan, and again a second later, many metres on. Candidate
and observation are one object if their displacement equals that of the odometry, level and vertical:

    | |x - x_0| level - |d - d_0| level |  and  | (x - x_0) up - (d - d_0) up |   within the noise of both

The yaw of the odometry's frame is unknown, so the prediction is a ring; the two observations then determine the yaw.
The earlier candidate is kept next to the reacquired one: the observation may be of another object.

Source: ours; DESIGN, The graph: `odometry` ("autopilot odometry when present").
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from stages.detect.candidate import Candidate, Observation
from stages.detect.flight import path_sigma_m
from stages.geometry.frames import Array64
from stages.kernels.detect.candidate import SIGMA_M
from stages.kernels.detect.motion_log_ratios import DRIFT_MPS, DRIFT_UP_MPS
from stages.odometry.drone.telemetry import DroneTelemetry

SOONEST_NS, LATEST_NS = 250_000_000, 3_500_000_000  # limits of the pause
LEAST_M = 0.6  # after a smaller displacement ordinary association finds it
GATE = 2.5  # sigmas
DUPLICATE_PASSES = 4  # common observations that make two candidates duplicates
SPEED_SIGMA_MPS = 1.0  # of the odometry's velocity, turned by the yaw of two observations


def reacquire(
    candidates: Iterable[Candidate], s: Observation, telemetry: DroneTelemetry
) -> tuple[Candidate, Array64] | None:
    """The candidate that the observation continues if it is the drone, and its velocity (3,); None: none fits."""
    now = telemetry.state(s.stamp_ns)
    if now is None:
        return None
    best, least, velocity = None, GATE**2, np.zeros(3)
    for c in candidates:
        if (
            not c.is_promising
            or c.near_rejected
            or c.large_object_passes
            or not SOONEST_NS < s.stamp_ns - c.seen_ns < LATEST_NS
        ):
            continue
        then = telemetry.state(c.seen_ns)
        if then is None:
            continue
        moved_m, odometry_m = s.xyz_map_m - c.path_m[-1], now[0] - then[0]
        level_m, odometry_level_m = math.hypot(moved_m[0], moved_m[1]), math.hypot(odometry_m[0], odometry_m[1])
        if odometry_level_m < LEAST_M:
            continue
        pause_s = (s.stamp_ns - c.seen_ns) * 1e-9
        scatter = math.sqrt(2.0) * path_sigma_m(s.range_m)
        level = (level_m - odometry_level_m) / math.hypot(scatter, DRIFT_MPS * pause_s)
        up = (moved_m[2] - odometry_m[2]) / math.hypot(scatter, DRIFT_UP_MPS * pause_s)
        cost = level * level + up * up
        if cost < least:
            yaw = math.atan2(moved_m[1], moved_m[0]) - math.atan2(odometry_m[1], odometry_m[0])
            x, y, z = now[1]
            rotated = math.cos(yaw) * x - math.sin(yaw) * y, math.sin(yaw) * x + math.cos(yaw) * y, z
            best, least, velocity = c, cost, np.array(rotated)
    return None if best is None else (best, velocity)


def without_duplicates(candidates: Iterable[Candidate]) -> list[Candidate]:
    """The candidates without duplicates: of those with common last observations the most probable one."""
    kept: dict[tuple[int, ...], Candidate] = {}
    for c in candidates:
        key = tuple(c.path_ns[-DUPLICATE_PASSES:]) if len(c.path_ns) >= DUPLICATE_PASSES else (-c.number,)
        if key not in kept or c.single_log_odds > kept[key].single_log_odds:
            kept[key] = c
    return list(kept.values())


def reacquired_candidate(c: Candidate, number: int, s: Observation, velocity_mps: Array64) -> Candidate:
    """A copy of the candidate that continues at the observation; the original is unchanged."""
    new = replace(
        c,
        number=number,
        stamp_ns=s.stamp_ns,
        seen_ns=s.stamp_ns,
        xyz_m=s.xyz_map_m,
        velocity_mps=velocity_mps,
        range_m=s.range_m,
        p=(SIGMA_M**2, 0.0, SPEED_SIGMA_MPS**2),
        scan_passes=c.scan_passes + 1,
        reacquired_at=c.scan_passes,
        reacquired_ns=s.stamp_ns,
        first_ns=s.stamp_ns,
        accepted=False,
        announced=False,
        free=c.free.copy(),
        path_ns=list(c.path_ns),
        path_m=list(c.path_m),
        relative_path_m=list(c.relative_path_m),
    )
    new.add_observation(s)
    return new
