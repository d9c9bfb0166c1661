"""EvidenceDetect on synthetic skies: it accepts what hovers freely after a second of scan passes, and rejects the rest.

The skies are made by tests/stages/caster.py; nothing of them went into choosing the numbers of the evidence.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

from flow.message import check_arrays
from flow.stage import input_ports, output_ports
from stages.detect import EvidenceDetect
from stages.detect.candidate import Alternative, Observation
from stages.detect.candidate_messages import detections_message, log_odds_of
from stages.detect.classifier import ClassifierWeights, over_clutter
from stages.detect.evidence_detect import HYSTERESIS_NATS, NEAR_REJECTED_M, NEAR_REJECTED_NS, STATIC_NS
from stages.geometry.frames import rotation_from_rpy_deg, rotation_z
from stages.geometry.trajectory import VehicleTrajectory
from stages.kernels.detect.isolation import FREE_0, SECTORS, TALLY
from stages.messages import (
    CandidateEvidence,
    Candidates,
    Detections,
    DroneLocalPosition,
    DroneOdometry,
    SearchResult,
    VehicleMotion,
)
from tests.stages.caster import (
    Ball,
    Box,
    Drone,
    During,
    Wire,
    dithering,
    flying,
    pulses_seen,
    still,
    sweeping,
    together,
)
from tests.stages.detect.test_candidate import candidate
from tests.stages.made import ON_ITS_SIDE, START_NS

PLACE_M = (0.0, 8.0, 10.0)  # 12.7 m away, 51 deg up
WATCHING = dithering(half_rad=math.radians(1.0))  # as the aim does: each turn a beam comes near
PASS_DEG = 4.5  # so that each swing of it counts as a pass: a summary every 0.4 s
MOVING = flying((-0.8, 8.0, 10.0), (0.8, 0.0, 0.4))
GLIDING = flying((-4.5, 8.0, 10.0), (3.0, 0.0, 0.0))  # as a drone may, and a bird


def hanging(seed=0):
    return Drone(still(*PLACE_M), seed=seed)


def motion_at(t_s, velocity_mps=(0.0, 0.0, 0.0)):
    return VehicleMotion(
        stamp_ns=START_NS + round(t_s * 1e9),
        xyz_map_m=t_s * np.asarray(velocity_mps, dtype=np.float64),
        R_map_vehicle=np.eye(3),
        covariance=None,
    )


def test_how_the_vehicle_moves_is_not_known_any_more_when_its_word_is_old():
    stage = EvidenceDetect()
    assert not stage._motion_known(START_NS)
    stage.on_motion(motion_at(0.0))
    assert stage._motion_known(START_NS + 600_000_000)
    assert not stage._motion_known(START_NS + 800_000_000)
    assert EvidenceDetect(parked=True)._motion_known(START_NS)


def test_what_was_just_accepted_is_told_though_it_was_seen_before_the_search_began():
    c = candidate(observation(0.0, np.array(PLACE_M)))
    c.accepted, c.log_odds, c.reason = True, 6.0, "made"
    later_ns = c.seen_ns + 5_000_000
    told = detections_message([c], VehicleTrajectory(), later_ns, later_ns + 1, Counter(), 3)
    assert told.accepted.tolist() == [True]
    c.announced = True
    told = detections_message([c], VehicleTrajectory(), later_ns, later_ns + 1, Counter(), 3)
    assert told.accepted.tolist() == []


def local_position(way, t_s, yaw_rad=0.9):
    """What the drone's autopilot tells of a flight, in a frame of its own."""
    R = rotation_z(yaw_rad)
    place, soon = way(np.array([t_s, t_s + 0.01]))
    return DroneLocalPosition(
        stamp_ns=START_NS + round(t_s * 1e9),
        xyz_odom_m=R @ place + (30.0, -4.0, 5.0),
        velocity_odom_mps=R @ (soon - place) / 0.01,
    )


def odometry(way, t_s, R_odom_drone):
    """The same from an autopilot that tells its velocity in the drone's axes."""
    position = local_position(way, t_s)
    return DroneOdometry(
        stamp_ns=position.stamp_ns,
        xyz_odom_m=position.xyz_odom_m,
        R_odom_drone=R_odom_drone,
        velocity_drone_mps=R_odom_drone.T @ position.velocity_odom_mps,
        angular_velocity_drone_radps=np.zeros(3),
        pose_covariance=None,
        velocity_covariance=None,
        reset_counter=0,
        quality_percent=None,
    )


def run(
    things, seconds=3.0, servo_rad=WATCHING, drives_mps=(0.0, 0.0, 0.0), say=None, stage=None, packets=1, **settings
):
    """(Candidates, Detections) that the stage tells.

    drives_mps None: the vehicle does not say how it moves. say(stage, t_s): what the drone says, 20 ms apart.
    """
    stage = stage or EvidenceDetect(**{"sweep_deg": PASS_DEG, **settings})
    told, next_s = [], 0.0
    for pulses in together(pulses_seen(things, servo_rad, seconds), packets):
        while START_NS + next_s * 1e9 <= pulses.point_stamp_ns[-1]:
            if drives_mps is not None:
                stage.on_motion(motion_at(next_s, drives_mps))
            if say is not None:
                say(stage, next_s)
            next_s += 0.02
        told += stage.on_pulses(pulses)
    for message in told:
        check_arrays(message)
    return [m for m in told if isinstance(m, Candidates)], [m for m in told if isinstance(m, Detections)]


def saying(way, until_s=math.inf, yaw_rad=0.9):
    return lambda stage, t_s: stage.on_drone_position(local_position(way, t_s, yaw_rad)) if t_s < until_s else None


def accepted_after_s(detections):
    """When the first was accepted, inf: never."""
    return next(((d.stamp_ns - START_NS) * 1e-9 for d in detections if d.accepted.any()), math.inf)


def reasons_of(candidates):
    return " | ".join(reason for told in candidates for reason in told.reasons)


def test_ports_are_what_the_graph_wires():
    assert set(input_ports(EvidenceDetect)) == {"motion", "pulses", "drone_position", "drone_odometry"}
    assert set(output_ports(EvidenceDetect)) == {"candidates", "detections"}
    assert EvidenceDetect.optional_inputs == {"motion", "drone_position", "drone_odometry"}


@pytest.mark.parametrize("seed", range(2))
def test_a_small_thing_that_moves_in_the_free_sky_is_a_drone_after_a_second_or_two_of_looks(seed):
    candidates, detections = run([Drone(MOVING, seed=seed)])
    assert 0.4 < accepted_after_s(detections) < 2.3
    last = detections[-1]
    assert last.accepted.tolist() == [True]
    evidence = last.evidence
    assert isinstance(evidence, CandidateEvidence)
    assert evidence.probability[0] >= 0.98
    assert evidence.log_odds[0] == pytest.approx(math.log(evidence.probability[0] / (1 - evidence.probability[0])))
    truth = MOVING(np.array([(evidence.seen_ns[0] - START_NS) * 1e-9]))[0]
    np.testing.assert_allclose(last.xyz_vehicle_m[0], truth, atol=0.3)
    np.testing.assert_allclose(evidence.velocity_vehicle_mps[0], (0.8, 0.0, 0.4), atol=0.6)
    assert last.summary.startswith("drone at (")
    assert last.result is SearchResult.DRONE
    assert candidates[-1].accept_probability == EvidenceDetect().settings.accept_probability
    assert "sectors around it free" in last.reasons[0]
    assert evidence.candidate_id[0] == candidates[0].candidate_id[0]  # the same thing keeps its number


def test_four_packets_together_tell_the_same_as_one_by_one():
    drives_mps = (5.0, 0.0, 0.0)  # and the drone with it
    (candidates, one), (together_4, four) = (run([Drone(MOVING)], drives_mps=drives_mps, packets=n) for n in (1, 4))
    assert accepted_after_s(four) == pytest.approx(accepted_after_s(one), abs=0.1)
    assert together_4[-1].scan_passes[0] == candidates[-1].scan_passes[0]
    assert together_4[-1].seen_ns[0] == pytest.approx(candidates[-1].seen_ns[0], abs=6e6)
    np.testing.assert_allclose(together_4[-1].xyz_vehicle_m[0], candidates[-1].xyz_vehicle_m[0], atol=0.05)


def test_what_was_accepted_stays_so_until_much_less_speaks_for_it(monkeypatch):
    stage, c = EvidenceDetect(), candidate(observation(0.0, np.array(PLACE_M)))
    accept = log_odds_of(stage.settings.accept_probability)
    verdicts = []
    for log_odds in (
        accept - 0.1,
        accept + 0.1,
        accept - HYSTERESIS_NATS + 0.1,
        accept - HYSTERESIS_NATS - 0.1,
        accept - 0.1,
    ):
        monkeypatch.setattr(
            "stages.detect.evidence_detect.classify", lambda *_, log_odds=log_odds: (log_odds, "so it is")
        )
        stage._classify(stage._now, c)
        verdicts.append(c.accepted)
    assert verdicts == [False, True, True, False, False]
    assert accept - HYSTERESIS_NATS > 0.0  # a drone rather than not
    assert HYSTERESIS_NATS > 1.0


def test_its_probability_is_told_from_the_first_looks_on_and_grows():
    candidates, _ = run([Drone(MOVING)])
    assert (candidates[0].stamp_ns - START_NS) * 1e-9 < 0.6
    probability = [float(c.probability[0]) for c in candidates]
    assert probability[0] < 0.5 < 0.98 < probability[-1]
    assert candidates[-1].scan_passes[0] > 15


@pytest.mark.parametrize("seed", range(3))
def test_what_hangs_quite_still_nearby_is_a_drone_once_all_that_could_hold_it_would_have_been_seen(seed):
    candidates, detections = run([hanging(seed)], 4.2)
    assert 1.0 < accepted_after_s(detections) < 3.0
    assert "it may be static" in candidates[-1].reasons[0]
    _, told_to_doubt = run([hanging(seed)], 4.2, weights={"max_isolated_near": 0.0})
    assert accepted_after_s(told_to_doubt) == math.inf


def test_candidates_tell_which_life_of_the_detector_counts_them():
    stage = EvidenceDetect(sweep_deg=PASS_DEG)
    whole, _ = run([hanging()], 1.5, stage=stage)
    assert {m.detector_instance for m in whole} == {START_NS}
    later = [p for p in pulses_seen([hanging()], WATCHING, 1.5) if p.stamp_ns > START_NS + 700_000_000]
    afresh = EvidenceDetect(sweep_deg=PASS_DEG)
    told = [m for p in later for m in afresh.on_pulses(p) if isinstance(m, Candidates)]
    assert {m.detector_instance for m in told} == {later[0].stamp_ns}


def test_far_away_it_stays_a_candidate_because_a_wire_would_not_be_seen():
    far_m = 2.6 * np.array(PLACE_M)
    candidates, detections = run([Drone(still(*far_m), span_m=0.9)], 4.2, span_m=0.9)
    assert accepted_after_s(detections) == math.inf
    assert 0.5 < max(c.probability.max() for c in candidates if c.probability.size) < 0.95


BESIDE = {
    "on a pole": (Wire((0.0, 8.0, 0.0), (0.0, 8.0, 9.9), 0.08), ("next to",)),
    "beside a wall": (Box((0.7, 6.0, 0.0), (1.2, 12.0, 14.0)), ("next to",)),
    "on a wire": (Wire((-20.0, 8.0, 10.0), (20.0, 8.0, 10.0), 0.03), ("next to",)),
}


@pytest.mark.parametrize("where", BESIDE)
def test_the_same_thing_is_refused_with_a_reason(where):
    other, words = BESIDE[where]
    candidates, detections = run([hanging(), other], 3.0)
    assert accepted_after_s(detections) == math.inf
    assert len(detections) >= 6
    remarks = reasons_of(candidates) + " | ".join(d.summary for d in detections)
    assert all(word in remarks for word in words), remarks
    assert all(d.summary.startswith("no drone: ") for d in detections)
    assert all(c.probability.size == 0 or c.probability.max() < 0.9 for c in candidates)


def test_what_is_half_hidden_by_something_nearer_is_counted_as_such():
    edge = Box((-3.0, 4.0, 0.0), (3.0, 4.1, 5.2))  # a nearer wall that covers its lower half
    _, detections = run([Drone(still(*PLACE_M)), edge], 2.0)
    assert accepted_after_s(detections) == math.inf
    assert any("hidden at an end by something nearer" in d.summary for d in detections)


def test_what_stands_far_behind_it_does_not_matter():
    wall = Box((-12.0, 16.0, 0.0), (12.0, 17.0, 30.0))
    _, detections = run([Drone(MOVING), wall])
    assert accepted_after_s(detections) < 2.3


def test_a_wire_alone_is_never_a_drone():
    _, detections = run([Wire((-20.0, 8.0, 10.0), (20.0, 8.0, 10.0), 0.02)], 3.0)
    assert accepted_after_s(detections) == math.inf


def test_a_single_stray_return_is_not_even_worth_a_look_for_long():
    stray = During(Ball(still(*PLACE_M), 0.02), 0.4, 0.6)
    candidates, detections = run([stray], 2.0)
    assert accepted_after_s(detections) == math.inf
    assert not candidates or candidates[-1].candidate_id.size == 0 or candidates[-1].probability.max() < 0.1


def test_rain_is_never_a_drone():
    class Rain:
        """Each pulse meets a drop, somewhere, once in 2000."""

        rng = np.random.default_rng(8)

        def range_m(self, origin_m, direction, t_s):
            n = len(t_s)
            return np.where(self.rng.random(n) < 0.0005, self.rng.uniform(2.0, 25.0, n), np.inf)

    _, detections = run([Rain()], 3.0)
    assert accepted_after_s(detections) == math.inf


def test_a_smooth_ball_is_a_balloon_and_a_fast_thing_a_bird():
    balloon, refused = run([Ball(MOVING, 0.25)])
    assert accepted_after_s(refused) == math.inf
    assert "balloon" in reasons_of(balloon)
    _, refused = run([Drone(flying((-15.0, 8.0, 10.0), (12.0, 0.0, 0.0)), span_m=0.4)])
    assert accepted_after_s(refused) == math.inf


def test_no_drone_is_a_normal_answer_at_the_end_of_each_pass():
    candidates, detections = run([], 2.0)
    assert candidates == []
    assert len(detections) >= 3
    assert all(d.summary.startswith("no drone: ") and len(d.accepted) == 0 for d in detections)


def test_searched_intervals_follow_one_another_without_gap():
    for things in ([], [hanging()]):
        _, detections = run(things, 2.0)
        assert detections[0].evidence.start_ns == START_NS
        for before, after in pairwise(detections):
            assert before.evidence.start_ns < before.stamp_ns
            assert after.evidence.start_ns == before.stamp_ns + 1


def test_a_sweep_over_the_whole_sky_finds_houses_no_drone_and_says_how_many_were_refused():
    street = [Box((-9, -40, 0), (-7, 40, 9)), Box((7, -40, 0), (9, 40, 9)), Wire((7.5, 0, 0), (5.0, 0, 11), 0.1)]
    _, detections = run(street, 3.3, servo_rad=sweeping(), sweep_deg=180.0)
    assert accepted_after_s(detections) == math.inf
    ends_s = [(d.stamp_ns - START_NS) * 1e-9 for d in detections]
    assert ends_s == pytest.approx([1.475, 2.95], abs=0.02)  # 177 deg at 120 deg/s, each
    assert "short returns rejected at once" in detections[0].summary


# what the drone tells of its flight


def test_a_drone_that_flies_as_it_says_is_told_so_and_accepted():
    _, detections = run([Drone(MOVING)], say=saying(MOVING))
    assert 0.4 < accepted_after_s(detections) < 2.0
    assert "its path agrees with the drone's odometry" in detections[-1].reasons[0]


def test_which_way_its_autopilots_axes_point_does_not_matter():
    told = [run([Drone(MOVING)], 2.0, say=saying(MOVING, yaw_rad=yaw)) for yaw in (0.0, math.pi / 2, 0.13)]
    at_s = [accepted_after_s(detections) for _, detections in told]
    assert at_s[1] == at_s[0] < 2.0
    assert at_s[2] == pytest.approx(at_s[0], abs=0.3)
    assert told[1][0][-1].probability == pytest.approx(told[0][0][-1].probability, abs=1e-9)


@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0, 0.0), (20.0, -10.0, 130.0)])
def test_an_autopilot_that_tells_its_odometry_is_understood_however_the_drone_is_turned(tilt_deg):
    R = rotation_from_rpy_deg(tilt_deg)
    by_position, _ = run([Drone(MOVING)], say=saying(MOVING))
    by_odometry, detections = run([Drone(MOVING)], say=lambda s, t: s.on_drone_odometry(odometry(MOVING, t, R)))
    assert "its path agrees with the drone's odometry" in detections[-1].reasons[0]
    for a, b in zip(by_position, by_odometry, strict=True):
        np.testing.assert_allclose(a.probability, b.probability, atol=1e-9)
        np.testing.assert_allclose(a.velocity_vehicle_mps, b.velocity_vehicle_mps, atol=1e-6)


def test_what_glides_by_while_the_drone_hangs_is_a_bird():
    glider = [Drone(GLIDING, span_m=0.5)]
    _, silent = run(glider)
    assert accepted_after_s(silent) < 2.5  # nothing else would tell it from a drone
    candidates, detections = run([Drone(GLIDING, span_m=0.5)], say=saying(still(0.0, 0.0, 0.0)))
    assert accepted_after_s(detections) == math.inf
    assert candidates[-1].probability.max() < 0.05
    assert "its path agrees with the drone's odometry" not in candidates[-1].reasons[0]
    assert "if not a drone: a bird" in candidates[-1].reasons[0]


SHOWN_S = ((0.0, 0.1), (1.5, 1.8))  # a look, and some more a pass of the fan later
PASSING_BY = flying((-3.0, 8.0, 10.0), (3.0, 0.0, 0.0))


@pytest.mark.parametrize(("say", "again"), [(saying(PASSING_BY), True), (None, False)], ids=["speaks", "silent"])
def test_a_drone_met_a_pass_later_where_it_says_it_would_be_goes_on_with_its_evidence(say, again):
    shown = [During(Drone(PASSING_BY, seed=i), *when) for i, when in enumerate(SHOWN_S)]
    candidates, _ = run(shown, seconds=2.0, say=say)
    assert ("reacquired where the drone's odometry predicts it" in reasons_of(candidates)) == again


def test_what_was_met_once_flies_on_at_the_speed_that_the_drone_says_nobody_knows_whither():
    for say, speed_mps in ((saying(PASSING_BY), 3.0), (None, 0.0)):
        candidates, _ = run([Drone(PASSING_BY)], seconds=1.0, say=say)
        once = [told.undirected_speed_mps[told.scan_passes == 1] for told in candidates]
        more = [told.undirected_speed_mps[told.scan_passes > 1] for told in candidates]
        np.testing.assert_allclose(np.concatenate(once), speed_mps, atol=0.01)
        assert np.concatenate(once).size
        assert not np.concatenate(more).any()


def test_a_lamp_is_refused_while_the_drone_flies_and_not_while_it_hangs():
    flies = saying(flying((0.0, 0.0, 0.0), (3.0, 0.0, 0.0)))
    candidates, detections = run([hanging()], say=flies)
    assert accepted_after_s(detections) == math.inf
    assert candidates[-1].candidate_id.size == 0 or candidates[-1].probability.max() < 0.02
    candidates, detections = run([hanging()], say=saying(still(0.0, 0.0, 0.0)))
    assert accepted_after_s(detections) < 3.0
    assert candidates[-1].probability.max() > 0.95


def test_a_balloon_is_refused_though_it_drifts_as_the_drone_says_because_it_is_smooth():
    candidates, detections = run([Ball(MOVING, 0.25)], say=saying(MOVING))
    assert accepted_after_s(detections) == math.inf
    assert "if not a drone: a balloon" in candidates[-1].reasons[0]
    elsewhere, _ = run([Ball(MOVING, 0.25)], say=saying(flying((0.0, 0.0, 0.0), (3.0, 0.0, -0.5))))
    assert elsewhere[-1].candidate_id.size == 0 or elsewhere[-1].probability[0] < 0.1 * candidates[-1].probability[0]


def test_sightings_from_before_its_first_word_do_not_silence_it():
    def late(stage, t_s):
        if t_s > 0.8:
            stage.on_drone_position(local_position(MOVING, t_s))

    candidates, _ = run([Drone(MOVING)], say=late)
    assert "odometry" not in candidates[0].reasons[0]
    assert "its path agrees with the drone's odometry" in candidates[-1].reasons[0]


def test_a_drone_that_falls_silent_is_judged_by_how_it_flies_alone():
    spoke = run([Drone(MOVING)], say=saying(MOVING, until_s=0.4))
    silent = run([Drone(MOVING)])
    assert "odometry" not in spoke[1][-1].reasons[0]
    np.testing.assert_array_equal(spoke[1][-1].evidence.probability, silent[1][-1].evidence.probability)
    np.testing.assert_array_equal(spoke[0][-1].velocity_vehicle_mps, silent[0][-1].velocity_vehicle_mps)


def test_from_a_vehicle_that_does_not_say_how_it_drives_only_heights_are_compared():
    says = flying((0.0, 0.0, 0.0), (0.0, 0.0, 1.5))
    passes_and_rises = Drone(flying((-2.0, 8.0, 8.0), (1.5, 0.0, 1.5)))
    log_ratios, _ = run([passes_and_rises], 2.5, drives_mps=None, say=saying(says))
    assert "its path agrees with the drone's odometry" in log_ratios[-1].reasons[0]
    pass_throughs = Drone(flying((-2.0, 8.0, 10.0), (1.5, 0.0, 0.0)))
    log_ratios, detections = run([pass_throughs], 2.5, drives_mps=None, say=saying(says))
    assert accepted_after_s(detections) == math.inf
    assert log_ratios[-1].probability.max(initial=0.0) < 0.1


def test_a_candidate_seen_twice_is_expected_to_fly_as_fast_as_the_drone_says():
    """At first its velocity is known to some metres a second; a drone that hangs is expected to stay."""
    hangs, _ = run([hanging()], 0.5, say=saying(still(0.0, 0.0, 0.0)))
    flies, _ = run([hanging()], 0.5, say=saying(flying((0.0, 0.0, 0.0), (8.0, 0.0, 2.0))))
    first_hangs, first_flies = hangs[0].velocity_vehicle_mps[0], flies[0].velocity_vehicle_mps[0]
    assert np.abs(first_hangs).max() < 0.02
    assert first_flies[2] == pytest.approx(2.0, abs=1.5)  # it rises as the drone says


# what stood there before


def looking_away(from_s, to_s):
    """Watches, but for some seconds in which the fan holds another part of the sky."""
    return lambda t_s: WATCHING(t_s) + np.where((np.asarray(t_s) > from_s) & (np.asarray(t_s) < to_s), 0.8, 0.0)


def test_what_stood_is_known_again_and_not_looked_at_anew():
    stage = EvidenceDetect(sweep_deg=PASS_DEG, forget_s=0.5, weights=ClassifierWeights(max_isolated_near=0.0))
    candidates, detections = run([hanging()], 4.5, looking_away(1.5, 3.0), stage=stage)
    numbers = {int(number) for told in candidates for number in told.candidate_id}
    assert numbers == {1}
    told = [c for c in candidates if c.candidate_id.size]
    before = max(c.scan_passes[0] for c in told if c.stamp_ns < START_NS + 2e9)
    again = next(c for c in told if c.stamp_ns > START_NS + 2.9e9)
    assert again.scan_passes[0] > before > 5
    assert accepted_after_s(detections) == math.inf
    assert len(stage._now.static) == 0  # it is a candidate again


def test_what_stood_is_forgotten_with_an_unknown_vehicles_motion_and_what_flew_always():
    stage = EvidenceDetect(sweep_deg=PASS_DEG, forget_s=0.5)
    run([hanging()], 2.5, looking_away(1.5, 9.0), drives_mps=None, stage=stage)
    assert list(stage._now.table) == []
    assert len(stage._now.static) == 0
    stage = EvidenceDetect(sweep_deg=PASS_DEG, forget_s=0.5)
    run([Drone(MOVING)], 2.5, looking_away(1.5, 9.0), stage=stage)
    assert list(stage._now.table) == []
    assert len(stage._now.static) == 0


def test_what_stood_is_forgotten_after_a_minute():
    stage = EvidenceDetect(sweep_deg=PASS_DEG, forget_s=0.5, parked=True)
    run([hanging()], 2.5, looking_away(1.5, 9.0), stage=stage)
    assert [c.number for c in stage._now.static] == [1]
    seen_ns = stage._now.static[0].seen_ns
    stage._prune(stage._now, seen_ns + STATIC_NS - 1)
    assert len(stage._now.static) == 1
    stage._prune(stage._now, seen_ns + STATIC_NS + 1)
    assert len(stage._now.static) == 0


def observation(t_s, xyz_m, free_sectors=SECTORS, returns=1):
    isolation = np.zeros(TALLY, dtype=np.int64)
    isolation[FREE_0 : FREE_0 + free_sectors] = 3
    return Observation(
        stamp_ns=START_NS + round(t_s * 1e9),
        xyz_map_m=np.asarray(xyz_m, dtype=np.float64),
        vehicle_map_m=np.zeros(3),
        range_m=float(np.linalg.norm(xyz_m)),
        returns=returns,
        too_long=False,
        round_chords=0,
        rough_chords=0,
        isolation=isolation,
        large_object_m=math.inf,
    )


def beside_a_refused(away_m, after_s, parked=True, returns=1):
    """The candidate that appears beside something that was refused at once for want of free space."""
    stage = EvidenceDetect(parked=parked)
    stage._associate(stage._now, observation(1.0, (0.0, 20.0, 20.0), free_sectors=0, returns=returns))
    assert list(stage._now.table) == []
    stage._associate(stage._now, observation(1.0 + after_s, (away_m, 20.0, 20.0), returns=3))
    (candidate,) = stage._now.table
    return candidate


def test_beside_something_refused_lately_a_still_thing_is_less_likely_a_drone():
    beside, apart = beside_a_refused(1.0, 5.0), beside_a_refused(NEAR_REJECTED_M + 1.0, 5.0)
    assert "an object near it was rejected" in beside.reason
    assert "an object near it was rejected" not in apart.reason
    assert beside.log_odds < apart.log_odds
    (less, *_), (more, *_) = (over_clutter(c, ClassifierWeights(), True, True) for c in (beside, apart))
    assert more - less == pytest.approx(
        ClassifierWeights().near_rejected, abs=0.01
    )  # 1 m more to it is a hair farther away


@pytest.mark.parametrize(
    ("parked", "memory_s"), [(True, NEAR_REJECTED_NS * 1e-9), (False, 0.05 * NEAR_REJECTED_NS * 1e-9)]
)
def test_a_refused_place_is_forgotten_sooner_when_the_vehicles_motion_is_unknown(parked, memory_s):
    assert beside_a_refused(1.0, memory_s - 0.1, parked).near_rejected
    assert not beside_a_refused(1.0, memory_s + 0.1, parked).near_rejected


def test_rain_is_no_place_where_something_stands():
    stage = EvidenceDetect(parked=True)
    stage._associate(
        stage._now, observation(1.0, (0.0, 45.0, 45.0), free_sectors=SECTORS)
    )  # free all around, once, far away
    assert list(stage._now.table) == []
    assert dict(stage._now.rejected) == {"a false return": 1}
    assert stage._now.rejected_map.nearest_m(np.array([0.0, 45.0, 45.0]), 0.0, NEAR_REJECTED_M, START_NS) == math.inf


@pytest.mark.parametrize("told", [True, False])
def test_from_a_driving_vehicle_only_its_odometry_tells_what_stands_still(told):
    drives = (1.5, 0.0, 0.0)
    lamp = Ball(flying((2.0, 8.0, 10.0), (-1.5, 0.0, 0.0)), 0.2)  # in the world it stands
    candidates, detections = run([lamp], 2.0, drives_mps=drives if told else None)
    assert accepted_after_s(detections) == math.inf
    if told:
        assert "it may be static" in candidates[-1].reasons[0]


def jumping(at_s, by_m, silent_until_s=0.0):
    """What a parked vehicle's odometry tells whose start frame jumps, maybe after a silence."""

    def compare_motion(stage, t_s):
        if not at_s <= t_s < silent_until_s:
            jump = motion_at(t_s)
            stage.on_motion(dataclasses.replace(jump, xyz_map_m=np.asarray(by_m) * (t_s >= at_s)))

    return compare_motion


@pytest.mark.parametrize("by_m", [(1.2, 0.5, 0.0), (300.0, -40.0, 0.0)])
def test_where_the_vehicles_start_frame_jumps_nothing_is_lost_and_what_stands_has_not_moved(by_m):
    candidates, detections = run(
        [hanging()], 3.0, drives_mps=None, say=jumping(1.0, by_m), weights=ClassifierWeights(max_isolated_near=0.0)
    )
    assert {int(number) for told in candidates for number in told.candidate_id} == {1}
    assert accepted_after_s(detections) == math.inf
    assert "it may be static" in candidates[-1].reasons[0]
    assert candidates[-1].scan_passes[0] > 12
    _, detections = run([Drone(MOVING)], 4.0, drives_mps=None, say=jumping(1.0, by_m))
    assert accepted_after_s(detections) < 3.0


def test_where_it_jumped_in_a_silence_what_was_remembered_is_forgotten():
    stage = EvidenceDetect(sweep_deg=PASS_DEG, forget_s=0.5)
    run(
        [hanging()], 4.0, looking_away(1.5, 9.0), drives_mps=None, say=jumping(2.0, (300.0, 0.0, 0.0), 3.5), stage=stage
    )
    assert len(stage._now.static) == len(list(stage._now.table)) == 0
    stage = EvidenceDetect(sweep_deg=PASS_DEG, forget_s=0.5)
    run([hanging()], 4.0, looking_away(1.5, 9.0), drives_mps=None, say=jumping(2.0, (0.1, 0.0, 0.0), 3.5), stage=stage)
    assert len(stage._now.static) == 1


def test_what_leaves_is_forgotten():
    gone = During(hanging(), 0.0, 2.0)
    stage = EvidenceDetect(sweep_deg=PASS_DEG, forget_s=0.5)
    for pulses in pulses_seen([gone], WATCHING, 4.0):
        list(stage.on_pulses(pulses))
    assert list(stage._now.table) == []
    assert stage._now.watches == {}


def test_without_free_space_the_sectors_are_not_even_named():
    candidates, _ = run([hanging()], 2.0, free_space=False)
    assert "sectors" not in reasons_of(candidates)


def test_the_same_pulses_give_the_same_answers():
    once, again = (run([Drone(still(*PLACE_M), seed=1)], 1.5) for _ in range(2))
    for a, b in zip(once[0] + once[1], again[0] + again[1], strict=True):
        assert a.reasons == b.reasons
    for a, b in zip(once[0], again[0], strict=True):
        np.testing.assert_array_equal(a.probability, b.probability)
    for a, b in zip(once[1], again[1], strict=True):
        np.testing.assert_array_equal(a.evidence.probability, b.evidence.probability)
        np.testing.assert_array_equal(a.xyz_vehicle_m, b.xyz_vehicle_m)


def test_a_slice_without_pulses_is_nothing():
    (pulses,) = list(pulses_seen([], WATCHING, 0.0014, mount=ON_ITS_SIDE))[:1]
    for name in ("point_stamp_ns", "direction_vehicle", "range_m", "laser", "reflectivity"):
        object.__setattr__(pulses, name, getattr(pulses, name)[:0])
    assert list(EvidenceDetect().on_pulses(pulses)) == []


@pytest.mark.parametrize(
    "settings",
    [
        {"span_m": 0.0},
        {"accept_probability": 1.0},
        {"follow_up_probability": 0.6},
        {"report_s": 0.0},
        {"weights": {"luck": 1}},
    ],
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises(ValidationError):
        EvidenceDetect(**settings)


def test_a_lamp_that_was_refused_at_first_sight_is_not_told_anew_while_the_drone_says_that_it_flies():
    """It is seen in each passing; who looks at it once more has less time for the drone."""

    def told_again(way, again):
        stage = EvidenceDetect(sweep_deg=PASS_DEG, weights=ClassifierWeights(revisited=again))
        stage._now.rejected_map.add(np.array([PLACE_M]), START_NS)
        candidates, _ = run([hanging()], 0.5, say=saying(way), stage=stage)
        return sum(c.candidate_id.size > 0 for c in candidates)

    flies = flying((0.0, 0.0, 0.0), (3.0, 0.0, 0.0))
    assert told_again(flies, 4.0) == 0 < told_again(flies, 0.0)
    assert told_again(still(0.0, 0.0, 0.0), 4.0) > 0


@pytest.mark.parametrize(("step_m", "remembered"), [(0.0, True), (0.5, False)])
def test_only_static_candidates_are_remembered_as_rejected_objects(step_m, remembered):
    """A rejected candidate that moved, a bird say, leaves nothing behind where it was."""
    path = [observation(0.1 * k, (step_m * k, 20.0, 20.0)) for k in range(6)]
    c = candidate(*path)
    c.alternative = Alternative.STATIC
    stage = EvidenceDetect(parked=True)
    stage._remember_rejected(stage._now, c)
    nearest_m = stage._now.rejected_map.nearest_m(c.xyz_m, 0.0, NEAR_REJECTED_M, START_NS)
    assert math.isfinite(nearest_m) == remembered
