"""Log-odds that a candidate is a drone, against four alternatives, with the reasons as text.

    false return   rain, dust, a wrong return    it is not observed again at the next scan pass
    static         lamp, wire, tree, roof edge   something is next to it, it returns few pulses, it does not move
    bird                                         it is fast, or turns hard
    balloon                                      it is smooth and round

Where the drone sends telemetry, the comparison of its motion with the candidate's decides against static objects, birds
and balloons
(stages/detect/motion_log_ratios.py).

    log-odds of a drone = -ln sum_k exp(-o_k),     o_k = log-odds of a drone over alternative k

Without telemetry the result is scaled by a weight and shifted by an offset. Above `calibration_knee` only a share of
the excess counts. Every o_k is a prior and a sum of log likelihood ratios, capped where scan passes repeat the same
evidence. Drops, insects and birds are smaller than a drone and return pulses at close range only, so the priors of
false returns and birds depend on the range.

The weights are set by hand and adjusted on simulated flights. The priors and the calibration are fitted, so that the
probability equals the frequency with which a candidate is a drone; `docs/RESULTS.md` reports how well it does.

Source: ours; weight and offset after Platt, Advances in Large Margin Classifiers (1999); DESIGN, "a small cluster with
*measured* emptiness around it, evaluated as data arrives".
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from flow.stage import StrictModel
from stages.detect.candidate import (
    OPEN_NEIGHBOUR_SCORE,
    SINGLE_RETURN_WIRE_M,
    WIRE_M,
    Alternative,
    Candidate,
    over_visible_support,
)
from stages.kernels.detect.isolation import SECTORS
from stages.kernels.detect.motion_log_ratios import SWAY_M
from stages.sums import sum_in_order

MOVED_NATS = 3.0  # telemetry log ratio above which the candidate has moved; without displacement it is the cap
ALTERNATIVE_LOG_ODDS = 2.3  # below this the reason names the most probable alternative

# log ratio drone over bird of the speed it reaches
FLIGHT_MPS = (0.0, 2.0, 4.0, 6.0, 9.0, 12.0)
FLIGHT_NATS = (1.0, 1.0, 0.0, -2.0, -4.0, -7.0)


class ClassifierWeights(StrictModel):
    """Log likelihood ratios [nats] of a drone over an alternative, for each kind of evidence, and their caps."""

    # over false returns
    small_m: float = 14.0  # to this range false returns and birds return as many pulses as drones; few beyond unseen_m
    false_return: float = -7.4  # prior at close range: one in 1600 single observations is repeated,
    false_return_far: float = 0.7  # and far away two of three
    false_return_no_telemetry: float = -5.0  # prior at any range, without telemetry
    first_return: float = 1.0  # each return of the first scan pass, at most 4
    further_pass: float = 4.0  # each further scan pass with a return, to wire_m,
    further_pass_far: float = 2.5  # and beyond unseen_m, where chance repetitions are more frequent
    pass_through: float = 0.25  # each pulse that passed through the middle
    far_m: float = 35.0  # beyond this range a drone becomes less probable,
    far: float = 0.15  # by this much a metre

    # over static objects
    clutter: float = -6.0  # prior, assumed: one of 400 short objects above the horizon hovers freely
    free_sector: float = 0.6  # each of the eight sectors that pulses flew through
    neighbour: float = -3.0  # each recent scan pass with an object in a sector
    max_neighbour: float = 12.0
    max_neighbour_flown: float = 4.0  # cap for a candidate that flew in open air before, by telemetry
    isolated: float = 0.3  # each scan pass without a neighbour, at most max_isolated
    isolated_near: float = 0.7  # in addition to near_m, where a wire or pole returns pulses in each scan pass,
    near_m: float = 10.0
    not_near_m: float = 16.0  # falling to 0 at this range
    max_isolated: float = 2.0
    max_isolated_near: float = 3.0  # additional cap at close range, where a wire would return pulses
    wire_m: float = WIRE_M  # a wire returns pulses to this range,
    unseen_m: float = SINGLE_RETURN_WIRE_M  # and none beyond this one
    max_single: float = 6.0  # cap of single returns: a wire gives little else
    max_multiple: float = 2.0  # cap of several returns
    near_large: float = 8.0  # penalty: a wall, crown or trunk is near, and the candidate has not moved away
    spread: float = 3.0  # penalty: its observations scatter about a straight path by more than a drone's size
    too_long: float = 1.5  # penalty of each scan pass with returns longer than a drone, at most 4
    moves: float = 5.0  # it moved
    hover: float = 1.8  # penalty: it did not move, at a range at which its support may be invisible;
    hover_m: float = 28.0  # beyond this range a hovering drone and a lamp are indistinguishable,
    max_hover: float = 3.3  # so the log-odds are limited to this
    static: float = 0.12  # each scan pass on a candidate that did not move, to max_static: a lamp's pole shows earlier
    max_static: float = 1.5
    near_rejected: float = 2.0  # penalty: something was rejected near it recently (wires are long)
    revisited: float = 4.0  # further penalty: at the same position, while the drone reports that it flies

    # calibration
    no_telemetry_weight: float = 0.76  # without telemetry: factor and
    no_telemetry_offset: float = -0.37  # offset of the log-odds
    # above these log-odds (73 %) a drone is less frequent than independent evidence implies,
    calibration_knee: float = 1.0
    calibration_slope: float = 0.72  # because scan passes err together: this share of the excess counts
    reacquired: float = 3.0  # penalty of a reacquisition by chance, divided by the scan passes since

    # over birds
    bird: float = -0.5  # prior without telemetry
    calm: float = 8.0  # each second in which a bird would have shown its speed or turn
    steady: float = 3.0  # each second of straight flight after the first
    max_calm: float = 8.0
    flew_as_bird: float = 10.0  # penalty: it flew as only birds do, once
    bird_speed_mps: float = 9.0  # faster than any supported drone
    bird_acceleration_mps2: float = 6.0

    bird_telemetry: float = -3.2  # prior with telemetry: one drone among two dozen birds at close range,
    bird_telemetry_far: float = -1.2  # and among three far away
    telemetry_weight: float = 0.9  # factor of the telemetry's log ratios: observations err together
    max_telemetry: float = 8.0
    min_telemetry: float = -12.0

    # over balloons
    balloon: float = 2.2  # prior with telemetry
    balloon_no_telemetry: float = 5.0  # and without
    round_chord: float = 2.0  # penalty of each chord that bulges smoothly: nine in ten of a balloon, half of a drone
    rough_chord: float = 2.4  # each chord with five or more returns that does not
    max_chords: float = 8.0  # chords that count: further ones show the same side of the same object


class ClutterOdds(NamedTuple):
    """Log-odds of a drone over a static object, with their reasons."""

    log_odds: float
    remarks: list[str]
    kinds: list[str]  # of the reasons against a drone, without numbers


def classify(c: Candidate, weights: ClassifierWeights, free_space: bool, motion_known: bool) -> tuple[float, str]:
    """Log-odds that the candidate is a drone, and the reasons as text.

    Sets `c.alternative` to the most probable alternative and `c.rejection` to the reasons against a drone.

    `free_space` False ignores the measured surroundings. `motion_known`: the vehicle's motion is known.
    """
    e = weights
    clutter = over_clutter(c, e, free_space, motion_known)
    over = {
        Alternative.FALSE_RETURN: over_false_return(c, e),
        Alternative.STATIC: clutter.log_odds,
        Alternative.BIRD: over_bird(c, e),
        Alternative.BALLOON: over_balloon(c, e),
    }
    c.alternative = min(over, key=lambda alternative: over[alternative])
    c.rejection = ", ".join([c.alternative.value, *clutter.kinds])
    shift = over[c.alternative]
    log_odds = shift - math.log(sum_in_order([math.exp(shift - value) for value in over.values()]))
    if c.reacquired_at:
        log_odds -= e.reacquired / (c.scan_passes - c.reacquired_at)
    if c.log_ratios is None:
        log_odds = e.no_telemetry_weight * log_odds + e.no_telemetry_offset
    log_odds = calibrated(log_odds, e)
    remarks = [f"{c.scan_passes} scan passes, {c.returns} returns", *clutter.remarks, *motion_remarks(c, e)]
    if log_odds < ALTERNATIVE_LOG_ODDS:
        remarks.append(f"if not a drone: {c.alternative.value}")
    return log_odds, "; ".join(remarks)


def motion_remarks(c: Candidate, e: ClassifierWeights) -> list[str]:
    """What the candidate's motion contributes to the reasons."""
    remarks: list[str] = []
    if c.reacquired_at:
        remarks.append("reacquired where the drone's odometry predicts it")
    if c.motion is not None:
        remarks.append(f"{c.motion.speed_mps:.1f} +- {c.motion.speed_sigma_mps:.1f} m/s")
    if c.log_ratios is not None and c.log_ratios.denied:
        remarks.append("its path contradicts the drone's odometry")
    elif c.log_ratios is not None and max(c.log_ratios[:3]) > MOVED_NATS:
        agrees = c.log_ratios.displacement_m > c.apparent_motion_m
        short = f"the drone's odometry moved {c.log_ratios.displacement_m:.1f} m only"
        remarks.append("its path agrees with the drone's odometry" if agrees else short)
    elif c.log_ratios is None and flew_as_bird(c, e):
        remarks.append("it flew as a bird")
    return remarks


def calibrated(log_odds: float, e: ClassifierWeights) -> float:
    """Calibrated log-odds: the excess over `calibration_knee` counts by its share `calibration_slope` only."""
    return (
        log_odds
        if log_odds < e.calibration_knee
        else e.calibration_knee + e.calibration_slope * (log_odds - e.calibration_knee)
    )


def over_false_return(c: Candidate, e: ClassifierWeights) -> float:
    """Log-odds of a drone over rain, dust or a wrong return, which is not observed again."""
    further_pass = e.further_pass_far + (e.further_pass - e.further_pass_far) * nearness(c, e)
    prior = (
        e.false_return_no_telemetry
        if c.log_ratios is None
        else e.false_return_far + (e.false_return - e.false_return_far) * smallness(c, e)
    )
    log_odds = (
        prior
        + e.first_return * min(c.first_returns, 4)
        + further_pass * (c.scan_passes - 1)
        - e.pass_through * c.missed_returns
    )
    return min(log_odds, 10.0) - e.far * max(c.range_m - e.far_m, 0.0)


def over_clutter(c: Candidate, e: ClassifierWeights, free_space: bool, motion_known: bool) -> ClutterOdds:
    """Log-odds of a drone over a lamp, wire, leaf or edge."""
    remarks: list[str] = []
    kinds: list[str] = []
    log_odds = e.clutter
    flew = c.log_ratios is not None and e.telemetry_weight * c.flight_log_ratio > MOVED_NATS
    if free_space:
        free = sum([passes >= 1.0 for passes in c.free.tolist()])
        neighbour = max(e.neighbour * c.neighbour_score, -(e.max_neighbour_flown if flew else e.max_neighbour))
        isolated = min(isolated_weight(c, e) * c.isolated_score, max_isolated_nats(c, e))
        log_odds += e.free_sector * free + neighbour + isolated
        remarks.append(f"{free} of {SECTORS} sectors around it free")
        if c.neighbour_score > OPEN_NEIGHBOUR_SCORE:
            kinds.append("an object next to it" + (", reached by flight through open air" if flew else ""))
            remarks.append(kinds[-1])
    few = min(max(c.return_count_nats, -e.max_single), e.max_multiple)
    log_odds += few - e.too_long * min(c.too_long_passes, 4)
    if c.returns_singly:
        remarks.append("single returns")
    if c.too_long_passes:
        kinds.append("longer than a drone")
        remarks.append(kinds[-1])
    if c.log_ratios is not None:
        nats = over_visible_support(c, c.log_ratios, e.wire_m, e.unseen_m)
        displaced = c.log_ratios.displacement_m > c.apparent_motion_m
        nats = max(telemetry_nats(nats, e, displaced), telemetry_nats(c.flight_log_ratio, e))
        moved = nats > MOVED_NATS
        log_odds += nats
    else:
        moved = c.moves(motion_known)
        log_odds += e.moves if moved else 0.0
    if not moved:
        log_odds += min(e.static * c.scan_passes, e.max_static)
        if c.log_ratios is not None:
            log_odds -= e.hover * (1.0 - nearness(c, e))
        remarks.append("it may be static")
        if c.near_rejected:
            log_odds -= e.near_rejected + (e.revisited if c.revisited else 0.0)
            kinds.append("an object near it was rejected")
            remarks.append(kinds[-1])
    if c.large_object_passes > 0.3 * c.scan_passes and not moved:
        log_odds -= e.near_large
        kinds.append("next to a large object")
        distance = f" {c.large_object_m:.1f} m away" if math.isfinite(c.large_object_m) else ""
        remarks.append(kinds[-1] + distance)
    if c.motion is not None and c.motion.spread_m > 0.35 and len(c.path_ns) > 3:
        log_odds -= e.spread
        remarks.append(f"scattered over {c.motion.spread_m:.1f} m")
    if c.log_ratios is not None and not moved and c.range_m > e.hover_m:
        log_odds = min(log_odds, e.max_hover)
    return ClutterOdds(log_odds, remarks, kinds)


def isolated_weight(c: Candidate, e: ClassifierWeights) -> float:
    """Weight [nats] of one scan pass without a neighbour."""
    return e.isolated + e.isolated_near * share_at(c.range_m, e.near_m, e.not_near_m)


def max_isolated_nats(c: Candidate, e: ClassifierWeights) -> float:
    """Cap [nats] of scan passes without a neighbour: higher where a wire would show and all sectors were crossed."""
    crossed = min(max((min(c.free.tolist()) - 2.0) / 6.0, 0.0), 1.0)
    return e.max_isolated + e.max_isolated_near * crossed * nearness(c, e)


def nearness(c: Candidate, e: ClassifierWeights) -> float:
    """1 at ranges at which a wire is visible, falling to 0 where it is not."""
    return share_at(c.range_m, e.wire_m, e.unseen_m)


def smallness(c: Candidate, e: ClassifierWeights) -> float:
    """1 at ranges at which objects smaller than a drone return pulses, falling to 0 where hardly any does."""
    return share_at(c.range_m, e.small_m, e.unseen_m)


def share_at(range_m: float, full_m: float, none_m: float) -> float:
    """1 up to full_m, falling linearly to 0 at none_m."""
    return min(max((none_m - range_m) / max(none_m - full_m, 1e-9), 0.0), 1.0)


def over_bird(c: Candidate, e: ClassifierWeights) -> float:
    """Log-odds of a drone over a bird."""
    if c.log_ratios is not None:
        prior = e.bird_telemetry_far + (e.bird_telemetry - e.bird_telemetry_far) * smallness(c, e)
        return prior + telemetry_nats(c.log_ratios.over_bird, e)
    log_odds = e.bird + min(e.calm * c.calm_s + e.steady * max(c.steady_s - 1.0, 0.0), e.max_calm)
    motion = c.slower_motion
    if motion is not None:
        flight = float(np.interp(motion.top_mps, FLIGHT_MPS, FLIGHT_NATS))
        log_odds += flight / (1.0 + (motion.top_sigma_mps / 4.0) ** 2)
    return log_odds - (e.flew_as_bird if flew_as_bird(c, e) else 0.0)


def over_balloon(c: Candidate, e: ClassifierWeights) -> float:
    """Log-odds of a drone over a balloon."""
    round_ = e.round_chord * c.round_chords - e.rough_chord * c.rough_chords
    if round_ > 0.0:
        round_ *= min(e.max_chords / (c.round_chords + c.rough_chords), 1.0)
    if c.log_ratios is None:
        return e.balloon_no_telemetry - round_
    displaced = c.log_ratios.displacement_m > SWAY_M  # a balloon on its string swings as far
    return e.balloon - round_ + telemetry_nats(c.log_ratios.over_balloon, e, displaced)


def telemetry_nats(nats: float, e: ClassifierWeights, displaced: bool = True) -> float:
    """Weighted and limited log ratio of telemetry; limited to MOVED_NATS unless the drone was displaced enough."""
    return min(
        max(e.telemetry_weight * nats, e.min_telemetry),
        e.max_telemetry if displaced else min(e.max_telemetry, MOVED_NATS),
    )


def flew_as_bird(c: Candidate, e: ClassifierWeights) -> bool:
    """Whether it was once significantly faster, or turned harder, than a supported drone."""
    return c.fastest_mps > e.bird_speed_mps or c.hardest_mps2 > e.bird_acceleration_mps2
