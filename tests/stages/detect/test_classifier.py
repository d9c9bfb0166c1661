"""What a comparison with the drone's telemetry counts: shares, caps, words; and what it replaces."""

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
from tests.stages.detect.test_candidate import candidate, observation, way

E = ClassifierWeights()
FAR_M = 9.0


def heard_so(*nats, displacement_m=FAR_M):
    """Over what stands, a bird, a balloon, a wire: the drone has been so far away from where it was."""
    return MotionLogRatios(*nats, misfit=0.0, displacement_m=displacement_m)


NOTHING = heard_so(0.0, 0.0, 0.0, 0.0)


def hanging(log_ratios=None, range_m=20.0):
    made = candidate(*(observation(0.1 * k, range_m=range_m) for k in range(12)))
    made.log_ratios = log_ratios
    return made


@pytest.mark.parametrize(
    ("told", "counts"), [(0.0, 0.0), (5.0, 4.5), (-10.0, -9.0), (100.0, E.max_telemetry), (-100.0, E.min_telemetry)]
)
def test_a_share_of_what_is_told_counts_within_its_caps(told, counts):
    assert telemetry_nats(told, E) == pytest.approx(counts)


def test_over_a_bird_only_what_is_told_counts_as_soon_as_something_is():
    calm = hanging()
    assert over_bird(calm, E) > 3.0  # it hung still for a second
    calm.log_ratios = heard_so(0.0, 2.0, 0.0, 0.0)
    fast = candidate(*way((14.0, 0.0, 0.0)))
    fast.log_ratios = heard_so(0.0, 2.0, 0.0, 0.0)
    assert over_bird(fast, E) == pytest.approx(over_bird(calm, E))


def test_what_is_smaller_than_a_drone_is_met_nearby_so_far_off_it_is_less_likely_a_bird_or_a_stray_return():
    ranges_m = (5.0, E.small_m, 0.5 * (E.small_m + E.unseen_m), E.unseen_m, 50.0)
    told = [over_bird(hanging(heard_so(0.0, 2.0, 0.0, 0.0), range_m=r), E) - E.telemetry_weight * 2.0 for r in ranges_m]
    between = 0.5 * (E.bird_telemetry + E.bird_telemetry_far)
    assert told == pytest.approx(
        [E.bird_telemetry, E.bird_telemetry, between, E.bird_telemetry_far, E.bird_telemetry_far]
    )
    once = [candidate(observation(0.0, returns=2, range_m=r)) for r in ranges_m]
    for c in once:
        c.log_ratios = NOTHING
    far = E.far * (50.0 - E.far_m)
    between = 0.5 * (E.false_return + E.false_return_far)
    priors = [E.false_return, E.false_return, between, E.false_return_far, E.false_return_far - far]
    assert [over_false_return(c, E) for c in once] == pytest.approx([p + 2 * E.first_return for p in priors])
    for c in once:
        c.log_ratios = None  # the drone tells nothing: none of this was fitted to that
    assert [over_false_return(c, E) for c in once[:4]] == pytest.approx(
        [E.false_return_no_telemetry + 2 * E.first_return] * 4
    )


def test_what_hangs_still_where_what_would_hold_it_is_unseen_is_less_likely_a_drone_the_farther():
    plain = E.model_copy(update={"hover": 0.0})
    for range_m, share in ((15.0, 0.0), (25.0, 0.5), (30.0, 1.0)):
        still, flew = hanging(NOTHING, range_m), hanging(heard_so(20.0, 20.0, 20.0, 20.0), range_m)
        log_odds = [over_clutter(still, e, True, True)[0] for e in (E, plain)]
        assert log_odds[1] - log_odds[0] == pytest.approx(share * E.hover)
        assert over_clutter(flew, E, True, True) == over_clutter(flew, plain, True, True)


def test_from_28_m_on_what_may_stand_still_is_never_sure_enough_to_be_accepted_and_what_flew_is():
    for range_m, still_accepted in ((20.0, True), (27.0, True), (29.0, False), (31.0, False)):
        for told, moves in ((NOTHING, False), (heard_so(20.0, 20.0, 20.0, 20.0), True)):
            c = hanging(told, range_m)
            c.isolated_score, c.free, c.return_count_nats = 30.0, np.full(SECTORS, 12.0), 30.0
            c.rough_chords = 5
            sure = E.model_copy(update={"clutter": 0.0, "bird_telemetry_far": 9.0, "bird_telemetry": 9.0})
            log_odds, words = classify(c, sure, True, True)
            assert ("it may be static" in words) != moves
            accepted = log_odds >= log_odds_of(EvidenceDetect.settings_type.model_fields["accept_probability"].default)
            assert accepted == (moves or still_accepted), (range_m, told, log_odds)


def test_over_a_balloon_it_is_added_to_how_round_it_is():
    c = hanging()
    c.round_chords = 2
    assert over_balloon(c, E) == pytest.approx(E.balloon_no_telemetry - 2 * E.round_chord)
    c.log_ratios = heard_so(0.0, 0.0, -3.0, 0.0)
    assert over_balloon(c, E) == pytest.approx(E.balloon - 2 * E.round_chord - 3.0 * E.telemetry_weight)
    for displacement_m, counts in (
        (2.0, E.max_telemetry),
        (0.5, 3.0),
    ):  # one on its string swings as far as a drone that hangs
        c.log_ratios = heard_so(0.0, 0.0, 9.0, 0.0, displacement_m=displacement_m)
        assert over_balloon(c, E) == pytest.approx(E.balloon - 2 * E.round_chord + counts)


def test_a_drone_whose_sides_look_round_now_and_then_is_no_balloon_however_long_it_is_seen():
    """More chords of the same sides are no more evidence: 12 round ones of 21, as of a drone that was dropped."""
    for times in (1, 2, 10):
        c = hanging()
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


def test_a_look_with_nothing_beside_it_counts_more_nearby_where_what_holds_a_thing_would_return_pulses():
    near, between, far = (hanging(range_m=range_m) for range_m in (8.0, 13.0, 20.0))
    assert isolated_weight(near, E) == pytest.approx(E.isolated + E.isolated_near)
    assert isolated_weight(between, E) == pytest.approx(E.isolated + 0.5 * E.isolated_near)
    assert isolated_weight(far, E) == E.isolated
    plain = E.model_copy(update={"isolated_near": 0.0})
    for c in (near, far):
        c.isolated_score, c.free = 3.0, np.full(SECTORS, 12.0)
    assert over_clutter(near, E, True, True)[0] - over_clutter(near, plain, True, True)[0] == pytest.approx(3 * 0.7)
    assert over_clutter(far, E, True, True)[0] == over_clutter(far, plain, True, True)[0]


@pytest.mark.parametrize(
    ("range_m", "look"),
    [(15.0, E.further_pass), (25.0, 0.5 * (E.further_pass + E.further_pass_far)), (30.0, E.further_pass_far)],
)
def test_one_more_look_at_the_same_thing_tells_less_against_a_stray_return_far_off(range_m, look):
    once, twice = (candidate(*(observation(0.1 * k, range_m=range_m) for k in range(n))) for n in (1, 2))
    assert over_false_return(twice, E) - over_false_return(once, E) == pytest.approx(look)
    assert E.further_pass_far < E.further_pass


@pytest.mark.parametrize(
    ("range_m", "displacement_m", "went"),
    [(20.0, 0.3, True), (26.5, 0.6, False), (26.5, 0.9, True), (31.0, 1.2, False), (31.0, 2.0, True)],
)
def test_a_drone_that_has_gone_no_farther_than_a_lamp_is_long_has_not_moved(range_m, displacement_m, went):
    """Of a lamp 31 m away, met here and there, that seemed to swing as the drone did, which hung elsewhere."""
    c = hanging(heard_so(20.0, 20.0, 20.0, 20.0, displacement_m=displacement_m), range_m=range_m)
    assert ("it may be static" in over_clutter(c, E, True, True)[1]) != went
    c.neighbour_score = 0.0
    c.add_log_ratios(c.log_ratios)
    assert (c.flight_log_ratio > 0.0) == went
    near = hanging(heard_so(20.0, 20.0, 20.0, 20.0, displacement_m=0.6), range_m=9.0)
    assert "it may be static" not in over_clutter(near, E, True, True)[1]


@pytest.mark.parametrize(
    ("range_m", "returns", "displacement_m", "went"),
    [(12.0, 1, 0.6, False), (12.0, 1, 2.0, True), (12.0, 5, 0.6, True), (20.0, 1, 0.6, True)],
)
def test_single_returns_nearby_wander_along_a_wire_as_a_drone_swings_that_hangs_elsewhere(
    range_m, returns, displacement_m, went
):
    """Of wires 12 to 14 m away, whose looks seemed to go as the drone did, which hung 40 m away."""
    c = candidate(*(observation(0.1 * k, returns=returns, range_m=range_m) for k in range(12)))
    c.add_log_ratios(heard_so(20.0, 20.0, 20.0, 20.0, displacement_m=displacement_m))
    assert ("it may be static" in over_clutter(c, E, True, True)[1]) != went
    assert (c.flight_log_ratio > 0.0) == went


@pytest.mark.parametrize("told", [0.0, 0.59, 0.9, 1.29])
def test_whatever_share_of_its_word_counts_what_a_hanging_drone_says_is_no_motion(told):
    e = E.model_copy(update={"told": told})
    c = hanging(heard_so(20.0, 20.0, 20.0, 20.0, displacement_m=0.6), range_m=31.0)
    assert "it may be static" in over_clutter(c, e, True, True)[1]
    assert over_balloon(c, e) <= e.balloon + MOVED_NATS
    remarks = classify(c, e, True, True)[1]
    assert "its path agrees with the drone's odometry" not in remarks
    assert "the drone's odometry moved 0.6 m only" in remarks


def test_over_what_stands_it_replaces_whether_it_moved():
    silent, nothing, flew = hanging(), hanging(NOTHING), hanging(heard_so(20.0, 0.0, 0.0, 20.0))
    (log_odds, remarks, _), (same, same_said, _), (more, more_said, _) = (
        over_clutter(c, E, False, True) for c in (silent, nothing, flew)
    )
    assert same == pytest.approx(log_odds)
    assert remarks == same_said
    assert "it may be static" in remarks
    assert "it may be static" not in more_said
    assert more == pytest.approx(log_odds - E.static * 12 + E.max_telemetry)
    moved = candidate(*way((2.0, 0.0, 0.0), looks=12))
    silently, *_ = over_clutter(moved, E, False, True)
    moved.log_ratios = NOTHING
    assert over_clutter(moved, E, False, True)[0] == pytest.approx(silently - E.moves + E.static * 12)


def test_what_returns_little_is_taken_for_a_wire_that_was_looked_along():
    flew = heard_so(20.0, 9.0, 9.0, 1.0)
    many, little = hanging(flew), candidate(*(observation(0.1 * k, returns=1, range_m=10.0) for k in range(12)))
    little.log_ratios = flew
    assert "it may be static" not in over_clutter(many, E, False, True)[1]
    assert "it may be static" in over_clutter(little, E, False, True)[1]


def test_nearby_a_path_that_a_wire_followed_by_the_aim_would_show_is_no_flight_however_much_it_returns():
    followed = heard_so(20.0, 9.0, 9.0, 1.0)
    for range_m, still in ((11.0, True), (25.0, False)):
        c = candidate(*(observation(0.1 * k, returns=12, range_m=range_m) for k in range(12)))
        c.log_ratios = followed
        assert ("it may be static" in over_clutter(c, E, False, True)[1]) == still


def test_two_things_may_lie_as_the_drone_flew_by_chance_less_with_each_look_since():
    c = hanging(NOTHING)
    alone, _ = classify(c, E, True, True)
    c.reacquired_at = 10
    assert classify(c, E, True, True)[0] == pytest.approx(alone - E.reacquired / 2)
    c.reacquired_at = 6
    log_odds, words = classify(c, E, True, True)
    assert log_odds == pytest.approx(alone - E.reacquired / 6)
    assert "reacquired where the drone's odometry predicts it" in words


def test_where_the_drone_tells_nothing_the_odds_are_a_share_of_the_evidence_and_an_offset():
    evidence, _ = classify(hanging(), ClassifierWeights(no_telemetry_weight=1.0, no_telemetry_offset=0.0), True, True)
    assert evidence != 0.0
    share = ClassifierWeights(no_telemetry_weight=0.5, no_telemetry_offset=-1.0)
    assert classify(hanging(), share, True, True)[0] == pytest.approx(0.5 * evidence - 1.0)
    assert classify(hanging(NOTHING), share, True, True) == classify(hanging(NOTHING), E, True, True)


def test_without_the_drones_word_what_is_accepted_and_looked_at_again_has_the_evidence_that_the_numbers_were_made_for():
    for default, evidence in (("accept_probability", 5.3), ("follow_up_probability", -5.1)):
        asked = log_odds_of(EvidenceDetect.settings_type.model_fields[default].default)
        assert asked == pytest.approx(calibrated(E.no_telemetry_weight * evidence + E.no_telemetry_offset, E), abs=0.05)


def test_the_evaluation_groups_probabilities_at_the_detectors_threshold():
    accepts = EvidenceDetect.settings_type.model_fields["accept_probability"].default
    assert PROBABILITY_EDGES[-2] == accepts


def test_what_is_likely_a_drone_is_one_less_often_than_its_odds_and_what_is_not_just_as_often():
    for log_odds in (-8.0, 0.0, E.calibration_knee):
        assert calibrated(log_odds, E) == log_odds
    assert calibrated(E.calibration_knee + 2.0, E) == pytest.approx(E.calibration_knee + 2.0 * E.calibration_slope)
    plain = E.model_copy(update={"calibration_slope": 1.0})
    c = hanging(heard_so(20.0, 20.0, 20.0, 20.0))
    c.isolated_score, c.free, c.return_count_nats, c.rough_chords = 30.0, np.full(SECTORS, 12.0), 30.0, 5
    sure, _ = classify(c, plain, True, True)
    assert sure > E.calibration_knee
    assert classify(c, E, True, True)[0] == pytest.approx(calibrated(sure, E))


def test_nearby_looks_with_nothing_beside_it_count_more_once_every_sector_was_crossed():
    near, far = hanging(range_m=15.0), hanging(range_m=60.0)
    assert max_isolated_nats(near, E) == max_isolated_nats(far, E) == E.max_isolated  # nothing was measured around them
    for c in (near, far):
        c.free[:] = 20.0
    assert max_isolated_nats(near, E) == E.max_isolated + E.max_isolated_near
    assert max_isolated_nats(far, E) == E.max_isolated
    near.free[3] = 0.0
    assert max_isolated_nats(near, E) == E.max_isolated


def test_a_refused_neighbour_counts_only_against_what_may_stand():
    for log_ratios, counts in (
        (None, E.near_rejected),
        (NOTHING, E.near_rejected),
        (heard_so(20.0, 0.0, 0.0, 20.0), 0.0),
    ):
        c = hanging(log_ratios)
        apart, *_ = over_clutter(c, E, False, True)
        c.near_rejected = True
        assert over_clutter(c, E, False, True)[0] == pytest.approx(apart - counts)


def test_what_stands_where_something_was_refused_counts_little_while_the_drone_flies():
    c = hanging(NOTHING)
    c.near_rejected = True
    beside, *_ = over_clutter(c, E, False, True)
    c.revisited = True
    assert over_clutter(c, E, False, True)[0] == pytest.approx(beside - E.revisited)
    c.log_ratios = heard_so(20.0, 0.0, 0.0, 20.0)
    assert over_clutter(c, E, False, True)[0] > beside  # it moved


def test_far_off_a_wire_returns_nothing_so_what_moved_as_the_drone_says_is_none():
    flew = heard_so(20.0, 9.0, 9.0, 1.0)
    for range_m, still in ((10.0, True), (45.0, False)):
        little = candidate(*(observation(0.1 * k, returns=1, range_m=range_m) for k in range(40)))
        little.log_ratios = flew
        assert ("it may be static" in over_clutter(little, E, False, True)[1]) == still


def come_to_a_wall(*told_on_the_way):
    """A drone that hangs beside a wall, after it flew as told, and what was told of it there, told as little."""
    c = hanging()
    for told in told_on_the_way:
        c.add_log_ratios(told)
    c.neighbour_score = 10.0
    c.add_log_ratios(NOTHING)
    return c


def test_what_flew_through_the_open_as_the_drone_says_is_not_what_stands_where_it_comes_to():
    open_flight, denied = heard_so(20.0, 9.0, 9.0, 15.0), heard_so(-20.0, 9.0, 9.0, -20.0)
    alone, flew = come_to_a_wall(), come_to_a_wall(open_flight)
    less, *_ = over_clutter(alone, E, True, True)
    log_odds, remarks, _ = over_clutter(flew, E, True, True)
    assert (alone.flight_log_ratio, flew.flight_log_ratio) == (0.0, 15.0)
    assert less < -8.0
    assert log_odds > less + 10.0
    assert "an object next to it, reached by flight through open air" in remarks
    assert come_to_a_wall(open_flight, denied).flight_log_ratio == 0.0
    assert over_clutter(come_to_a_wall(open_flight, denied), E, True, True)[0] == pytest.approx(less)


def test_what_had_something_beside_it_all_along_has_not_flown_through_the_open():
    c = hanging()
    c.neighbour_score = 1.0
    c.add_log_ratios(heard_so(20.0, 9.0, 9.0, 15.0))
    assert c.flight_log_ratio == 0.0


def test_a_drone_that_falls_silent_beside_a_wall_has_nothing_to_show():
    c = come_to_a_wall(heard_so(20.0, 9.0, 9.0, 15.0))
    c.add_log_ratios(None)
    assert over_clutter(c, E, True, True)[0] < -8.0


def test_the_words_say_whether_it_flies_as_the_drone_says():
    assert "odometry" not in classify(hanging(), E, True, True)[1]
    assert "odometry" not in classify(hanging(NOTHING), E, True, True)[1]
    assert (
        "its path agrees with the drone's odometry" in classify(hanging(heard_so(9.0, 4.0, 4.0, 9.0)), E, True, True)[1]
    )
    assert (
        "its path contradicts the drone's odometry"
        in classify(hanging(heard_so(30.0, -9.0, 4.0, 30.0)), E, True, True)[1]
    )


def test_what_it_is_if_it_is_no_drone_is_noted():
    for log_ratios, suspect in (
        (heard_so(-50.0, 20.0, 20.0, -50.0), Alternative.STATIC),
        (heard_so(20.0, -50.0, 20.0, 20.0), Alternative.BIRD),
    ):
        c = hanging(log_ratios)
        _, words = classify(c, E, True, True)
        assert c.alternative == suspect
        assert words.endswith(f"if not a drone: {suspect.value}")


@pytest.mark.parametrize(
    ("log_ratios", "range_m", "birds"), [(NOTHING, 5.0, 24.0), (NOTHING, 40.0, 3.3), (None, 20.0, 1.65)]
)
def test_the_bird_prior_is_the_assumed_number_of_birds_for_each_drone(log_ratios, range_m, birds):
    """Two dozen at close range and three far away with telemetry; without it, before any motion was observed, 1.65."""
    c = candidate(observation(0.0, range_m=range_m))
    c.log_ratios = log_ratios
    assert math.exp(-over_bird(c, E)) == pytest.approx(birds, rel=0.05)
