"""One look at a drone: the pulses that pass near it while the rotor goes by, and what they say of its place.

Source: ours, for P III.C; the likelihood is that of `stages/track/hull.py`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.sweep.pulses import LONGEST
from stages.kernels.track.hull import DEPTH, GLIMPSE, HIT, KIND, MISS, NEARER, WHEN_S, A, B, collect, posterior
from stages.kernels.track.runs import mask_walls
from stages.kernels.track.scan_pass import largest_sigma_m, seen_from
from stages.messages import SweptPulses
from stages.track.hull import COLUMNS, WIDTH, across
from stages.track.kalman import condition, measured

MAX_OFFSET_M = 6.0  # beside the prediction pulses are collected
RANGE_NOISE = 0.1  # of one return about the body's middle, one sigma, over the span: it is as deep
RANGE_FLOOR_M = 0.02
MAX_ROWS = 256
OFF_SPAN = np.array([0.3, 0.3, 0.2])  # a, b, depth: of returns about the prediction beside its own sigma, over the span
MIN_SCORE = -6.0  # of a group: of 3498 looks at drones followed in 25 flights as built none was worse than -4.8,
MIN_GLIMPSE_SCORE = -1.5  # and one in a hundred worse than this


@dataclass(slots=True, eq=False)
class ScanPass:
    """Pulses of one passing of the rotor, and the state they are measured against."""

    start_ns: int
    last_ns: int
    x: Array64  # (6,) predicted at start_ns, local frame
    P: Array64
    line: Array64  # unit line of sight, local frame
    reach_m: float  # pulses so near the prediction count; those farther out show where a wall goes on
    parts: list[Array64] = field(default_factory=lambda: list[Array64]())

    @property
    def sigma_m(self) -> float:
        """Largest sigma of the predicted position."""
        return largest_sigma_m(self.P)


class PassUpdate(NamedTuple):
    """What a look says."""

    x: Array64  # state at the look's start
    P: Array64
    evidence: float  # ln of the likelihood, drone over nothing
    hits: int
    expected: float  # hits expected there
    beside: int  # pulses that passed it
    return_ns: int  # mean time of the hits; the look's start when there were none


def collect_into(
    scan_pass: ScanPass | None,
    pulses: SweptPulses,
    R: Array64,
    t: Array64,
    axis: Array64,
    x: Array64,
    P: Array64,
    span_m: float,
    de_skew: bool,
) -> ScanPass | None:
    """The look with this slice's pulses near the drone, a new one if there was none; None while there are none.

    R, t are T_map_vehicle of the slice, `axis` (3,) its mean direction; x, P the state predicted at the look's start.
    """
    origin = np.array(pulses.origin_vehicle_m)
    away, range_m, here = seen_from(R, t, origin, x, axis)
    if not here:
        return scan_pass
    start_ns = pulses.stamp_ns if scan_pass is None else scan_pass.start_ns
    sigma_m = largest_sigma_m(P)
    reach_m = min(0.6 * span_m + 3.0 * sigma_m, MAX_OFFSET_M)
    line = R @ away / range_m if scan_pass is None else scan_pass.line
    found = np.empty((pulses.range_m.size, COLUMNS))
    count = collect(
        pulses.point_stamp_ns,
        pulses.direction_vehicle,
        pulses.range_m,
        pulses.laser,
        origin,
        away + origin,
        R.T @ x[3:] if de_skew else np.zeros(3),
        start_ns,
        reach_m + LONGEST * span_m,
        0.5 + 3.0 * sigma_m,
        R.T @ line,
        across(line) @ R,  # level in the local frame, as `evaluate` takes them
        found,
    )
    if count == 0:
        return scan_pass
    if scan_pass is None:
        scan_pass = ScanPass(start_ns, start_ns, x, P, line, reach_m)
    scan_pass.parts.append(found[:count])
    scan_pass.last_ns = int(pulses.point_stamp_ns[-1])
    return scan_pass


def evaluate(
    scan_pass: ScanPass, span_m: float, hull_offset_m: float, p_0: float, use_pass_throughs: bool, own_sigma_m: float
) -> PassUpdate | None:
    """Where the drone is after a look; None when the look says nothing.

    What is hit where the prediction is worse than own_sigma_m may be anything: that is for the detector to judge.
    """
    pulses, sigma_m = np.concatenate(scan_pass.parts), scan_pass.sigma_m
    mask_walls(pulses, span_m)
    pulses = pulses[np.hypot(pulses[:, A], pulses[:, B]) <= scan_pass.reach_m]
    missed = pulses[(pulses[:, KIND] == MISS) | (pulses[:, KIND] == NEARER)]
    H = across(scan_pass.line)
    prior = H @ scan_pass.P[:3, :3] @ H.T
    mean, after = np.zeros(2), np.zeros((2, 2))
    rows = drone_returns(pulses, span_m, sigma_m) if sigma_m < own_sigma_m else None
    if rows is None:
        alone = len(missed) == len(pulses) > 1
        if not (use_pass_throughs and alone and sigma_m < 0.7 * span_m):
            return None
        evidence, expected = posterior(missed, prior, 0.0, 0.0, 3.0 * sigma_m, p_0, WIDTH * span_m, True, mean, after)
        x, P = condition(scan_pass.x, scan_pass.P, H, mean, after)
        return PassUpdate(x, P, max(evidence, -1.0), 0, expected, len(missed), scan_pass.start_ns)
    hits = pulses[rows]
    hits[:, KIND] = HIT
    a, b = float(hits[:, A].mean()), float(hits[:, B].mean())
    half_m = max(0.6 * span_m, 0.6 * math.hypot(a, b) + 0.3 * span_m)
    used = np.concatenate([hits, missed])
    evidence, expected = posterior(used, prior, a, b, half_m, p_0, WIDTH * span_m, use_pass_throughs, mean, after)
    x, sideways = condition(scan_pass.x, scan_pass.P, H, mean, after)
    depth_m = float(np.median(hits[:, DEPTH])) + hull_offset_m
    noise_m = math.sqrt((RANGE_NOISE * span_m) ** 2 / len(hits) + RANGE_FLOOR_M**2)
    along_m = depth_m - float(scan_pass.line @ (x[:3] - scan_pass.x[:3]))
    x, both = measured(x, sideways, scan_pass.line, along_m, noise_m)
    return_ns = scan_pass.start_ns + round(float(hits[:, WHEN_S].mean()) * 1e9)
    return PassUpdate(x, both, min(evidence, 3.0), len(hits), expected, len(missed), return_ns)


def drone_returns(pulses: Array64, span_m: float, sigma_m: float) -> NDArray[np.intp] | None:
    """Which of a look's pulses (n, COLUMNS) are the drone's returns: rows, or None when none are.

    The densest group of the drone's size, near the prediction rather than far; none when more stands right beside it:
    then the returns are those of something bigger. What is seen through a gap has to be where a drone nearly always is.
    """
    rows = np.nonzero((pulses[:, KIND] == HIT) | (pulses[:, KIND] == GLIMPSE))[0]
    if len(rows) == 0:
        return None
    place = pulses[rows][:, [A, B, DEPTH]]
    variance_m2 = sigma_m**2 + (span_m * OFF_SPAN) ** 2
    if len(rows) > MAX_ROWS:  # a wall: what is nearest to the prediction will do
        rows = rows[np.argsort(np.sum(place**2, axis=1), kind="stable")[:MAX_ROWS]]
        place = pulses[rows][:, [A, B, DEPTH]]
    apart = np.linalg.norm(place[:, None] - place[None], axis=2)
    near = apart <= 0.5 * span_m
    score = np.log(near.sum(axis=1)) - 0.5 * np.sum(place**2 / variance_m2, axis=1)
    best = int(score.argmax())
    glimpsed = (pulses[rows[near[best]], KIND] == GLIMPSE).all()
    if score[best] < (MIN_GLIMPSE_SCORE if glimpsed else MIN_SCORE):
        return None
    centre = place[near[best]].mean(axis=0)
    away = np.linalg.norm(place - centre, axis=1)
    group = away <= 0.6 * span_m
    beside = (away > 0.9 * span_m) & (away < 2.0)
    if beside.sum() > max(2, int(group.sum())):
        return None
    return rows[group]
