"""Evaluation of one scan pass: the pulses near a track during one passing of the rotor update its state.

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
from stages.kernels.track.hull import (
    DELAY_S,
    DEPTH,
    GAP_RETURN,
    KIND,
    OCCLUDED,
    PASS_THROUGH,
    RETURN,
    A,
    B,
    collect,
    posterior,
)
from stages.kernels.track.runs import mask_walls
from stages.kernels.track.scan_pass import largest_sigma_m, line_of_sight
from stages.messages import SweptPulses
from stages.track.hull import COLUMNS, WIDTH, across
from stages.track.kalman import condition, measured

Pose = tuple[Array64, Array64]  # R (3, 3), t (3,)

MAX_OFFSET_M = 6.0  # from the prediction, of collected pulses
RANGE_NOISE = 0.1  # one sigma of a return's depth about the drone's centre, over the span
RANGE_FLOOR_M = 0.02
MAX_ROWS = 256
OFF_SPAN = np.array([0.3, 0.3, 0.2])  # a, b, depth: spread of returns about the drone's centre, over the span
MIN_SCORE = -6.0  # of a group of returns; those of simulated drones are above -4.8
MIN_GAP_SCORE = -1.5  # of a group of gap returns; 99 % of the groups of simulated drones are above it


@dataclass(slots=True, eq=False)
class ScanPass:
    """Pulses of one passing of the rotor, and the predicted state that they are measured from."""

    start_ns: int
    last_ns: int  # newest of its pulses
    x: Array64  # (6,) predicted at start_ns, frame map
    P: Array64
    line: Array64  # unit line of sight, frame map
    gate_m: float  # pulses within it are evaluated; those farther out only reveal walls
    parts: list[Array64] = field(default_factory=lambda: list[Array64]())

    @property
    def sigma_m(self) -> float:
        """Largest sigma of the predicted position."""
        return largest_sigma_m(self.P)


class PassUpdate(NamedTuple):
    """Result of a scan pass."""

    x: Array64  # state at the start of the scan pass
    P: Array64
    log_likelihood_ratio: float  # of a drone over nothing
    hits: int  # returns
    expected: float  # expected number of returns
    other_pulses: int  # pass-throughs and occluded pulses
    return_ns: int  # mean time of the returns; the start of the scan pass when there are none


def collect_into(
    scan_pass: ScanPass | None,
    pulses: SweptPulses,
    ends: tuple[Pose, Pose],
    cone: tuple[Array64, float],
    x: Array64,
    P: Array64,
    span_m: float,
    de_skew: bool,
) -> ScanPass | None:
    """The scan pass with this slice's pulses near the drone added; a new one if it was None; None without pulses.

    `ends` are T_map_vehicle at the slice's first and last pulse, `cone` axis and half angle of its directions; x, P the
    state predicted at the pass's start. In the vehicle frame the drone moves linearly within the slice.
    """
    origin = np.array(pulses.origin_vehicle_m)
    start_ns = pulses.stamp_ns if scan_pass is None else scan_pass.start_ns
    after_s = (pulses.stamp_ns - start_ns) * 1e-9 if de_skew else 0.0
    span_s = int(pulses.point_stamp_ns[-1] - pulses.stamp_ns) * 1e-9 if de_skew else 0.0
    sigma_m = largest_sigma_m(P)
    gate_m = min(0.6 * span_m + 3.0 * sigma_m, MAX_OFFSET_M)
    reach_m = gate_m + LONGEST * span_m
    away, velocity, R, here = line_of_sight(*ends[0], *ends[1], origin, x, after_s, span_s, *cone, reach_m)
    if not here:
        return scan_pass
    line = R @ away / math.sqrt(away @ away) if scan_pass is None else scan_pass.line
    found = np.empty((pulses.range_m.size, COLUMNS))
    count = collect(
        pulses.point_stamp_ns,
        pulses.direction_vehicle,
        pulses.range_m,
        pulses.laser,
        origin,
        away + origin,
        velocity,
        start_ns,
        reach_m,
        0.5 + 3.0 * sigma_m,
        R.T @ line,
        across(line) @ R,  # horizontal in frame map, as in `evaluate`
        found,
    )
    if count == 0:
        return scan_pass
    if scan_pass is None:
        scan_pass = ScanPass(start_ns, start_ns, x, P, line, gate_m)
    scan_pass.parts.append(found[:count])
    scan_pass.last_ns = start_ns + round(float(found[count - 1, DELAY_S]) * 1e9)
    return scan_pass


def evaluate(
    scan_pass: ScanPass, span_m: float, hull_offset_m: float, p_0: float, use_pass_throughs: bool, own_sigma_m: float
) -> PassUpdate | None:
    """The track's state after a scan pass; None when the scan pass has no information.

    Returns are ignored if the predicted position's sigma exceeds own_sigma_m: they may come from any object, so that
    the detector has to classify them.
    """
    pulses, sigma_m = np.concatenate(scan_pass.parts), scan_pass.sigma_m
    mask_walls(pulses, span_m)
    pulses = pulses[np.hypot(pulses[:, A], pulses[:, B]) <= scan_pass.gate_m]
    others = pulses[(pulses[:, KIND] == PASS_THROUGH) | (pulses[:, KIND] == OCCLUDED)]
    H = across(scan_pass.line)
    prior = H @ scan_pass.P[:3, :3] @ H.T
    mean, after = np.zeros(2), np.zeros((2, 2))
    rows = drone_returns(pulses, span_m, sigma_m) if sigma_m < own_sigma_m else None
    if rows is None:
        only_others = len(others) == len(pulses) > 1
        if not (use_pass_throughs and only_others and sigma_m < 0.7 * span_m):
            return None
        ratio, expected = posterior(others, prior, 0.0, 0.0, 3.0 * sigma_m, p_0, WIDTH * span_m, True, mean, after)
        x, P = condition(scan_pass.x, scan_pass.P, H, mean, after)
        return PassUpdate(x, P, max(ratio, -1.0), 0, expected, len(others), scan_pass.start_ns)
    hits = pulses[rows]
    hits[:, KIND] = RETURN
    a, b = float(hits[:, A].mean()), float(hits[:, B].mean())
    half_m = max(0.6 * span_m, 0.6 * math.hypot(a, b) + 0.3 * span_m)
    used = np.concatenate([hits, others])
    ratio, expected = posterior(used, prior, a, b, half_m, p_0, WIDTH * span_m, use_pass_throughs, mean, after)
    x, P_across = condition(scan_pass.x, scan_pass.P, H, mean, after)
    depth_m = float(np.median(hits[:, DEPTH])) + hull_offset_m
    noise_m = math.sqrt((RANGE_NOISE * span_m) ** 2 / len(hits) + RANGE_FLOOR_M**2)
    residual_m = depth_m - float(scan_pass.line @ (x[:3] - scan_pass.x[:3]))
    x, P_after = measured(x, P_across, scan_pass.line, residual_m, noise_m)
    return_ns = scan_pass.start_ns + round(float(hits[:, DELAY_S].mean()) * 1e9)
    return PassUpdate(x, P_after, min(ratio, 3.0), len(hits), expected, len(others), return_ns)


def drone_returns(pulses: Array64, span_m: float, sigma_m: float) -> NDArray[np.intp] | None:
    """Rows of the drone's returns among a scan pass's pulses (n, COLUMNS), or None when there are none.

    They are the densest group of the drone's size, with a penalty for the distance from the prediction. A group with
    more returns right next to it belongs to a larger object. Gap returns need a smaller distance from the prediction.
    """
    rows = np.nonzero((pulses[:, KIND] == RETURN) | (pulses[:, KIND] == GAP_RETURN))[0]
    if len(rows) == 0:
        return None
    position_m = pulses[rows][:, [A, B, DEPTH]]
    variance_m2 = sigma_m**2 + (span_m * OFF_SPAN) ** 2
    if len(rows) > MAX_ROWS:  # a wall: the returns nearest to the prediction suffice
        rows = rows[np.argsort(np.sum(position_m**2, axis=1), kind="stable")[:MAX_ROWS]]
        position_m = pulses[rows][:, [A, B, DEPTH]]
    distance_m = np.linalg.norm(position_m[:, None] - position_m[None], axis=2)
    near = distance_m <= 0.5 * span_m
    score = np.log(near.sum(axis=1)) - 0.5 * np.sum(position_m**2 / variance_m2, axis=1)
    best = int(score.argmax())
    all_in_gap = (pulses[rows[near[best]], KIND] == GAP_RETURN).all()
    if score[best] < (MIN_GAP_SCORE if all_in_gap else MIN_SCORE):
        return None
    centre = position_m[near[best]].mean(axis=0)
    away_m = np.linalg.norm(position_m - centre, axis=1)
    group = away_m <= 0.6 * span_m
    adjacent = (away_m > 0.9 * span_m) & (away_m < 2.0)
    if adjacent.sum() > max(2, int(group.sum())):
        return None
    return rows[group]
