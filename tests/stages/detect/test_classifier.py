"""The classifier: weights and caps of telemetry and of each kind of evidence, and the reasons."""

from __future__ import annotations

import math

import numpy as np
import pytest

from links.evaluation.stage_metrics import PROBABILITY_EDGES
from stages.detect import EvidenceDetect
from stages.detect.candidate import Alternative
from stages.detect.candidate_messages import log_odds_of
from stages.detect.classifier import (
    MOVED_NATS,
    ClassifierWeights,
    calibrated,
    classify,
    isolated_weight,
    max_isolated_nats,
    over_balloon,
    over_bird,
    over_clutter,
    over_false_return,
    telemetry_nats,
)
from stages.detect.motion_log_ratios import MotionLogRatios
from stages.kernels.detect.isolation import SECTORS
from tests.stages.detect.test_candidate import candidate, observation, path

E = ClassifierWeights()
FAR_M = 9.0


def log_ratios_of(*nats, displacement_m=FAR_M):
    """Log ratios over static, bird, balloon and wire, for a drone of this displacement."""
    return MotionLogRatios(*nats, misfit=0.0, displacement_m=displacement_m)


NO_EVIDENCE = log_ratios_of(0.0, 0.0, 0.0, 0.0)


def hovering(log_ratios=None, range_m=20.0):
    made = candidate(*(observation(0.1 * k, range_m=range_m) for k in range(12)))
    made.log_ratios = log_ratios
    return made


@pytest.mark.parametrize(
    ("log_ratio", "counts"),
    [(0.0, 0.0), (5.0, 4.5), (-10.0, -9.0), (100.0, E.max_telemetry), (-100.0, E.min_telemetry)],
)
def test_telemetry_log_ratios_are_weighted_and_capped(log_ratio, counts):
    assert telemetry_nats(log_ratio, E) == pytest.approx(counts)


def test_over_a_bird_telemetry_replaces_the_path():
    calm = hovering()
    assert over_bird(calm, E) > 3.0  # it hovered for a second
    calm.log_ratios = log_ratios_of(0.0, 2.0, 0.0, 0.0)
    fast = candidate(*path((14.0, 0.0, 0.0)))
    fast.log_ratios = log_ratios_of(0.0, 2.0, 0.0, 0.0)
    assert over_bird(fast, E) == pytest.approx(over_bird(calm, E))


def test_at_long_range_birds_and_false_returns_are_less_likely():
    ranges_m = (5.0, E.small_m, 0.5 * (E.small_m + E.unseen_m), E.unseen_m, 50.0)
    log_ratio = [
        over_bird(hovering(log_ratios_of(0.0, 2.0, 0.0, 0.0), range_m=r), E) - E.telemetry_weight * 2.0
        for r in ranges_m
    ]
    between = 0.5 * (E.bird_telemetry + E.bird_telemetry_far)
    assert log_ratio == pytest.approx(
        [E.bird_telemetry, E.bird_telemetry, between, E.bird_telemetry_far, E.bird_telemetry_far]
    )
    once = [candidate(observation(0.0, returns=2, range_m=r)) for r in ranges_m]
    for c in once:
        c.log_ratios = NO_EVIDENCE
    far = E.far * (50.0 - E.far_m)
    between = 0.5 * (E.false_return + E.false_return_far)
    priors = [E.false_return, E.false_return, between, E.false_return_far, E.false_return_far - far]
    assert [over_false_return(c, E) for c in once] == pytest.approx([p + 2 * E.first_return for p in priors])
    for c in once:
        c.log_ratios = None  # without telemetry: the priors were fitted with it
    assert [over_false_return(c, E) for c in once[:4]] == pytest.approx(
        [E.false_return_no_telemetry + 2 * E.first_return] * 4
    )


def test_a_hovering_candidate_is_less_probable_where_its_support_would_be_invisible():
    plain = E.model_copy(update={"hover": 0.0})
    for range_m, share in ((15.0, 0.0), (25.0, 0.5), (30.0, 1.0)):
        still, flew = hovering(NO_EVIDENCE, range_m), hovering(log_ratios_of(20.0, 20.0, 20.0, 20.0), range_m)
        log_odds = [over_clutter(still, e, True, True)[0] for e in (E, plain)]
        assert log_odds[1] - log_odds[0] == pytest.approx(share * E.hover)
        assert over_clutter(flew, E, True, True) == over_clutter(flew, plain, True, True)


def test_beyond_28_m_a_hovering_candidate_is_not_accepted_and_one_that_flew_is():
    for range_m, still_accepted in ((20.0, True), (27.0, True), (29.0, False), (31.0, False)):
        for log_ratio, moves in ((NO_EVIDENCE, False), (log_ratios_of(20.0, 20.0, 20.0, 20.0), True)):
            c = hovering(log_ratio, range_m)
            c.isolated_score, c.free, c.return_count_nats = 30.0, np.full(SECTORS, 12.0), 30.0
            c.rough_chords = 5
            confident = E.model_copy(update={"clutter": 0.0, "bird_telemetry_far": 9.0, "bird_telemetry": 9.0})
            log_odds, reason = classify(c, confident, True, True)
            assert ("it may be static" in reason) != moves
            accepted = log_odds >= log_odds_of(EvidenceDetect.settings_type.model_fields["accept_probability"].default)
            assert accepted == (moves or still_accepted), (range_m, log_ratio, log_odds)


def test_over_a_balloon_telemetry_is_added_to_the_roundness():
    c = hovering()
    c.round_chords = 2
    assert over_balloon(c, E) == pytest.approx(E.balloon_no_telemetry - 2 * E.round_chord)
    c.log_ratios = log_ratios_of(0.0, 0.0, -3.0, 0.0)
    assert over_balloon(c, E) == pytest.approx(E.balloon - 2 * E.round_chord - 3.0 * E.telemetry_weight)
    for displacement_m, counts in (
        (2.0, E.max_telemetry),
        (0.5, 3.0),
    ):  # a balloon on a string swings as far as a hovering drone
        c.log_ratios = log_ratios_of(0.0, 0.0, 9.0, 0.0, displacement_m=displacement_m)
        assert over_balloon(c, E) == pytest.approx(E.balloon - 2 * E.round_chord + counts)


def test_the_number_of_counted_chords_is_capped():
    """More chords of the same sides are no more evidence: 12 round ones of 21."""
    for times in (1, 2, 10):
        c = hovering()
        c.round_chords, c.rough_chords = 12 * times, 9 * times
        assert over_balloon(c, E) == pytest.approx(
            E.balloon_no_telemetry - (12 * E.round_chord - 9 * E.rough_chord) * E.max_chords / 21
        )
        assert over_balloon(c, E) > 3.0
        c.round_chords, c.rough_chords = 11 * times, 3 * times  # a balloon
        assert over_balloon(c, E) < -3.0
        c.round_chords, c.rough_chords = 5 * times, 15 * times
        assert over_balloon(c, E) == pytest.approx(
            E.balloon_no_telemetry + times * (15 * E.rough_chord - 5 * E.round_chord)
        )


def test_an_isolated_scan_pass_counts_more_at_close_range():
    near, between, far = (hovering(range_m=range_m) for range_m in (8.0, 13.0, 20.0))
    assert isolated_weight(near, E) == pytest.approx(E.isolated + E.isolated_near)
    assert isolated_weight(between, E) == pytest.approx(E.isolated + 0.5 * E.isolated_near)
    assert isolated_weight(far, E) == E.isolated
    plain = E.model_copy(update={"isolated_near": 0.0})
    for c in (near, far):
        c.isolated_score, c.free = 3.0, np.full(SECTORS, 12.0)
    assert over_clutter(near, E, True, True)[0] - over_clutter(near, plain, True, True)[0] == pytest.approx(3 * 0.7)
    assert over_clutter(far, E, True, True)[0] == over_clutter(far, plain, True, True)[0]


@pytest.mark.parametrize(
    ("range_m", "scan_pass"),
    [(15.0, E.further_pass), (25.0, 0.5 * (E.further_pass + E.further_pass_far)), (30.0, E.further_pass_far)],
)
def test_a_further_scan_pass_counts_less_against_a_false_return_at_long_range(range_m, scan_pass):
    once, twice = (candidate(*(observation(0.1 * k, range_m=range_m) for k in range(n))) for n in (1, 2))
    assert over_false_return(twice, E) - over_false_return(once, E) == pytest.approx(scan_pass)
    assert E.further_pass_far < E.further_pass


@pytest.mark.parametrize(
    ("range_m", "displacement_m", "went"),
    [(20.0, 0.3, True), (26.5, 0.6, False), (26.5, 0.9, True), (31.0, 1.2, False), (31.0, 2.0, True)],
)
def test_a_displacement_smaller_than_a_lamp_is_no_motion(range_m, displacement_m, went):
    """A lamp at 31 m, whose scattered observations match the motion of a drone that hovers at another position."""
    c = hovering(log_ratios_of(20.0, 20.0, 20.0, 20.0, displacement_m=displacement_m), range_m=range_m)
    assert ("it may be static" in over_clutter(c, E, True, True)[1]) != went
    c.neighbour_score = 0.0
    c.add_log_ratios(c.log_ratios)
    assert (c.flight_log_ratio > 0.0) == went
    near = hovering(log_ratios_of(20.0, 20.0, 20.0, 20.0, displacement_m=0.6), range_m=9.0)
    assert "it may be static" not in over_clutter(near, E, True, True)[1]


@pytest.mark.parametrize(
    ("range_m", "returns", "displacement_m", "went"),
    [(12.0, 1, 0.6, False), (12.0, 1, 2.0, True), (12.0, 5, 0.6, True), (20.0, 1, 0.6, True)],
)
def test_single_returns_along_a_wire_are_no_motion(range_m, returns, displacement_m, went):
    """Wires at 12 to 14 m, whose observations match the motion of a drone that hovers 40 m away."""
    c = candidate(*(observation(0.1 * k, returns=returns, range_m=range_m) for k in range(12)))
    c.add_log_ratios(log_ratios_of(20.0, 20.0, 20.0, 20.0, displacement_m=displacement_m))
    assert ("it may be static" in over_clutter(c, E, True, True)[1]) != went
    assert (c.flight_log_ratio > 0.0) == went


@pytest.mark.parametrize("log_ratio", [0.0, 0.59, 0.9, 1.29])
def test_telemetry_of_a_hovering_drone_is_no_motion(log_ratio):
    e = E.model_copy(update={"log_ratio": log_ratio})
    c = hovering(log_ratios_of(20.0, 20.0, 20.0, 20.0, displacement_m=0.6), range_m=31.0)
    assert "it may be static" in over_clutter(c, e, True, True)[1]
    assert over_balloon(c, e) <= e.balloon + MOVED_NATS
    remarks = classify(c, e, True, True)[1]
    assert "its path agrees with the drone's odometry" not in remarks
    assert "the drone's odometry moved 0.6 m only" in remarks


def test_over_static_objects_telemetry_replaces_the_motion_term():
    silent, nothing, flew = hovering(), hovering(NO_EVIDENCE), hovering(log_ratios_of(20.0, 0.0, 0.0, 20.0))
    (log_odds, remarks, _), (same, same_remarks, _), (more, more_remarks, _) = (
        over_clutter(c, E, False, True) for c in (silent, nothing, flew)
    )
    assert same == pytest.approx(log_odds)
    assert remarks == same_remarks
    assert "it may be static" in remarks
    assert "it may be static" not in more_remarks
    assert more == pytest.approx(log_odds - E.static * 12 + E.max_telemetry)
    moved = candidate(*path((2.0, 0.0, 0.0), count=12))
    silently, *_ = over_clutter(moved, E, False, True)
    moved.log_ratios = NO_EVIDENCE
    assert over_clutter(moved, E, False, True)[0] == pytest.approx(silently - E.moves + E.static * 12)


def test_few_returns_are_compared_with_a_wire_that_the_aim_follows():
    flew = log_ratios_of(20.0, 9.0, 9.0, 1.0)
    many, little = hovering(flew), candidate(*(observation(0.1 * k, returns=1, range_m=10.0) for k in range(12)))
    little.log_ratios = flew
    assert "it may be static" not in over_clutter(many, E, False, True)[1]
    assert "it may be static" in over_clutter(little, E, False, True)[1]


def test_at_close_range_a_path_along_a_wire_is_no_flight():
    followed = log_ratios_of(20.0, 9.0, 9.0, 1.0)
    for range_m, still in ((11.0, True), (25.0, False)):
        c = candidate(*(observation(0.1 * k, returns=12, range_m=range_m) for k in range(12)))
        c.log_ratios = followed
        assert ("it may be static" in over_clutter(c, E, False, True)[1]) == still


def test_the_penalty_of_a_reacquisition_falls_with_the_scan_passes_since():
    c = hovering(NO_EVIDENCE)
    alone, _ = classify(c, E, True, True)
    c.reacquired_at = 10
    assert classify(c, E, True, True)[0] == pytest.approx(alone - E.reacquired / 2)
    c.reacquired_at = 6
    log_odds, reason = classify(c, E, True, True)
    assert log_odds == pytest.approx(alone - E.reacquired / 6)
    assert "reacquired where the drone's odometry predicts it" in reason


def test_without_telemetry_the_log_odds_are_scaled_and_shifted():
    evidence, _ = classify(hovering(), ClassifierWeights(no_telemetry_weight=1.0, no_telemetry_offset=0.0), True, True)
    assert evidence != 0.0
    share = ClassifierWeights(no_telemetry_weight=0.5, no_telemetry_offset=-1.0)
    assert classify(hovering(), share, True, True)[0] == pytest.approx(0.5 * evidence - 1.0)
    assert classify(hovering(NO_EVIDENCE), share, True, True) == classify(hovering(NO_EVIDENCE), E, True, True)


def test_without_telemetry_the_thresholds_correspond_to_the_fitted_evidence():
    for default, evidence in (("accept_probability", 5.3), ("follow_up_probability", -5.1)):
        asked = log_odds_of(EvidenceDetect.settings_type.model_fields[default].default)
        assert asked == pytest.approx(calibrated(E.no_telemetry_weight * evidence + E.no_telemetry_offset, E), abs=0.05)


def test_the_evaluation_groups_probabilities_at_the_detectors_threshold():
    accepts = EvidenceDetect.settings_type.model_fields["accept_probability"].default
    assert PROBABILITY_EDGES[-2] == accepts


def test_the_calibration_reduces_high_log_odds_only():
    for log_odds in (-8.0, 0.0, E.calibration_knee):
        assert calibrated(log_odds, E) == log_odds
    assert calibrated(E.calibration_knee + 2.0, E) == pytest.approx(E.calibration_knee + 2.0 * E.calibration_slope)
    plain = E.model_copy(update={"calibration_slope": 1.0})
    c = hovering(log_ratios_of(20.0, 20.0, 20.0, 20.0))
    c.isolated_score, c.free, c.return_count_nats, c.rough_chords = 30.0, np.full(SECTORS, 12.0), 30.0, 5
    confident, _ = classify(c, plain, True, True)
    assert confident > E.calibration_knee
    assert classify(c, E, True, True)[0] == pytest.approx(calibrated(confident, E))


def test_at_close_range_isolation_counts_more_once_every_sector_was_measured():
    near, far = hovering(range_m=15.0), hovering(range_m=60.0)
    assert max_isolated_nats(near, E) == max_isolated_nats(far, E) == E.max_isolated  # no sector was measured
    for c in (near, far):
        c.free[:] = 20.0
    assert max_isolated_nats(near, E) == E.max_isolated + E.max_isolated_near
    assert max_isolated_nats(far, E) == E.max_isolated
    near.free[3] = 0.0
    assert max_isolated_nats(near, E) == E.max_isolated


def test_a_rejected_neighbour_counts_only_against_possibly_static_candidates():
    for log_ratios, counts in (
        (None, E.near_rejected),
        (NO_EVIDENCE, E.near_rejected),
        (log_ratios_of(20.0, 0.0, 0.0, 20.0), 0.0),
    ):
        c = hovering(log_ratios)
        without, *_ = over_clutter(c, E, False, True)
        c.near_rejected = True
        assert over_clutter(c, E, False, True)[0] == pytest.approx(without - counts)


def test_a_candidate_at_a_rejected_position_is_improbable_while_the_drone_flies():
    c = hovering(NO_EVIDENCE)
    c.near_rejected = True
    neighbour, *_ = over_clutter(c, E, False, True)
    c.revisited = True
    assert over_clutter(c, E, False, True)[0] == pytest.approx(neighbour - E.revisited)
    c.log_ratios = log_ratios_of(20.0, 0.0, 0.0, 20.0)
    assert over_clutter(c, E, False, True)[0] > neighbour  # it moved


def test_at_long_range_a_candidate_that_follows_the_odometry_is_no_wire():
    flew = log_ratios_of(20.0, 9.0, 9.0, 1.0)
    for range_m, still in ((10.0, True), (45.0, False)):
        little = candidate(*(observation(0.1 * k, returns=1, range_m=range_m) for k in range(40)))
        little.log_ratios = flew
        assert ("it may be static" in over_clutter(little, E, False, True)[1]) == still


def come_to_a_wall(*log_ratios_on_the_way):
    """A drone that hovers next to a wall after a flight that followed the odometry."""
    c = hovering()
    for log_ratio in log_ratios_on_the_way:
        c.add_log_ratios(log_ratio)
    c.neighbour_score = 10.0
    c.add_log_ratios(NO_EVIDENCE)
    return c


def test_neighbours_count_less_after_a_flight_in_open_air_that_follows_the_odometry():
    open_flight, denied = log_ratios_of(20.0, 9.0, 9.0, 15.0), log_ratios_of(-20.0, 9.0, 9.0, -20.0)
    alone, flew = come_to_a_wall(), come_to_a_wall(open_flight)
    less, *_ = over_clutter(alone, E, True, True)
    log_odds, remarks, _ = over_clutter(flew, E, True, True)
    assert (alone.flight_log_ratio, flew.flight_log_ratio) == (0.0, 15.0)
    assert less < -8.0
    assert log_odds > less + 10.0
    assert "an object next to it, reached by flight through open air" in remarks
    assert come_to_a_wall(open_flight, denied).flight_log_ratio == 0.0
    assert over_clutter(come_to_a_wall(open_flight, denied), E, True, True)[0] == pytest.approx(less)


def test_a_candidate_with_constant_neighbours_has_not_flown_in_open_air():
    c = hovering()
    c.neighbour_score = 1.0
    c.add_log_ratios(log_ratios_of(20.0, 9.0, 9.0, 15.0))
    assert c.flight_log_ratio == 0.0


def test_without_telemetry_next_to_a_wall_there_is_no_flight_in_open_air():
    c = come_to_a_wall(None)
    assert over_clutter(c, E, True, True)[0] < -8.0


def test_the_reason_states_whether_the_path_agrees_with_the_odometry():
    assert "odometry" not in classify(hovering(), E, True, True)[1]
    assert "odometry" not in classify(hovering(NO_EVIDENCE), E, True, True)[1]
    assert (
        "its path agrees with the drone's odometry"
        in classify(hovering(log_ratios_of(9.0, 4.0, 4.0, 9.0)), E, True, True)[1]
    )
    assert (
        "its path contradicts the drone's odometry"
        in classify(hovering(log_ratios_of(30.0, -9.0, 4.0, 30.0)), E, True, True)[1]
    )


def test_the_most_probable_alternative_is_stored():
    for log_ratios, suspect in (
        (log_ratios_of(-50.0, 20.0, 20.0, -50.0), Alternative.STATIC),
        (log_ratios_of(20.0, -50.0, 20.0, 20.0), Alternative.BIRD),
    ):
        c = hovering(log_ratios)
        _, reason = classify(c, E, True, True)
        assert c.alternative == suspect
        assert reason.endswith(f"if not a drone: {suspect.value}")


@pytest.mark.parametrize(
    ("log_ratios", "range_m", "birds"), [(NO_EVIDENCE, 5.0, 24.0), (NO_EVIDENCE, 40.0, 3.3), (None, 20.0, 1.65)]
)
def test_the_bird_prior_is_the_assumed_number_of_birds_for_each_drone(log_ratios, range_m, birds):
    """Two dozen at close range and three far away with telemetry; without it, before any motion was observed, 1.65."""
    c = candidate(observation(0.0, range_m=range_m))
    c.log_ratios = log_ratios
    assert math.exp(-over_bird(c, E)) == pytest.approx(birds, rel=0.05)
