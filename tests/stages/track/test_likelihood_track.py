"""LikelihoodTrack in synthetic scenes: states over time, pass-throughs, identities, and rejected drones."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from pydantic import ValidationError

from flow.message import check_arrays
from flow.stage import input_ports, output_ports
from stages.geometry.frames import LidarMount
from stages.kernels.track.hull import DEPTH, GAP_RETURN, KIND, RETURN, A, B
from stages.messages import (
    CandidateEvidence,
    Candidates,
    Detections,
    DroneFix,
    TrackingState,
    TrackState,
    VehicleMotion,
)
from stages.track import LikelihoodTrack
from stages.track.hull import COLUMNS
from stages.track.hypotheses import Hypotheses
from stages.track.likelihood_track import PASS_OVER_NS
from stages.track.scan_pass import drone_returns
from tests.stages.caster import Box, Drone, During, Trajectory, dithering, flying, pulses_seen, still
from tests.stages.made import START_NS

WATCHING = dithering(half_rad=math.radians(1.0))  # as the aim stage does: a beam comes near in each rotor turn
PASSING = flying((0.0, 8.0, 10.0), (1.0, 0.0, 0.3))  # 12.7 m away


def at_s(t_s):
    return START_NS + round(t_s * 1e9)


def accepted(xyz_m, velocity_mps=(0.0, 0.0, 0.0), t_s=0.0, number=1) -> Detections:
    """Detections of a drone that was just observed."""
    return Detections(
        stamp_ns=at_s(t_s),
        xyz_vehicle_m=np.array([xyz_m], dtype=np.float64),
        accepted=np.array([True]),
        reasons=("made",),
        summary="made",
        evidence=CandidateEvidence(
            start_ns=at_s(t_s) - 1,
            candidate_id=np.array([number]),
            seen_ns=np.array([at_s(t_s)]),
            velocity_vehicle_mps=np.array([velocity_mps], dtype=np.float64),
            log_odds=np.array([5.0]),
            probability=np.array([0.995]),
        ),
    )


def candidate(xyz_m, probability, t_s=0.0, number=1, scan_passes=3, life_since_s=0.0) -> Candidates:
    return Candidates(
        stamp_ns=at_s(t_s),
        detector_instance=at_s(life_since_s),
        candidate_id=np.array([number]),
        xyz_vehicle_m=np.array([xyz_m], dtype=np.float64),
        velocity_vehicle_mps=np.zeros((1, 3)),
        probability=np.array([probability]),
        seen_ns=np.array([at_s(t_s)]),
        scan_passes=np.array([scan_passes]),
        reasons=("flew as a bird does",),
        accept_probability=0.95,
    )


def run(things, messages, seconds=2.0, drives_mps=(0.0, 0.0, 0.0), jump=(math.inf, 0.0), **settings):
    """Messages that the stage publishes for the given messages at their stamps and the pulses of the things.

    `jump`: time [s] and size [m] per axis of a jump of the vehicle's map frame.
    """
    stage, out, waiting, next_s = LikelihoodTrack(**settings), [], sorted(messages, key=lambda m: m.stamp_ns), 0.0
    for pulses in pulses_seen(things, WATCHING, seconds):
        while any(drives_mps) and at_s(next_s) <= pulses.point_stamp_ns[-1]:
            position_m = next_s * np.asarray(drives_mps, dtype=np.float64) + (jump[1] if next_s >= jump[0] else 0.0)
            stage.on_motion(
                VehicleMotion(stamp_ns=at_s(next_s), xyz_map_m=position_m, R_map_vehicle=np.eye(3), covariance=None)
            )
            next_s += 0.02
        while waiting and waiting[0].stamp_ns <= pulses.point_stamp_ns[-1]:
            message = waiting.pop(0)
            out += stage.on_candidates(message) if isinstance(message, Candidates) else stage.on_detections(message)
        out += stage.on_pulses(pulses)
    for message in out:
        check_arrays(message)
        assert not isinstance(message, TrackState) or message.reason, "every state has a reason"
    return out


def fixes_of(out, track_id=1):
    return [m for m in out if isinstance(m, DroneFix) and m.track_id == track_id]


def states_of(out):
    return [m for m in out if isinstance(m, TrackState)]


def story(out):
    """The states in order, without repetitions."""
    names = [m.state.name for m in states_of(out)]
    return [name for i, name in enumerate(names) if i == 0 or name != names[i - 1]]


def errors_m(fixes, trajectory: Trajectory):
    return np.array([f.xyz_vehicle_m for f in fixes]) - trajectory(
        np.array([f.stamp_ns - START_NS for f in fixes]) * 1e-9
    )


def here(trajectory: Trajectory, t_s=0.0):
    return trajectory(np.array([t_s]))[0]


def test_ports_are_what_the_graph_wires():
    assert set(input_ports(LikelihoodTrack)) == {
        "candidates",
        "detections",
        "motion",
        "pulses",
        "drone_position",
        "drone_odometry",
    }
    assert set(output_ports(LikelihoodTrack)) == {"drone_fix", "track_state"}
    assert LikelihoodTrack.optional_inputs == {"candidates", "motion", "drone_position", "drone_odometry"}


@pytest.mark.parametrize("seed", range(2))
def test_an_accepted_drone_is_tracked_with_a_fix_for_each_scan_pass_with_returns(seed):
    out = run([Drone(PASSING, seed=seed)], [accepted(here(PASSING))])
    fixes = fixes_of(out)
    assert len(fixes) >= 14  # of 20 turns
    assert np.sqrt(np.mean(np.sum(errors_m(fixes, PASSING) ** 2, axis=1))) < 0.15
    np.testing.assert_allclose(fixes[-1].velocity_vehicle_mps, (1.0, 0.0, 0.3), atol=0.5)
    assert all(f.hits >= 1 and np.all(np.linalg.eigvalsh(f.covariance_m2) > 0) for f in fixes)
    assert "LOST" not in story(out)
    stamps = [f.stamp_ns for f in fixes]
    assert stamps == sorted(stamps)


def test_a_drone_at_8_m_per_s_is_tracked():
    trajectory = flying((0.0, 9.0, 3.0), (0.0, 0.0, 8.0))
    fixes = fixes_of(run([Drone(trajectory)], [accepted(here(trajectory))], 2.0))
    assert len(fixes) >= 10
    assert fixes[-1].stamp_ns > at_s(1.7)
    assert np.linalg.norm(errors_m(fixes, trajectory)[-5:], axis=1).max() < 0.4


def test_without_returns_the_covariance_grows_until_the_track_is_lost():
    gone = During(Drone(PASSING), 0.0, 1.5)
    out = run([gone], [accepted(here(PASSING))], 5.0, lost_after_s=2.5)
    assert story(out) == ["TRACKING", "COASTING", "LOST", "SEARCHING"]
    coasting = [m for m in states_of(out) if m.state is TrackingState.COASTING]
    traces = [float(np.trace(m.covariance_m2)) for m in coasting]
    assert len(coasting) >= 15
    assert all(np.diff(traces) > 0)
    assert traces[-1] > 10 * traces[0]
    assert all("no return for" in m.reason for m in coasting)
    # pass-throughs at the predicted position move the estimate; the error stays within 4 sigma
    for m in coasting:
        away = m.xyz_vehicle_m - here(PASSING, (m.stamp_ns - START_NS) * 1e-9)
        assert away @ np.linalg.solve(m.covariance_m2, away) < 16.0
    (lost,) = [m for m in states_of(out) if m.state is TrackingState.LOST]
    assert lost.track_id == 1
    assert "no return for" in lost.reason
    searching = states_of(out)[-1]
    assert searching.xyz_vehicle_m is None
    assert searching.reason.startswith("lost drone 1: no return for")


@pytest.mark.parametrize("gap_s", [0.5, 2.0])
def test_a_drone_that_reappears_keeps_its_track(gap_s):
    """After 0.5 s the tracker reacquires it; after 2 s it needs the detector."""
    trajectory = still(0.0, 8.0, 10.0)
    with_gap = [During(Drone(trajectory), 0.0, 1.0), During(Drone(trajectory, seed=1), 1.0 + gap_s, 4.0)]
    messages = [
        accepted(here(trajectory)),
        *([accepted(here(trajectory), t_s=1.2 + gap_s, number=2)] if gap_s > 1 else []),
    ]
    out = run(with_gap, messages, 2.0 + gap_s)
    assert story(out)[:3] == ["TRACKING", "COASTING", "TRACKING"]
    assert {m.track_id for m in out} == {1}
    assert fixes_of(out)[-1].stamp_ns > at_s(1.6 + gap_s)


@pytest.mark.parametrize(
    ("gap_s", "probability", "number", "accepted_by_track"),
    [(1.5, 0.4, 2, False), (1.5, 0.7, 2, True), (3.8, 0.7, 2, False), (3.8, 0.99, 2, True), (3.8, 0.7, 1, True)],
)
def test_the_required_probability_grows_with_the_tracks_covariance(gap_s, probability, number, accepted_by_track):
    """After 4 s the drone may be anywhere within 10 m, and so may a bird; number 1 is the track's own candidate."""
    trajectory, other = still(0.0, 8.0, 10.0), still(0.6, 8.0, 10.4)
    things = [During(Drone(trajectory), 0.0, 1.0), During(Drone(other, seed=1), 1.0 + gap_s, 9.0)]
    met = candidate(here(other), probability, t_s=1.1 + gap_s, number=number)
    out = run(things, [accepted(here(trajectory)), met], 1.6 + gap_s)
    assert (fixes_of(out)[-1].stamp_ns > at_s(1.1 + gap_s)) == accepted_by_track


def test_without_vehicle_motion_the_covariance_of_a_coasting_track_grows():
    """The vehicle may have braked since its last message."""
    sigmas_m = {}
    for received_s in (1.0, 3.0):
        stage, states = LikelihoodTrack(), []
        stage.on_motion(driven(0.0))
        states += stage.on_detections(accepted((0.0, 8.0, 10.0)))
        messages = [driven(t) for t in np.arange(0.02, received_s, 0.02)]
        for pulses in pulses_seen([During(Drone(flying((0.0, 8.0, 10.0), (-8.0, 0.0, 0.0))), 0.0, 0.7)], WATCHING, 2.6):
            while messages and messages[0].stamp_ns <= pulses.point_stamp_ns[-1]:
                stage.on_motion(messages.pop(0))
            states += stage.on_pulses(pulses)
        last = states_of(states)[-1]
        assert last.state is TrackingState.COASTING
        assert last.stamp_ns > at_s(2.4)
        assert last.covariance_m2 is not None
        sigmas_m[received_s] = np.sqrt(np.diag(last.covariance_m2))
    added_m = np.sqrt(sigmas_m[1.0] ** 2 - sigmas_m[3.0] ** 2)
    assert (added_m > 0.5 * 2.0 * 1.4**2 / 2).all()  # braking or not, at 2 m/s^2, one sigma


def driven(t_s) -> VehicleMotion:
    position_m = np.array([8.0 * t_s, 0.0, 0.0])
    return VehicleMotion(stamp_ns=at_s(t_s), xyz_map_m=position_m, R_map_vehicle=np.eye(3), covariance=None)


@pytest.mark.parametrize(("accepted_s", "numbers"), [(2.0, {1, 2}), (1.4, {1})])
def test_a_track_without_returns_for_a_second_is_replaced_by_a_newly_accepted_drone(accepted_s, numbers):
    first, second = still(-3.0, 8.0, 10.0), still(4.0, 8.0, 12.0)
    things = [During(Drone(first), 0.0, 0.8), During(Drone(second), 1.0, 4.0)]
    out = run(things, [accepted(here(first)), accepted(here(second), t_s=accepted_s, number=2)], 3.0)
    assert {f.track_id for f in out if isinstance(f, DroneFix)} == numbers
    lost = [m.reason for m in states_of(out) if m.state is TrackingState.LOST]
    assert lost == (["no return, while the detector accepted another drone"] if 2 in numbers else [])


def test_a_lost_drone_that_is_accepted_at_another_position_has_a_new_number():
    first, second = still(-1.0, 8.0, 10.0), still(2.0, 8.0, 12.0)
    things = [During(Drone(first), 0.0, 0.8), During(Drone(second), 2.0, 4.0)]
    out = run(things, [accepted(here(first)), accepted(here(second), t_s=2.6, number=2)], 3.5, lost_after_s=1.0)
    assert [m.track_id for m in states_of(out) if m.state is TrackingState.LOST] == [1]
    assert len(fixes_of(out, 2)) >= 5


def test_pass_throughs_improve_the_estimate_and_its_consistency():
    square, nees = {True: [], False: []}, {True: [], False: []}
    for use_pass_throughs in (True, False):
        for seed in range(3):
            fixes = fixes_of(
                run([Drone(PASSING, seed=seed)], [accepted(here(PASSING))], use_pass_throughs=use_pass_throughs)
            )
            errors = errors_m(fixes, PASSING)
            square[use_pass_throughs] += np.sum(errors**2, axis=1).tolist()
            nees[use_pass_throughs] += [
                e @ np.linalg.solve(f.covariance_m2, e) for e, f in zip(errors, fixes, strict=True)
            ]
    assert np.mean(square[True]) < 0.95 * np.mean(square[False])
    assert np.mean(nees[True]) < np.mean(nees[False])
    assert np.mean(nees[True]) < 4.0  # 3 is consistent


CERTAIN = {"shape_share": 0.0, "range_sigma_m": 0.0, "mount": LidarMount(pointing_sigma_deg=0.0), "tilt_deg": 0.0}


def bias_covariance(position_m, **sigmas):
    return LikelihoodTrack(**{**CERTAIN, **sigmas})._bias_covariance(np.array(position_m))


def test_the_pointing_error_grows_with_range_about_the_axis_only():
    added = bias_covariance((0.0, 20.0, 5.0), mount=LidarMount(pointing_sigma_deg=1.0))
    np.testing.assert_allclose(added, np.diag([(20 * math.radians(1)) ** 2, 0, 0]), atol=1e-12)


def test_the_tilt_error_is_vertical_at_low_and_horizontal_at_high_elevation():
    arm = math.radians(1.0)
    low, overhead = bias_covariance((20.0, 0.0, 0.0), tilt_deg=1.0), bias_covariance((0.0, 0.0, 20.0), tilt_deg=1.0)
    np.testing.assert_allclose(low, np.diag([0, 0, (20 * arm) ** 2]), atol=1e-12)
    np.testing.assert_allclose(overhead, np.diag([(20 * arm) ** 2, (20 * arm) ** 2, 0]), atol=1e-12)
    position_m = np.array([7.0, -4.0, 9.0])  # equals the covariance of random tilts
    tilts = np.random.default_rng(1).normal(0.0, arm, (20_000, 2))
    moved = np.cross(np.pad(tilts, ((0, 0), (0, 1))), position_m)
    np.testing.assert_allclose(
        bias_covariance(position_m, tilt_deg=1.0), moved.T @ moved / len(moved), rtol=0.05, atol=2e-4
    )


def test_a_fix_contains_its_bias_covariance():
    trajectory = still(0.0, 8.0, 10.0)
    fixes = fixes_of(run([Drone(trajectory)], [accepted(here(trajectory))], 1.5))
    assert fixes
    for fix in fixes:
        np.testing.assert_array_equal(fix.bias_covariance_m2, LikelihoodTrack()._bias_covariance(fix.xyz_vehicle_m))
        assert np.linalg.eigvalsh(fix.covariance_m2 - fix.bias_covariance_m2).min() > 0


def test_the_range_error_is_along_the_line_of_sight_only():
    for position_m in ((0.0, 20.0, 0.0), (3.0, 0.0, 4.0)):
        line = np.array(position_m) / np.linalg.norm(position_m)
        added = bias_covariance(position_m, range_sigma_m=0.03)
        np.testing.assert_allclose(added, 0.03**2 * np.outer(line, line), atol=1e-15)


def test_the_shape_error_grows_with_the_span():
    for span_m in (0.35, 0.8):
        added = bias_covariance((0.0, 20.0, 5.0), span_m=span_m, shape_share=0.05)
        np.testing.assert_allclose(added, (0.05 * span_m) ** 2 * np.eye(3), atol=1e-15)


def test_a_candidate_is_tracked_without_fixes_until_it_is_accepted():
    trajectory = still(0.0, 8.0, 10.0)
    out = run([Drone(trajectory)], [candidate(here(trajectory), 0.7), accepted(here(trajectory), t_s=1.0)], 2.0)
    assert story(out)[:2] == ["CANDIDATE", "TRACKING"]
    assert next(m.track_id for m in states_of(out) if m.state is TrackingState.CANDIDATE) == 0
    assert min(f.stamp_ns for f in fixes_of(out)) >= at_s(1.0)
    assert story(run([Drone(trajectory)], [candidate(here(trajectory), 0.3)], 0.8)) == [
        "SEARCHING"
    ]  # not probable enough


@pytest.mark.parametrize("own", [0.99, 0.3])
def test_a_rejected_candidate_next_to_a_track_does_not_end_it_while_its_own_candidate_is_probable(own):
    """A drone near the zenith may be two candidates: one follows the odometry, the other is classified as a bird."""
    trajectory = still(0.0, 8.0, 10.0)
    one, other = (
        candidate(here(trajectory), own, t_s=1.0, scan_passes=30),
        candidate(here(trajectory), 0.04, t_s=1.0, number=2, scan_passes=6),
    )
    both = Candidates(
        stamp_ns=one.stamp_ns,
        reasons=one.reasons + other.reasons,
        accept_probability=one.accept_probability,
        **{
            name: np.concatenate([getattr(one, name), getattr(other, name)])
            for name in (
                "candidate_id",
                "xyz_vehicle_m",
                "velocity_vehicle_mps",
                "probability",
                "seen_ns",
                "scan_passes",
            )
        },
    )
    out = run([Drone(trajectory)], [accepted(here(trajectory)), both], 2.0)
    assert ("LOST" in story(out)) == (own < 0.5)


def test_a_track_whose_probability_falls_is_lost_with_the_detectors_reason():
    trajectory = still(0.0, 8.0, 10.0)
    out = run([Drone(trajectory)], [accepted(here(trajectory)), candidate(here(trajectory), 0.04, t_s=1.0)], 2.0)
    (lost,) = [m for m in states_of(out) if m.state is TrackingState.LOST]
    assert lost.stamp_ns == at_s(1.0)
    assert lost.reason == "no longer accepted as a drone: flew as a bird does"
    assert max(f.stamp_ns for f in fixes_of(out)) < at_s(1.0)


@pytest.mark.parametrize(
    ("accept_probability", "probability", "lost"),
    [(0.95, 0.06, False), (0.95, 0.04, True), (0.5, 0.3, False), (0.5, 0.1, True)],
)
def test_a_track_ends_where_others_would_be_accepted_in_its_place(accept_probability, probability, lost):
    trajectory = still(0.0, 8.0, 10.0)
    falls = candidate(here(trajectory), probability, t_s=1.0)
    falls = dataclasses.replace(falls, accept_probability=accept_probability)
    out = run([Drone(trajectory)], [accepted(here(trajectory)), falls], 2.0)
    assert ("LOST" in story(out)) == lost


@pytest.mark.parametrize(("life_since_s", "follows"), [(0.0, False), (0.9, True)])
def test_candidate_numbers_of_another_detector_instance_are_not_associated(life_since_s, follows):
    """Its first candidate is another object than the first one of the earlier instance."""
    trajectory = still(0.0, 8.0, 10.0)
    messages = [
        accepted(here(trajectory)),
        candidate(here(trajectory), 0.99, 0.5, scan_passes=6),
        candidate((6.0, 8.0, 9.0), 0.9, 1.0, scan_passes=9, life_since_s=life_since_s),
    ]
    states = [
        m for m in states_of(run([Drone(trajectory)], messages, 1.3)) if m.track_id == 1 and m.stamp_ns > at_s(1.05)
    ]
    assert all((np.linalg.norm(m.xyz_vehicle_m - here(trajectory)) < 0.5) == follows for m in states)
    assert states


def test_repeated_pass_throughs_remove_a_candidate():
    out = run([], [candidate((0.0, 8.0, 10.0), 0.7)], 3.0)
    assert fixes_of(out) == []
    assert story(out) == ["CANDIDATE", "SEARCHING"]


def test_two_drones_keep_their_identities_while_they_pass_each_other():
    low, high = flying((-1.0, 8.0, 10.0), (1.0, 0.0, 0.0)), flying((1.0, 8.0, 12.5), (-1.0, 0.0, 0.0))
    messages = [accepted(here(low), (1, 0, 0), number=5), accepted(here(high), (-1, 0, 0), number=9)]
    out = run([Drone(low, seed=1), Drone(high, seed=2)], messages, 2.5, max_drones=2)
    for track_id, trajectory in ((1, low), (2, high)):
        fixes = fixes_of(out, track_id)
        assert len(fixes) >= 14
        assert np.linalg.norm(errors_m(fixes, trajectory), axis=1).max() < 0.6
    assert "LOST" not in story(out)


def test_two_drones_at_2_m_distance_keep_their_identities():
    left, right = still(-1.0, 8.0, 10.0), still(1.0, 8.0, 10.0)
    messages = [accepted(here(left), number=5), accepted(here(right), number=9)]
    out = run([Drone(left, seed=1), Drone(right, seed=2)], messages, 2.0, max_drones=2)
    for track_id, trajectory in ((1, left), (2, right)):
        assert np.linalg.norm(errors_m(fixes_of(out, track_id), trajectory), axis=1).max() < 0.6
    assert "LOST" not in story(out)


def test_at_most_max_drones_are_tracked():
    first, second = still(-1.5, 8.0, 10.0), still(1.5, 8.0, 10.0)
    messages = [accepted(here(first), number=1), accepted(here(second), number=2)]
    out = run([Drone(first, seed=1), Drone(second, seed=2)], messages, 1.0, max_drones=1)
    assert {m.track_id for m in out} == {1}


def test_a_wall_behind_a_drone_does_not_attract_the_track():
    trajectory = still(0.0, 8.0, 10.0)
    wall = Box((-10.0, 11.0, 0.0), (10.0, 12.0, 24.0))
    fixes = fixes_of(run([Drone(trajectory), wall], [accepted(here(trajectory))]))
    assert len(fixes) >= 12
    assert np.linalg.norm(errors_m(fixes, trajectory), axis=1).max() < 0.4


@pytest.mark.parametrize("gap_m", [0.3, 0.45, 0.7])
def test_a_drone_close_to_a_wall_is_tracked_and_the_wall_is_not_tracked_after_it(gap_m):
    trajectory = flying((0.0, 10.0, 8.0), (0.3, 0.0, 0.0))
    wall = Box((-10.0, 10.0 + gap_m, 0.0), (10.0, 14.0, 24.0))
    out = run([During(Drone(trajectory), 0.0, 1.0), wall], [accepted(here(trajectory), (0.3, 0.0, 0.0))], 3.0)
    fixes = fixes_of(out)
    assert len(fixes) >= 5
    assert np.linalg.norm(errors_m(fixes, trajectory), axis=1).max() < 0.3
    assert fixes[-1].stamp_ns < at_s(1.05)
    assert states_of(out)[-1].state is TrackingState.COASTING


def test_of_duplicate_tracks_the_younger_ends():
    """A track that is removed during a scan pass gives no fix after LOST."""
    stage, out = LikelihoodTrack(max_drones=2), []
    elder, younger = still(-1.0, 8.0, 10.0), still(1.0, 8.0, 10.0)
    for message in (accepted(here(elder), number=5), accepted(here(younger), number=9)):
        out += stage.on_detections(message)
    for pulses in pulses_seen([Drone(elder, seed=1), Drone(younger, seed=2)], WATCHING, 2.0):
        now_ns = int(pulses.point_stamp_ns[-1])
        both = [one for one in stage._hypotheses if one.scan_pass and now_ns - one.scan_pass.last_ns > PASS_OVER_NS]
        if len(both) == 2 and pulses.stamp_ns > at_s(
            1.0
        ):  # both scan passes end now; the younger track moves to the elder's position
            both[1].x[:3] = both[0].x[:3]
        out += stage.on_pulses(pulses)
    (lost,) = [m for m in states_of(out) if m.state is TrackingState.LOST]
    assert (lost.track_id, lost.reason) == (2, "is the same as drone 1")
    assert all(m.track_id == 1 for m in out[out.index(lost) + 1 :])


def test_a_drone_that_follows_the_driving_vehicle_is_tracked():
    trajectory = still(0.0, 8.0, 10.0)  # in the vehicle frame
    out = run([Drone(trajectory)], [accepted(here(trajectory))], 2.0, drives_mps=(8.0, 0.0, 0.0))
    fixes = fixes_of(out)
    assert len(fixes) >= 12
    assert np.linalg.norm(errors_m(fixes, trajectory)[4:], axis=1).max() < 0.4


@pytest.mark.parametrize("by_m", [1.0, 200.0])
def test_a_track_survives_a_jump_of_the_vehicles_odometry(by_m):
    trajectory = still(0.0, 8.0, 10.0)
    out = run([Drone(trajectory)], [accepted(here(trajectory))], 2.0, drives_mps=(8.0, 0.0, 0.0), jump=(1.0, by_m))
    fixes = fixes_of(out)
    assert len(fixes) >= 12
    assert fixes[-1].stamp_ns > at_s(1.8)
    assert np.linalg.norm(errors_m(fixes, trajectory)[4:], axis=1).max() < 0.4
    assert max(np.linalg.norm(f.velocity_vehicle_mps) for f in fixes[4:]) < 1.5
    assert story(out) == ["TRACKING"]


def test_the_published_velocity_is_relative_to_the_vehicle():
    trajectory = still(0.0, 8.0, 10.0)
    out = run([Drone(trajectory)], [accepted(here(trajectory))], 2.0, drives_mps=(8.0, 0.0, 0.0))
    np.testing.assert_allclose(fixes_of(out)[-1].velocity_vehicle_mps, 0.0, atol=1.0)


def test_without_a_drone_it_publishes_searching_at_2_hz():
    states = states_of(run([], [], 2.0))
    assert 4 <= len(states) <= 5
    assert all(m.state is TrackingState.SEARCHING and m.reason == "no drone detected yet" for m in states)


def test_the_same_pulses_give_the_same_fixes():
    once, again = (fixes_of(run([Drone(PASSING, seed=7)], [accepted(here(PASSING))], 1.0)) for _ in range(2))
    assert len(once) > 5
    for a, b in zip(once, again, strict=True):
        np.testing.assert_array_equal(a.xyz_vehicle_m, b.xyz_vehicle_m)
        np.testing.assert_array_equal(a.covariance_m2, b.covariance_m2)


def scan_pass(points):
    """Returns of a scan pass at (a, b, depth) [m]."""
    pulses = np.zeros((len(points), COLUMNS))
    pulses[:, [A, B, DEPTH]] = points
    pulses[:, KIND] = RETURN
    return pulses


def test_the_group_near_the_prediction_is_the_drones_and_outliers_are_not():
    points = [(0.0, 0.0, 0.0), (0.1, 0.0, 0.1), (0.05, 0.1, 0.0), (1.6, 0.0, 0.3)]
    assert drone_returns(scan_pass(points), 0.5, 0.3).tolist() == [0, 1, 2]
    assert drone_returns(scan_pass([(0.0, 0.0, 5.0)]), 0.5, 0.3) is None  # too far behind
    nothing = scan_pass([(0.0, 0.0, 0.0)])
    nothing[:, KIND] = 0.0
    assert drone_returns(nothing, 0.5, 0.3) is None


def test_returns_too_far_from_the_prediction_are_not_the_drones():
    """For example a wall seen through leaves, 0.7 m behind the prediction, whose sigma is 0.13 m."""
    assert (
        drone_returns(scan_pass([(-0.57, -0.23, 0.68), (-0.57, -0.16, 0.68), (-0.57, -0.09, 0.67)]), 0.5, 0.13) is None
    )
    assert drone_returns(scan_pass([(0.25, -0.1, 0.15), (0.25, -0.03, 0.15)]), 0.5, 0.13).tolist() == [0, 1]


@pytest.mark.parametrize(("depth_m", "accepted_by_track"), [(0.05, True), (0.3, False)])
def test_a_gap_return_has_to_be_near_the_prediction(depth_m, accepted_by_track):
    pulses = scan_pass([(0.05, 0.0, depth_m), (0.05, 0.07, depth_m)])
    assert drone_returns(pulses, 0.5, 0.1) is not None
    pulses[:, KIND] = GAP_RETURN
    assert (drone_returns(pulses, 0.5, 0.1) is not None) == accepted_by_track


def test_returns_with_many_adjacent_ones_belong_to_a_larger_object():
    wall = [(0.1 * k, 0.0, 0.0) for k in range(-15, 16)]
    assert drone_returns(scan_pass(wall), 0.5, 0.3) is None


@pytest.mark.parametrize(
    "settings", [{"span_m": 0.0}, {"max_drones": 0}, {"manoeuvre": 0.0}, {"lost_after_s": -1}, {"gate": 1}]
)
def test_impossible_settings_are_rejected(settings):
    with pytest.raises(ValidationError):
        LikelihoodTrack(**settings)


def test_near_an_uncertain_track_a_candidate_needs_more_of_a_stricter_detector():
    hypotheses = Hypotheses(1.0, 0.01, 1.5, 0.8, 1)
    one = hypotheses.start(1, np.array([0.0, 8.0, 10.0]), np.zeros(3), at_s(0.0), at_s(0.0))
    needs = [hypotheses.required_probability(one, at_s(3.0), accept) for accept in (0.9, 0.95, 0.99)]
    assert 0.5 < needs[0] < needs[1] < needs[2] < 0.99
    assert hypotheses.required_probability(one, at_s(0.0), 0.95) == 0.5
