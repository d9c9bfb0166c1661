"""EvidenceDetect on synthetic skies: it accepts a drone that moves as its telemetry, and rejects the rest.

The skies are made by tests/stages/caster.py; the shipped model was not trained on them.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

from flow.message import check_arrays
from flow.stage import input_ports, output_ports
from links.evaluation.stage_metrics import PROBABILITY_EDGES
from stages.detect import EvidenceDetect
from stages.detect.candidate import Alternative, Observation
from stages.detect.candidate_messages import detections_message, log_odds_of
from stages.detect.evidence_detect import HYSTERESIS_NATS, STATIC_NS
from stages.detect.rejected import RejectedObservations
from stages.detect.trained.features import NAMES, VERSION
from stages.detect.trained.model import DetectorModel, Prediction
from stages.geometry.frames import rotation_from_rpy_deg, rotation_z
from stages.geometry.trajectory import VehicleTrajectory
from stages.kernels.detect.first_observations import NEAR_REJECTED_M, NEAR_REJECTED_NS
from stages.kernels.detect.isolation import FREE_0, SECTORS, TALLY
from stages.messages import (
    CandidateEvidence,
    CandidateLog,
    Candidates,
    Detections,
    DroneLocalPosition,
    DroneMotion,
    DroneOdometry,
    SearchResult,
    VehicleMotion,
)
from stages.odometry.drone.autopilot_estimate import GRAVITY_MPS2
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
from tests.stages.detect.shipped import detector, shipped_model
from tests.stages.detect.test_candidate import candidate
from tests.stages.made import ON_ITS_SIDE, START_NS

TERM = {"alternative": 3, "feature": "range_m", "knots": (0.0, 1.0), "values": (0.0, -4.0)}
PLACE_M = (0.0, 8.0, 10.0)  # 12.7 m away, 51 deg up
NEIGHBOUR_M = (0.0, 11.0, 10.0)
WATCHING = dithering(half_rad=math.radians(1.0))  # as the aim stage does: a beam comes near in each rotor turn
PASS_DEG = 4.5  # each swing completes a pass: a message every 0.4 s
MOVING = flying((-0.8, 8.0, 10.0), (0.8, 0.0, 0.4))
GLIDING = flying((-4.5, 8.0, 10.0), (3.0, 0.0, 0.0))  # possible for a drone and for a bird


def hovering(seed=0):
    return Drone(still(*PLACE_M), seed=seed)


def motion_at(t_s, velocity_mps=(0.0, 0.0, 0.0)):
    return VehicleMotion(
        stamp_ns=START_NS + round(t_s * 1e9),
        xyz_map_m=t_s * np.asarray(velocity_mps, dtype=np.float64),
        R_map_vehicle=np.eye(3),
        covariance=None,
    )


def drone_motion(t_s):
    """An IMU interval of a drone without acceleration."""
    return DroneMotion(
        stamp_ns=START_NS + round(1e9 * t_s),
        start_ns=START_NS + round(1e9 * t_s) - 20_000_000,
        segment=0,
        specific_force_drone_mps2=np.array([0.0, 0.0, GRAVITY_MPS2]),
        angular_velocity_drone_radps=np.zeros(3),
        specific_force_noise=np.full(3, 0.01),
        angular_velocity_noise=np.full(3, 0.001),
        up_drone=np.array([0.0, 0.0, 1.0]),
        autopilot=None,
    )


def test_the_vehicles_motion_is_unknown_after_a_pause_of_its_odometry():
    stage = detector()
    assert not stage._motion_known(START_NS)
    stage.on_motion(motion_at(0.0))
    assert stage._motion_known(START_NS + 600_000_000)
    assert not stage._motion_known(START_NS + 800_000_000)
    assert detector(parked=True)._motion_known(START_NS)


def test_an_accepted_candidate_is_published_though_its_last_observation_precedes_the_interval():
    c = candidate(observation(0.0, np.array(PLACE_M)))
    c.accepted, c.log_odds, c.reason = True, 6.0, "made"
    later_ns = c.seen_ns + 5_000_000
    messages = detections_message([c], VehicleTrajectory(), later_ns, later_ns + 1, Counter(), 3)
    assert messages.accepted.tolist() == [True]
    c.announced = True
    messages = detections_message([c], VehicleTrajectory(), later_ns, later_ns + 1, Counter(), 3)
    assert messages.accepted.tolist() == []


def local_position(trajectory, t_s, yaw_rad=0.9):
    """Local position of the drone's autopilot along a trajectory, in its own frame."""
    R = rotation_z(yaw_rad)
    position_m, soon = trajectory(np.array([t_s, t_s + 0.01]))
    return DroneLocalPosition(
        stamp_ns=START_NS + round(t_s * 1e9),
        xyz_odom_m=R @ position_m + (30.0, -4.0, 5.0),
        velocity_odom_mps=R @ (soon - position_m) / 0.01,
    )


def odometry(trajectory, t_s, R_odom_drone):
    """The same as odometry, with the velocity in drone axes."""
    position = local_position(trajectory, t_s)
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


def run(*args, **kwargs):
    """(Candidates, Detections) of `all_messages`."""
    messages = all_messages(*args, **kwargs)
    return [m for m in messages if isinstance(m, Candidates)], [m for m in messages if isinstance(m, Detections)]


def all_messages(
    things, seconds=3.0, servo_rad=WATCHING, drives_mps=(0.0, 0.0, 0.0), publish=None, stage=None, packets=1, **settings
):
    """What the stage publishes.

    drives_mps None: no vehicle motion. publish(stage, t_s): publishes the drone's telemetry, each 20 ms.
    """
    stage = stage or detector(**{"sweep_deg": PASS_DEG, **settings})
    messages, next_s = [], 0.0
    for pulses in together(pulses_seen(things, servo_rad, seconds), packets):
        while START_NS + next_s * 1e9 <= pulses.point_stamp_ns[-1]:
            if drives_mps is not None:
                stage.on_motion(motion_at(next_s, drives_mps))
            if publish is not None:
                publish(stage, next_s)
            next_s += 0.02
        messages += stage.on_pulses(pulses)
    for message in messages:
        check_arrays(message)
    return messages


def feature(messages, name):
    """A feature of all classified candidates (n,), in order of time; NaN: not available."""
    return np.concatenate([m.features[:, NAMES.index(name)] for m in messages if isinstance(m, CandidateLog)])


def telemetry_of(trajectory, until_s=math.inf, yaw_rad=0.9):
    return lambda stage, t_s: (
        stage.on_drone_position(local_position(trajectory, t_s, yaw_rad)) if t_s < until_s else None
    )


HOVERS = telemetry_of(still(*PLACE_M))
LENIENT = {"publish": HOVERS, "accept_probability": 0.5}  # with it a hovering drone is accepted within a second


def accepted_after_s(detections):
    """Time of the first accepted detection; inf: none."""
    return next(((d.stamp_ns - START_NS) * 1e-9 for d in detections if d.accepted.any()), math.inf)


def most_probable(candidates):
    """The highest probability of any candidate."""
    return max((float(c.probability.max(initial=0.0)) for c in candidates), default=0.0)


def reasons_of(candidates):
    return " | ".join(reason for messages in candidates for reason in messages.reasons)


def test_ports_are_what_the_graph_wires():
    optional = {"motion", "drone_position", "drone_odometry", "drone_motion", "cue"}
    assert set(input_ports(EvidenceDetect)) == {"pulses", *optional}
    assert set(output_ports(EvidenceDetect)) == {"candidate_log", "candidates", "detections", "cue_state"}
    assert EvidenceDetect.optional_inputs == optional


@pytest.mark.parametrize("seed", range(2))
def test_a_small_moving_object_in_the_free_sky_is_accepted_within_seconds(seed):
    candidates, detections = run([Drone(MOVING, seed=seed)], publish=telemetry_of(MOVING))
    assert 0.4 < accepted_after_s(detections) < 3.0
    last = detections[-1]
    assert last.accepted.tolist() == [True]
    evidence = last.evidence
    assert isinstance(evidence, CandidateEvidence)
    assert most_probable(candidates) >= 0.95
    assert evidence.log_odds[0] == pytest.approx(math.log(evidence.probability[0] / (1 - evidence.probability[0])))
    truth = MOVING(np.array([(evidence.seen_ns[0] - START_NS) * 1e-9]))[0]
    np.testing.assert_allclose(last.xyz_vehicle_m[0], truth, atol=0.3)
    np.testing.assert_allclose(evidence.velocity_vehicle_mps[0], (0.8, 0.0, 0.4), atol=0.6)
    assert last.summary.startswith("drone at (")
    assert last.result is SearchResult.DRONE
    assert candidates[-1].accept_probability == detector().settings.accept_probability
    assert re.search(r"moves as the drone's odometry, not as a balloon: .* \(\+", last.reasons[0])
    assert evidence.candidate_id[0] == candidates[0].candidate_id[0]  # the same object keeps its number


@pytest.mark.parametrize("packets", [4, 8])
def test_slices_of_several_packets_give_the_same_result_as_single_packets(packets):
    drives_mps = (5.0, 0.0, 0.0)  # and so does the drone
    publish = telemetry_of(flying((-0.8, 8.0, 10.0), (5.8, 0.0, 0.4)))
    (candidates, one), (together, several) = (
        run([Drone(MOVING)], drives_mps=drives_mps, packets=n, publish=publish) for n in (1, packets)
    )
    assert accepted_after_s(one) < 3.0
    assert accepted_after_s(several) == pytest.approx(accepted_after_s(one), abs=0.1)
    assert together[-1].scan_passes[0] == candidates[-1].scan_passes[0]
    assert together[-1].seen_ns[0] == pytest.approx(candidates[-1].seen_ns[0], abs=1e6)
    np.testing.assert_allclose(together[-1].xyz_vehicle_m[0], candidates[-1].xyz_vehicle_m[0], atol=0.03)


def predicted(log_odds, monkeypatch):
    """From now on the model gives these log-odds."""
    monkeypatch.setattr(DetectorModel, "predict", lambda *_: Prediction(log_odds, 0, np.zeros(len(NAMES))))


def test_the_evaluation_groups_probabilities_at_the_detectors_threshold():
    assert PROBABILITY_EDGES[-2] == EvidenceDetect.settings_type.model_fields["accept_probability"].default


def test_acceptance_has_a_hysteresis(monkeypatch):
    stage, c = detector(), candidate(observation(0.0, np.array(PLACE_M)))
    accept = log_odds_of(stage.settings.accept_probability)
    verdicts = []
    for log_odds in (
        accept - 0.1,
        accept + 0.1,
        accept - HYSTERESIS_NATS + 0.1,
        accept - HYSTERESIS_NATS - 0.1,
        accept - 0.1,
    ):
        predicted(log_odds, monkeypatch)
        stage._classify(stage._now, c)
        verdicts.append(c.accepted)
    assert verdicts == [False, True, True, False, False]
    assert accept - HYSTERESIS_NATS > 0.0  # more probably a drone than not
    assert HYSTERESIS_NATS > 1.0


def test_the_probability_is_published_from_the_first_scan_passes_and_grows():
    candidates, _ = run([Drone(MOVING)], publish=telemetry_of(MOVING))
    assert (candidates[0].stamp_ns - START_NS) * 1e-9 < 0.6
    probability = [float(c.probability[0]) for c in candidates]
    assert probability[0] < 0.5 < 0.95 < probability[-1]
    assert candidates[-1].scan_passes[0] > 15


@pytest.mark.parametrize("seed", range(3))
def test_a_hovering_drone_at_close_range_is_accepted_once_a_support_would_be_visible(seed):
    _, detections = run([hovering(seed)], 4.2, publish=HOVERS)
    assert 1.0 < accepted_after_s(detections) < 4.0
    _, detections = run([hovering(seed)], 4.2, publish=HOVERS, free_space=False)
    assert accepted_after_s(detections) == math.inf


def test_of_two_objects_that_both_hover_as_the_drone_neither_is_accepted():
    other = Drone(still(0.0, -8.0, 10.0), seed=1)
    assert accepted_after_s(run([hovering()], 4.2, publish=HOVERS)[1]) < 4.2
    candidates, detections = run([hovering(), other], 4.2, publish=HOVERS)
    assert accepted_after_s(detections) == math.inf
    assert candidates[-1].probability.sum() < 1.1  # each is as of its own last observation
    assert len(candidates[-1].probability) == 2
    assert all(re.search(r"; other candidates -\d", reason) for reason in candidates[-1].reasons)


@pytest.mark.parametrize(
    ("accept_probability", "others", "drone_accepted"),  # log-odds of the other candidate; the drone has 5
    [(0.95, (-1.0, 7.5, 8.5), [True, True, False]), (0.5, (4.5, 6.5, 7.5), [True, True, False])],
)
def test_the_drone_stays_accepted_until_another_candidate_would_be_accepted_in_its_place(
    accept_probability, others, drone_accepted, monkeypatch
):
    stage = detector(accept_probability=accept_probability)
    drone, other = (
        candidate(observation(0.0, place_m), observation(0.1, place_m)) for place_m in (PLACE_M, NEIGHBOUR_M)
    )
    other.number = 2
    accepted = []
    for log_odds in others:
        for c, nats in ((other, log_odds), (drone, 5.0), (other, log_odds)):
            predicted(nats, monkeypatch)
            stage._classify(stage._now, c)
            stage._now.table.put(c)
        accepted.append(drone.accepted)
    assert accepted == drone_accepted
    assert other.accepted


def test_candidates_name_the_detector_instance():
    stage = detector(sweep_deg=PASS_DEG)
    whole, _ = run([hovering()], 1.5, stage=stage)
    assert {m.detector_instance for m in whole} == {START_NS}
    later = [p for p in pulses_seen([hovering()], WATCHING, 1.5) if p.stamp_ns > START_NS + 700_000_000]
    afresh = detector(sweep_deg=PASS_DEG)
    messages = [m for p in later for m in afresh.on_pulses(p) if isinstance(m, Candidates)]
    assert {m.detector_instance for m in messages} == {later[0].stamp_ns}


def test_at_long_range_a_hovering_drone_stays_a_candidate_because_a_wire_is_invisible():
    far_m = 2.6 * np.array(PLACE_M)
    candidates, detections = run([Drone(still(*far_m), span_m=0.9)], 4.2, span_m=0.9, publish=HOVERS)
    assert accepted_after_s(detections) == math.inf
    assert 0.5 < most_probable(candidates) < 0.95


SUPPORTS = {
    "on a pole": (Wire((0.0, 8.0, 0.0), (0.0, 8.0, 9.9), 0.08), "objects next to it"),
    "nearby a wall": (Box((0.7, 6.0, 0.0), (1.2, 12.0, 14.0)), "a lamp, wire or edge"),
    "on a wire": (Wire((-20.0, 8.0, 10.0), (20.0, 8.0, 10.0), 0.03), "short returns rejected at once"),
}


@pytest.mark.parametrize("where", SUPPORTS)
def test_the_same_object_with_a_support_is_rejected_with_a_reason(where):
    other, phrase = SUPPORTS[where]
    candidates, detections = run([hovering(), other], 3.0, **LENIENT)
    assert accepted_after_s(detections) == math.inf
    assert len(detections) >= 6
    remarks = reasons_of(candidates) + " | ".join(d.summary for d in detections)
    assert phrase in remarks, remarks
    assert all(d.summary.startswith("no drone: ") for d in detections)


def test_chords_hidden_by_a_nearer_object_are_counted():
    edge = Box((-3.0, 4.0, 0.0), (3.0, 4.1, 5.2))  # a nearer wall that covers its lower half
    _, detections = run([Drone(still(*PLACE_M)), edge], 2.0, **LENIENT)
    assert accepted_after_s(detections) == math.inf
    assert any("hidden at an end by something nearer" in d.summary for d in detections)


def test_objects_far_behind_do_not_matter():
    wall = Box((-12.0, 16.0, 0.0), (12.0, 17.0, 30.0))
    _, detections = run([Drone(MOVING), wall], publish=telemetry_of(MOVING))
    assert accepted_after_s(detections) < 3.0


def test_a_wire_alone_is_never_a_drone():
    _, detections = run([Wire((-20.0, 8.0, 10.0), (20.0, 8.0, 10.0), 0.02)], 3.0, **LENIENT)
    assert accepted_after_s(detections) == math.inf


def test_a_single_false_return_is_a_candidate_for_a_short_time_only():
    false_return = During(Ball(still(*PLACE_M), 0.02), 0.4, 0.6)
    candidates, detections = run([false_return], 2.0, **LENIENT)
    assert accepted_after_s(detections) == math.inf
    assert not candidates or candidates[-1].candidate_id.size == 0 or candidates[-1].probability.max() < 0.1


def test_rain_is_never_a_drone():
    class Rain:
        """Each pulse meets a drop, somewhere, once in 2000."""

        rng = np.random.default_rng(8)

        def range_m(self, origin_m, direction, t_s):
            n = len(t_s)
            return np.where(self.rng.random(n) < 0.0005, self.rng.uniform(2.0, 25.0, n), np.inf)

    _, detections = run([Rain()], 3.0, **LENIENT)
    assert accepted_after_s(detections) == math.inf


def test_a_smooth_ball_is_a_balloon_and_a_fast_object_a_bird():
    drone, _ = run([Drone(MOVING)])
    balloon, _ = run([Ball(MOVING, 0.25)])
    assert most_probable(balloon) < 0.5 * most_probable(drone)
    assert "if not a drone: a balloon" in balloon[-1].reasons[0]
    bird, _ = run([Drone(flying((-15.0, 8.0, 10.0), (12.0, 0.0, 0.0)), span_m=0.4)])
    assert most_probable(bird) < 0.1 * most_probable(drone)
    assert "if not a drone: a bird" in bird[-1].reasons[0]


def test_each_pass_without_a_drone_publishes_empty_detections():
    candidates, detections = run([], 2.0)
    assert candidates == []
    assert len(detections) >= 3
    assert all(d.summary.startswith("no drone: ") and len(d.accepted) == 0 for d in detections)


def test_the_searched_intervals_are_contiguous():
    for things in ([], [hovering()]):
        _, detections = run(things, 2.0, **LENIENT)
        assert math.isfinite(accepted_after_s(detections)) == bool(things)
        assert detections[0].evidence.start_ns == START_NS
        for before, after in pairwise(detections):
            assert before.evidence.start_ns < before.stamp_ns
            assert after.evidence.start_ns == before.stamp_ns + 1


def test_a_sweep_over_houses_reports_the_number_of_rejected_objects():
    street = [Box((-9, -40, 0), (-7, 40, 9)), Box((7, -40, 0), (9, 40, 9)), Wire((7.5, 0, 0), (5.0, 0, 11), 0.1)]
    _, detections = run(street, 3.3, servo_rad=sweeping(), sweep_deg=180.0, **LENIENT)
    assert accepted_after_s(detections) == math.inf
    ends_s = [(d.stamp_ns - START_NS) * 1e-9 for d in detections]
    assert ends_s == pytest.approx([1.475, 2.95], abs=0.02)  # 177 deg at 120 deg/s, each
    assert "short returns rejected at once" in detections[0].summary


# telemetry of the drone


@pytest.mark.parametrize(
    ("driving", "settings"),
    [(False, {}), (True, {"free_space": False})],
    ids=["parked, all features", "driving, without free space"],
)
def test_first_observations_are_rejected_together_as_one_by_one_with_candidates(driving, settings, monkeypatch):
    drives_mps = (2.0, 0.0, 0.0) if driving else (0.0, 0.0, 0.0)
    poles = [Wire((k - 6, 9, 0), (k - 6, 9, 6 + k % 3), 0.1) for k in range(12)]

    def flown():
        things = [*poles, Wire((-8, 6, 7), (8, 6, 7.5), 0.02), Drone(MOVING)]
        return all_messages(things, 4.0, sweeping(), drives_mps, telemetry_of(MOVING), **settings)

    together_ = flown()
    monkeypatch.setattr(RejectedObservations, "add_first", lambda _self, _s, begin, *_: (begin, [], None))
    one_by_one = flown()
    assert sum(len(m.candidate_id) for m in together_ if isinstance(m, CandidateLog)) > 200
    assert [type(m) for m in together_] == [type(m) for m in one_by_one]
    for a, b in zip(together_, one_by_one, strict=True):
        if isinstance(a, CandidateLog):
            np.testing.assert_array_equal(a.candidate_id, b.candidate_id)
            np.testing.assert_array_equal(a.features, b.features)
            np.testing.assert_array_equal(a.probability, b.probability)
        elif isinstance(a, Detections):
            assert a.summary == b.summary


def test_the_yaw_of_the_odometrys_frame_does_not_matter():
    messages = [
        run([Drone(MOVING)], 2.0, publish=telemetry_of(MOVING, yaw_rad=yaw), accept_probability=0.5)
        for yaw in (0.0, math.pi / 2, 0.13)
    ]
    at_s = [accepted_after_s(detections) for _, detections in messages]
    assert at_s[1] == at_s[0] < 2.0
    assert at_s[2] == pytest.approx(at_s[0], abs=0.3)
    assert messages[1][0][-1].probability == pytest.approx(messages[0][0][-1].probability, abs=1e-9)


@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0, 0.0), (20.0, -10.0, 130.0)])
def test_the_odometry_is_used_for_any_attitude_of_the_drone(tilt_deg):
    R = rotation_from_rpy_deg(tilt_deg)
    by_position, _ = run([Drone(MOVING)], publish=telemetry_of(MOVING))
    by_odometry, detections = run([Drone(MOVING)], publish=lambda s, t: s.on_drone_odometry(odometry(MOVING, t, R)))
    assert accepted_after_s(detections) < 3.0
    for a, b in zip(by_position, by_odometry, strict=True):
        np.testing.assert_allclose(a.probability, b.probability, atol=1e-9)
        np.testing.assert_allclose(a.velocity_vehicle_mps, b.velocity_vehicle_mps, atol=1e-6)


def test_an_object_that_passes_while_the_drone_hovers_is_a_bird():
    _, own = run([Drone(GLIDING, span_m=0.5)], publish=telemetry_of(GLIDING))
    assert accepted_after_s(own) < 2.5  # nothing else separates it from a drone
    candidates, detections = run([Drone(GLIDING, span_m=0.5)], publish=telemetry_of(still(0.0, 0.0, 0.0)))
    assert accepted_after_s(detections) == math.inf
    assert candidates[-1].probability.max() < 0.05
    assert "if not a drone: a bird" in candidates[-1].reasons[0]


SHOWN_S = ((0.0, 0.1), (1.5, 1.8))  # a scan pass, and some more a pass of the fan later
PASSING_BY = flying((-3.0, 8.0, 10.0), (3.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("publish", "reacquired"), [(telemetry_of(PASSING_BY), True), (None, False)], ids=["telemetry", "no telemetry"]
)
def test_a_drone_reacquired_a_pass_later_keeps_its_evidence(publish, reacquired):
    shown = [During(Drone(PASSING_BY, seed=i), *when) for i, when in enumerate(SHOWN_S)]
    messages = all_messages(shown, seconds=2.0, publish=publish)
    assert np.isfinite(feature(messages, "passes_since_reacquired")).any() == reacquired


def test_after_one_scan_pass_the_candidate_has_the_undirected_speed_of_the_telemetry():
    for publish, speed_mps in ((telemetry_of(PASSING_BY), 3.0), (None, 0.0)):
        candidates, _ = run([Drone(PASSING_BY)], seconds=1.0, publish=publish)
        once = [messages.undirected_speed_mps[messages.scan_passes == 1] for messages in candidates]
        more = [messages.undirected_speed_mps[messages.scan_passes > 1] for messages in candidates]
        np.testing.assert_allclose(np.concatenate(once), speed_mps, atol=0.01)
        assert np.concatenate(once).size
        assert not np.concatenate(more).any()


def test_a_lamp_is_rejected_while_the_drone_flies_and_not_while_it_hovers():
    flies = telemetry_of(flying((0.0, 0.0, 0.0), (3.0, 0.0, 0.0)))
    candidates, detections = run([hovering()], publish=flies)
    assert accepted_after_s(detections) == math.inf
    assert candidates[-1].candidate_id.size == 0 or candidates[-1].probability.max() < 0.02
    _, detections = run([hovering()], 4.2, publish=telemetry_of(still(0.0, 0.0, 0.0)))
    assert accepted_after_s(detections) < 4.0


def test_a_smooth_balloon_is_rejected_though_it_follows_the_odometry():
    candidates, detections = run([Ball(MOVING, 0.25)], publish=telemetry_of(MOVING))
    assert accepted_after_s(detections) == math.inf
    assert "if not a drone: a balloon" in candidates[-1].reasons[0]
    different, _ = run([Ball(MOVING, 0.25)], publish=telemetry_of(flying((0.0, 0.0, 0.0), (3.0, 0.0, -0.5))))
    assert different[-1].candidate_id.size == 0 or different[-1].probability[0] < 0.1 * candidates[-1].probability[0]


def test_observations_before_the_first_telemetry_do_not_disable_it():
    def late(stage, t_s):
        if t_s > 0.8:
            stage.on_drone_position(local_position(MOVING, t_s))

    over_bird = feature(all_messages([Drone(MOVING)], publish=late), "over_bird_nats")
    assert np.isnan(over_bird[0])
    assert over_bird[-1] > 3.0


def test_after_telemetry_ends_its_evidence_so_far_remains():
    spoke, silent = (all_messages([Drone(MOVING)], publish=p) for p in (telemetry_of(MOVING, until_s=0.9), None))
    assert feature(spoke, "over_bird_nats")[-1] > 1.0
    assert np.isnan(feature(silent, "over_bird_nats")).all()
    last = [[m.velocity_vehicle_mps for m in messages if isinstance(m, Candidates)][-1] for messages in (spoke, silent)]
    np.testing.assert_array_equal(*last)


AGREES = re.compile(r"moves as the drone's odometry, not as a \w+: .* \(\+")
CONTRADICTS = re.compile(r"moves as the drone's odometry, not as a \w+: -\S+ \(-")
FLIES_ON = flying((-2.4, 8.0, 10.0), (1.0, 0.0, 0.4))
OTHERS = flying((0.0, 0.0, 0.0), (-3.0, 2.0, -0.8))


def followed(publish, seconds=5.0, **settings):
    """(time [s], probability, reason) of the most probable candidate in each message, with this telemetry."""
    candidates, _ = run([Drone(FLIES_ON)], seconds, publish=publish, **settings)
    listed = [m for m in candidates if len(m.probability)]
    return [((m.stamp_ns - START_NS) * 1e-9, float(m.probability[0]), m.reasons[0]) for m in listed]


def switching(first, second, at_s):
    """Telemetry of one trajectory and then of another, None: silence; the position is continuous."""

    def publish(stage, t_s):
        trajectory = first if t_s < at_s else second
        if trajectory is None:
            return
        position = local_position(trajectory, t_s)
        if first is not None and t_s >= at_s:
            change_m = local_position(first, at_s).xyz_odom_m - local_position(second, at_s).xyz_odom_m
            position = dataclasses.replace(position, xyz_odom_m=position.xyz_odom_m + change_m)
        stage.on_drone_position(position)

    return publish


def test_telemetry_that_lies_mid_flight_makes_the_drone_improbable_within_seconds():
    true, lies = followed(telemetry_of(FLIES_ON)), followed(switching(FLIES_ON, OTHERS, 2.0))
    assert all(p > 0.95 for t, p, _ in true if t > 2.5)
    assert all(p > 0.8 for t, p, _ in lies if 1.5 < t < 2.0)
    after = [(p, reason) for t, p, reason in lies if t > 4.0]
    assert after
    assert all(p < 0.1 and CONTRADICTS.search(reason) for p, reason in after)


def test_telemetry_that_starts_mid_flight_counts_within_seconds():
    starts = followed(switching(None, FLIES_ON, 2.0))
    assert not any(AGREES.search(reason) for t, _, reason in starts if t < 2.0)
    after = [(p, reason) for t, p, reason in starts if t > 3.5]
    assert after
    assert all(AGREES.search(reason) for _, reason in after)
    assert min(p for p, _ in after) > 0.9
    assert max(p for t, p, _ in starts if t < 2.0) < 0.7


def test_telemetry_of_another_drone_that_starts_mid_flight_is_noticed_within_seconds():
    lies = followed(switching(None, OTHERS, 2.0))
    after = [(p, reason) for t, p, reason in lies if t > 4.0]
    assert all(p < 0.1 and CONTRADICTS.search(reason) for p, reason in after) or not after


def test_after_telemetry_stops_mid_flight_the_drone_is_still_the_drone():
    stops = followed(switching(FLIES_ON, None, 1.0))
    after = [(p, reason) for t, p, reason in stops if t > 3.5]
    assert after
    assert all(p > 0.9 and AGREES.search(reason) for p, reason in after)


def test_a_drone_first_seen_after_telemetry_stopped_is_weighed_by_its_path():
    stage = detector(sweep_deg=PASS_DEG)
    for k in range(50):
        stage.on_drone_position(local_position(FLIES_ON, 0.02 * k - 3.0))
    messages = all_messages([Drone(FLIES_ON)], 3.0, stage=stage)
    assert feature(messages, "scan_passes")[-1] > 8.0
    assert np.isnan(feature(messages, "over_bird_nats")).all()


def test_without_vehicle_motion_only_heights_are_compared():
    rising = flying((0.0, 0.0, 0.0), (0.0, 0.0, 1.5))
    passes_and_rises = Drone(flying((-2.0, 8.0, 8.0), (1.5, 0.0, 1.5)))
    settings = {"drives_mps": None, "publish": telemetry_of(rising), "accept_probability": 0.5}
    candidates, detections = run([passes_and_rises], 2.5, **settings)
    assert accepted_after_s(detections) < 1.0
    assert AGREES.search(candidates[-1].reasons[0])
    stays_level = Drone(flying((-2.0, 8.0, 10.0), (1.5, 0.0, 0.0)))
    candidates, detections = run([stays_level], 2.5, **settings)
    assert accepted_after_s(detections) == math.inf
    assert candidates[-1].probability.max(initial=0.0) < 0.1


def test_a_candidate_observed_twice_has_the_speed_of_the_telemetry():
    """At first its velocity is uncertain by some metres per second; a hovering drone is predicted to stay."""
    hovers, _ = run([hovering()], 0.5, publish=telemetry_of(still(0.0, 0.0, 0.0)))
    flies, _ = run([hovering()], 0.5, publish=telemetry_of(flying((0.0, 0.0, 0.0), (8.0, 0.0, 2.0))))
    first_hovers, first_flies = hovers[0].velocity_vehicle_mps[0], flies[0].velocity_vehicle_mps[0]
    assert np.abs(first_hovers).max() < 0.02
    assert first_flies[2] == pytest.approx(2.0, abs=1.5)  # it rises as the telemetry does


# static objects


def looking_away(from_s, to_s):
    """Observes the same direction, except for some seconds."""
    return lambda t_s: WATCHING(t_s) + np.where((np.asarray(t_s) > from_s) & (np.asarray(t_s) < to_s), 0.8, 0.0)


def test_a_static_object_is_reactivated():
    stage = detector(sweep_deg=PASS_DEG, forget_s=0.5)
    candidates, _ = run([hovering()], 4.5, looking_away(1.5, 3.0), stage=stage)
    numbers = {int(number) for messages in candidates for number in messages.candidate_id}
    assert numbers == {1}
    messages = [c for c in candidates if c.candidate_id.size]
    before = max(c.scan_passes[0] for c in messages if c.stamp_ns < START_NS + 2e9)
    again = next(c for c in messages if c.stamp_ns > START_NS + 2.9e9)
    assert again.scan_passes[0] > before > 5
    assert len(stage._now.static) == 0  # it is a candidate again


def test_static_objects_need_vehicle_motion_and_moving_ones_are_not_remembered():
    stage = detector(sweep_deg=PASS_DEG, forget_s=0.5)
    run([hovering()], 2.5, looking_away(1.5, 9.0), drives_mps=None, stage=stage)
    assert list(stage._now.table) == []
    assert len(stage._now.static) == 0
    stage = detector(sweep_deg=PASS_DEG, forget_s=0.5)
    run([Drone(MOVING)], 2.5, looking_away(1.5, 9.0), stage=stage)
    assert list(stage._now.table) == []
    assert len(stage._now.static) == 0


def test_static_objects_are_forgotten_after_a_minute():
    stage = detector(sweep_deg=PASS_DEG, forget_s=0.5, parked=True)
    run([hovering()], 2.5, looking_away(1.5, 9.0), stage=stage)
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


def near_a_rejected(away_m, after_s, parked=True):
    """The classification of one that appears next to an object that was rejected as a part of a large one."""
    stage = detector(parked=parked)
    part = observation(1.0, (0.0, 20.0, 20.0), free_sectors=0)
    stage._associate(stage._now, dataclasses.replace(part, large_object_m=1.0))
    assert list(stage._now.table) == []
    stage._associate(stage._now, observation(1.0 + after_s, (away_m, 20.0, 20.0), returns=3))
    return stage._now.classified[2]


def test_near_a_recently_rejected_object_a_static_candidate_is_less_probable():
    nearby, distant = near_a_rejected(1.0, 5.0), near_a_rejected(NEAR_REJECTED_M + 1.0, 5.0)
    assert [c.features[NAMES.index("near_rejected")] for c in (nearby, distant)] == [1.0, 0.0]
    assert nearby.log_odds < distant.log_odds


@pytest.mark.parametrize(
    ("parked", "memory_s"), [(True, NEAR_REJECTED_NS * 1e-9), (False, 0.05 * NEAR_REJECTED_NS * 1e-9)]
)
def test_a_rejected_position_is_forgotten_sooner_without_vehicle_motion(parked, memory_s):
    remembered, forgotten = near_a_rejected(1.0, memory_s - 0.1, parked), near_a_rejected(1.0, memory_s + 0.1, parked)
    assert [c.features[NAMES.index("near_rejected")] for c in (remembered, forgotten)] == [1.0, 0.0]


@pytest.mark.parametrize("alternative", Alternative)
def test_only_static_objects_leave_a_rejected_position(alternative):
    """Rain, a bird or a balloon does not."""
    priors = [(-9.0, -9.0) if one is alternative else (9.0, 9.0) for one in Alternative]
    stage = detector(parked=True, model={"feature_version": VERSION, "priors": priors, "terms": [TERM]})
    stage._associate(stage._now, observation(1.0, (0.0, 45.0, 45.0)))
    assert list(stage._now.table) == []
    assert dict(stage._now.rejected.kinds) == {alternative.value: 1}
    nearest_m = stage._now.rejected.static_map.nearest_m(np.array([0.0, 45.0, 45.0]), 0.0, NEAR_REJECTED_M, START_NS)
    assert math.isfinite(nearest_m) == (alternative is Alternative.STATIC)


@pytest.mark.parametrize("messages", [True, False])
def test_from_a_driving_vehicle_static_objects_need_its_odometry(messages):
    drives = (1.5, 0.0, 0.0)
    lamp = Ball(flying((2.0, 8.0, 10.0), (-1.5, 0.0, 0.0)), 0.2)  # static in frame map
    found = all_messages([lamp], 2.0, drives_mps=drives if messages else None, accept_probability=0.5)
    assert accepted_after_s([m for m in found if isinstance(m, Detections)]) == math.inf
    assert not feature(found, "moves").any()
    assert (feature(found, "straight_mps")[-1] < 0.3) == messages


def jumping(at_s, by_m, silent_until_s=0.0):
    """Odometry of a parked vehicle whose map frame jumps, optionally after a gap."""

    def compare_motion(stage, t_s):
        if not at_s <= t_s < silent_until_s:
            jump = motion_at(t_s)
            stage.on_motion(dataclasses.replace(jump, xyz_map_m=np.asarray(by_m) * (t_s >= at_s)))

    return compare_motion


@pytest.mark.parametrize("by_m", [(1.2, 0.5, 0.0), (300.0, -40.0, 0.0)])
def test_a_jump_of_the_vehicles_odometry_keeps_candidates_and_static_objects(by_m):
    messages = all_messages([hovering()], 3.0, drives_mps=None, publish=jumping(1.0, by_m))
    candidates = [m for m in messages if isinstance(m, Candidates)]
    assert {int(number) for message in candidates for number in message.candidate_id} == {1}
    assert not feature(messages, "moves").any()
    assert candidates[-1].scan_passes[0] > 12

    def publish(stage, t_s):
        jumping(1.0, by_m)(stage, t_s)
        telemetry_of(MOVING)(stage, t_s)

    _, detections = run([Drone(MOVING)], 4.0, drives_mps=None, publish=publish)
    assert accepted_after_s(detections) < 3.0


def test_a_jump_during_a_gap_of_the_odometry_resets_the_memory():
    stage = detector(sweep_deg=PASS_DEG, forget_s=0.5)
    run(
        [hovering()],
        4.0,
        looking_away(1.5, 9.0),
        drives_mps=None,
        publish=jumping(2.0, (300.0, 0.0, 0.0), 3.5),
        stage=stage,
    )
    assert len(stage._now.static) == len(list(stage._now.table)) == 0
    stage = detector(sweep_deg=PASS_DEG, forget_s=0.5)
    run(
        [hovering()],
        4.0,
        looking_away(1.5, 9.0),
        drives_mps=None,
        publish=jumping(2.0, (0.1, 0.0, 0.0), 3.5),
        stage=stage,
    )
    assert len(stage._now.static) == 1


def test_a_candidate_without_observations_is_removed():
    gone = During(hovering(), 0.0, 2.0)
    stage = detector(sweep_deg=PASS_DEG, forget_s=0.5)
    for pulses in pulses_seen([gone], WATCHING, 4.0):
        list(stage.on_pulses(pulses))
    assert list(stage._now.table) == []
    assert stage._now.watches == {}


def test_the_same_pulses_give_the_same_messages():
    once, again = (run([Drone(still(*PLACE_M), seed=1)], 1.5) for _ in range(2))
    for a, b in zip(once[0] + once[1], again[0] + again[1], strict=True):
        assert a.reasons == b.reasons
    for a, b in zip(once[0], again[0], strict=True):
        np.testing.assert_array_equal(a.probability, b.probability)
    for a, b in zip(once[1], again[1], strict=True):
        np.testing.assert_array_equal(a.evidence.probability, b.evidence.probability)
        np.testing.assert_array_equal(a.xyz_vehicle_m, b.xyz_vehicle_m)


def test_the_model_decides():
    model = {"feature_version": VERSION, "priors": [(9.0, 9.0)] * 4, "terms": [TERM]}
    _, accepted = run([hovering()], 1.5, model=model)
    assert accepted_after_s(accepted) < 1.0
    candidates, refused = run([hovering()], 1.5, model=model | {"priors": [(9.0, 9.0)] * 3 + [(2.0, 9.0)]})
    assert accepted_after_s(refused) == math.inf
    assert candidates[-1].probability[0] == pytest.approx(1 / (1 + math.exp(2.0)), abs=0.01)
    assert "(-4.0); if not a drone: a balloon" in candidates[-1].reasons[0]


def test_without_free_space_the_model_has_no_feature_of_the_surroundings():
    model = {"feature_version": VERSION, "priors": [(0.0, 0.0)] * 4, "terms": [TERM | {"feature": "free_sectors"}]}
    for free_space in (True, False):
        stage, logged = detector(model=model, free_space=free_space), []
        for pulses in pulses_seen([hovering()], WATCHING, 0.5):
            logged += [m for m in stage.on_pulses(pulses) if isinstance(m, CandidateLog)]
        known = ~np.isnan(np.concatenate([m.features[:, NAMES.index("free_sectors")] for m in logged]))
        assert known.all() if free_space else not known.any()


def test_the_imu_is_compared_with_a_candidate_without_the_autopilots_estimate():
    stage, logged = detector(parked=True), []
    for k in range(1, 100):
        stage.on_drone_motion(drone_motion(0.02 * k))
    for pulses in pulses_seen([Drone(GLIDING)], WATCHING, 2.5):
        logged += [m for m in stage.on_pulses(pulses) if isinstance(m, CandidateLog)]
    last = dict(zip(NAMES, logged[-1].features[0], strict=True))
    assert math.isnan(last["over_static_nats"])
    assert last["imu_over_static_nats"] > 0.0  # it flies straight on


def test_the_imu_is_no_evidence_while_the_odometry_made_with_it_is():
    stage, logged = detector(parked=True), []
    for k in range(1, 250):
        stage.on_drone_motion(drone_motion(0.02 * k))
    for pulses in pulses_seen([Drone(MOVING)], WATCHING, 4.5):
        t_s = (pulses.stamp_ns - START_NS) * 1e-9
        if t_s < 1.5:
            stage.on_drone_position(local_position(MOVING, t_s))
        logged += [m for m in stage.on_pulses(pulses) if isinstance(m, CandidateLog)]
    last_s = np.array([(m.seen_ns[0] - START_NS) * 1e-9 for m in logged])
    by_odometry, by_imu = (
        np.array([m.features[0, NAMES.index(name)] for m in logged])
        for name in ("over_bird_nats", "imu_over_bird_nats")
    )
    during, after = (last_s > 0.5) & (last_s < 3.0), last_s > 4.0  # telemetry is too old after 2 s
    assert during.any()
    assert not np.isnan(by_odometry[during]).any()
    assert np.isnan(by_imu[during]).all()
    assert after.any()
    assert not np.isnan(by_imu[after]).any()
    assert (by_odometry[after] == by_odometry[after][0]).all()  # it remains


def test_every_classified_candidate_is_logged_with_its_features():
    stage, logged = detector(sweep_deg=PASS_DEG), []
    for pulses in pulses_seen([Drone(MOVING)], WATCHING, 1.5):
        logged += [m for m in stage.on_pulses(pulses) if isinstance(m, CandidateLog)]
    for message in logged:
        check_arrays(message)
        assert message.feature_names == NAMES
    passes = np.array([m.features[0, NAMES.index("scan_passes")] for m in logged])
    existence = np.array([m.features[0, NAMES.index("existence_nats")] for m in logged])
    assert passes[0] == 1.0
    assert passes[-1] > 8.0
    assert existence[0] < 0.0 < 20.0 < existence[-1]
    last = logged[-1]
    truth = MOVING(np.array([(last.seen_ns[0] - START_NS) * 1e-9]))[0]
    np.testing.assert_allclose(last.xyz_vehicle_m[0], truth, atol=0.3)


def test_a_slice_without_pulses_is_ignored():
    (pulses,) = list(pulses_seen([], WATCHING, 0.0014, mount=ON_ITS_SIDE))[:1]
    for name in ("point_stamp_ns", "direction_vehicle", "range_m", "laser", "reflectivity"):
        object.__setattr__(pulses, name, getattr(pulses, name)[:0])
    assert list(detector().on_pulses(pulses)) == []


@pytest.mark.parametrize(
    "settings",
    [
        {"span_m": 0.0},
        {"accept_probability": 1.0},
        {"accept_probability": 0.49},
        {"follow_up_probability": 0.6},
        {"report_s": 0.0},
    ],
)
def test_impossible_settings_are_rejected(settings):
    with pytest.raises(ValidationError):
        detector(**settings)


@pytest.mark.parametrize(
    ("model", "text"),
    [
        (None, "include models/detector.yaml"),
        ({}, "feature_version"),
        ({"feature_version": VERSION, "priors": [(1.0, 1.0)] * 4, "terms": []}, "terms"),
        ({"feature_version": VERSION - 1, "priors": [(1.0, 1.0)] * 4, "terms": [TERM]}, "train it again"),
        ({"feature_version": VERSION, "priors": [(math.nan, 1.0)] * 4, "terms": [TERM]}, "priors"),
    ],
)
def test_a_model_that_was_not_trained_or_for_other_features_is_refused(model, text):
    with pytest.raises(ValidationError, match=text):
        detector(model=model)


def test_a_rejected_lamp_is_not_published_again():
    """It is observed in each pass; another observation takes time from the drone."""

    def found(trajectory, left_out=()):
        terms = tuple(term for term in shipped_model().terms if term.feature not in left_out)
        stage = detector(sweep_deg=PASS_DEG, model=dict(shipped_model()) | {"terms": terms})
        stage._now.rejected.static_map.add(np.array([PLACE_M]), START_NS)
        messages = all_messages([hovering()], 1.0, publish=telemetry_of(trajectory), stage=stage)
        published = any(m.candidate_id.size for m in messages if isinstance(m, Candidates))
        probability = next(m.probability[0] for m in messages if isinstance(m, CandidateLog))
        return published, feature(messages, "revisited")[0], probability

    flies, hovers = flying((0.0, 0.0, 0.0), (3.0, 0.0, 0.0)), still(0.0, 0.0, 0.0)
    assert found(flies, ("near_rejected", "revisited"))[0]
    (published, revisited, probability), while_it_hovers = found(flies), found(hovers)
    assert not published
    assert (revisited, while_it_hovers[1]) == (1.0, 0.0)
    assert probability < while_it_hovers[2]


@pytest.mark.parametrize(("step_m", "remembered"), [(0.0, True), (0.5, False)])
def test_only_static_candidates_are_remembered_as_rejected_objects(step_m, remembered):
    """A rejected candidate that moved, for example a bird, leaves no rejected position."""
    path = [observation(0.1 * k, (step_m * k, 20.0, 20.0)) for k in range(6)]
    c = candidate(*path)
    c.alternative = Alternative.STATIC
    stage = detector(parked=True)
    stage._remember_rejected(stage._now, c)
    nearest_m = stage._now.rejected.static_map.nearest_m(c.xyz_m, 0.0, NEAR_REJECTED_M, START_NS)
    assert math.isfinite(nearest_m) == remembered
