"""MeanShiftTrack: frames by the points' stamps, states, loss, rivals, and a flight."""

# ruff: noqa: RUF005 (arrays are added here, not joined)

from __future__ import annotations

import hashlib
import math

import numpy as np
import pytest
from pydantic import ValidationError

from flow.message import check_arrays, hash_into
from flow.stage import input_ports, output_ports
from stages.detect.paper.kernel_detect import KernelDetect
from stages.messages import DepthImage, Detections, DroneFix, SweptPoints, TrackingState, TrackState
from stages.sweep.sweep import Sweep
from stages.track.mean_shift_track import MeanShiftTrack
from tests.stages.caster import Ball, flying, seen
from tests.stages.made import MS, ON_ITS_SIDE, START_NS, detections, swept

T0 = np.array([1.0, 2.0, 20.0])


def run(stage, messages, finish=True):
    out = []
    for message in messages:
        if isinstance(message, Detections):
            assert stage.on_detections(message) is None
        else:
            out += stage.on_points(message)
    out += stage.finish() if finish else []
    for message in out:
        check_arrays(message)
    return [m for m in out if isinstance(m, DroneFix)], [m for m in out if isinstance(m, TrackState)]


def at(ms):
    return START_NS + round(ms * MS)


def empty(ms):
    return swept(np.empty((0, 3)), at(ms))


def test_ports_are_what_the_graph_wires():
    assert set(input_ports(MeanShiftTrack)) == {"detections", "points"}
    assert set(output_ports(MeanShiftTrack)) == {"drone_fix", "track_state"}


def test_nothing_is_tracked_before_a_detection():
    fixes, states = run(MeanShiftTrack(), [swept([T0], at(ms)) for ms in range(0, 500, 10)])
    assert fixes == []
    assert [s.state for s in states] == [TrackingState.SEARCHING] * 5
    assert states[0].reason == "no drone detected yet"
    assert [(s.stamp_ns - START_NS) // MS for s in states] == [120, 240, 360, 480, 600]
    assert all(s.frame_s == 0.12 for s in states)


def test_a_rejected_detection_starts_no_track():
    _, states = run(MeanShiftTrack(), [empty(0), detections(rejected=[T0]), swept([T0], at(5))])
    assert states[0].state == TrackingState.SEARCHING


def test_only_returns_within_the_radius_count():
    stage = MeanShiftTrack(acquire_radius_m=1.0)
    inside, outside = T0 + [0.99, 0, 0], T0 + [0, 1.01, 0]
    fixes, states = run(stage, [empty(0), detections(T0), swept([inside, outside], at(5))])
    assert fixes[0].hits == states[0].hits == 1
    np.testing.assert_allclose(fixes[0].xyz_vehicle_m, inside, atol=1e-6)


def test_the_radius_is_about_the_position_at_the_start_of_the_frame():
    """F is fixed for the frame: the second return is near the first, but not near t^0."""
    stage = MeanShiftTrack(acquire_radius_m=1.0)
    fixes, _ = run(
        stage, [empty(0), detections(T0), swept([T0 + [0.9, 0, 0]], at(5)), swept([T0 + [1.5, 0, 0]], at(9))]
    )
    assert fixes[0].hits == 1


def test_the_best_accepted_detection_starts_the_track():
    stage = MeanShiftTrack()
    fixes, states = run(stage, [empty(0), detections(T0, T0 + [9, 0, 0]), swept([T0, T0 + [9, 0, 0]], at(5))])
    np.testing.assert_allclose(fixes[0].xyz_vehicle_m, T0, atol=1e-5)
    assert states[0].state == TrackingState.TRACKING
    assert states[0].reason == "started at a detection; 1 returns"


def test_the_first_returns_are_searched_within_the_acquisition_radius():
    far = T0 + [0, 2.5, 0]
    messages = [empty(0), detections(T0), swept([far], at(5)), swept([far + [0, 2.5, 0]], at(130))]
    fixes, _ = run(MeanShiftTrack(), messages)
    assert len(fixes) == 1
    np.testing.assert_allclose(fixes[0].xyz_vehicle_m, far, atol=1e-5)
    assert run(MeanShiftTrack(acquire_radius_m=1.0), messages)[0] == []  # the paper's


def test_a_detection_is_refined_by_mean_shift_over_its_scan():
    """The returns of the scan lie 0.8 m from the detected pixel; a return 0.9 m beyond them is within r of them only."""
    hull = T0 + [0.8, 0, 0] + np.array([[0, 0.05, 0], [0, -0.05, 0]])
    beyond = T0 + [1.7, 0, 0]
    messages = [swept(hull, at(0)), detections(T0), swept([beyond], at(50))]
    fixes, states = run(MeanShiftTrack(acquire_radius_m=1.0), messages)
    np.testing.assert_allclose(fixes[0].xyz_vehicle_m, beyond, atol=1e-5)
    assert states[0].reason == "started at a detection, moved 0.80 m by 2 returns of its scan; 1 returns"
    assert run(MeanShiftTrack(acquire_radius_m=1.0, refine_detection=False), messages)[0] == []


def test_only_the_returns_of_the_last_scan_refine_a_detection():
    """Returns before the previous detections, or two sweeps ago, are of another scan."""
    hull = T0 + [[0.8, 0, 0]]
    for before in ([swept(hull, at(0)), detections()], [swept(hull, at(0)), empty(5400)]):
        _, states = run(MeanShiftTrack(), [*before, detections(T0), swept([T0], at(5405))])
        reasons = [state.reason for state in states]
        assert any(reason.startswith("started at a detection;") for reason in reasons), reasons
        assert not any("moved" in reason for reason in reasons)


def test_a_slice_across_a_frame_boundary_is_split_by_time():
    points = [T0, T0 + [0.2, 0, 0], T0 + [0.4, 0, 0]]
    stamps = [at(119.9), at(120.0), at(120.1)]
    fixes, states = run(MeanShiftTrack(), [empty(0), detections(T0), swept(points, stamps)])
    assert [s.hits for s in states] == [1, 2]
    np.testing.assert_allclose(fixes[0].xyz_vehicle_m, T0, atol=1e-5)
    assert fixes[1].xyz_vehicle_m[0] == pytest.approx(T0[0] + 0.3, abs=0.01)


def test_the_fixes_do_not_depend_on_the_slices():
    rng = np.random.default_rng(1)
    stamps = np.sort(rng.integers(0, 1000 * MS, 400)) + START_NS
    points = T0 + rng.normal(0, 0.3, (400, 3))

    def digest(pieces):
        stage, hasher = MeanShiftTrack(), hashlib.sha256()
        slices = [swept(points[i], stamps[i]) for i in np.array_split(np.arange(400), pieces)]
        fixes, states = run(stage, [empty(0), detections(T0), *slices])
        for message in [*fixes, *states]:
            hash_into(hasher, hasher, message)
        return hasher.hexdigest()

    assert digest(3) == digest(37) == digest(400)


def test_the_fix_has_the_weighted_mean_time_of_its_returns():
    points, stamps = [T0 + [0.5, 0, 0], T0 - [0.5, 0, 0], T0], [at(10), at(20), at(60)]
    fixes, _ = run(MeanShiftTrack(), [empty(0), detections(T0), swept(points, stamps)])
    w = math.exp(-0.25)
    assert (fixes[0].stamp_ns - START_NS) / MS == pytest.approx((10 * w + 20 * w + 60) / (1 + 2 * w), abs=0.01)


def test_after_lost_after_s_without_returns_it_searches():
    messages = [empty(0), detections(T0), swept([T0], at(5)), *[empty(ms) for ms in range(10, 4000, 10)]]
    fixes, states = run(MeanShiftTrack(lost_after_s=3.0), messages)
    assert len(fixes) == 1
    kinds = [s.state for s in states]
    lost = kinds.index(TrackingState.LOST)
    assert kinds[:lost] == [TrackingState.TRACKING] * lost
    assert (states[lost].stamp_ns - START_NS) / 1e9 == pytest.approx(3.005, abs=0.121)
    assert "returns a frame for 3.1 s" in states[lost].reason
    assert set(kinds[lost + 1 :]) == {TrackingState.SEARCHING}
    assert states[lost + 1].reason == "lost the drone, waiting for a detection"
    assert "no return" in states[3].reason


def test_after_loss_the_next_accepted_detection_starts_again():
    stage = MeanShiftTrack(lost_after_s=0.5)
    run(stage, [empty(0), detections(T0), *[empty(ms) for ms in range(10, 1000, 10)]], finish=False)
    distant = T0 + [15, 0, 0]
    fixes, states = run(stage, [detections(distant, stamp_ns=at(1000)), swept([distant], at(1010))])
    np.testing.assert_allclose(fixes[0].xyz_vehicle_m, distant, atol=1e-5)
    assert states[-1].state == TrackingState.TRACKING


def test_fewer_returns_than_min_hits_give_no_fix():
    fixes, states = run(MeanShiftTrack(min_hits=2), [empty(0), detections(T0), swept([T0], at(5))])
    assert fixes == []
    assert states[0].hits == 1
    assert states[0].state == TrackingState.TRACKING


def test_a_long_gap_of_the_lidar_gives_one_frame():
    _, states = run(MeanShiftTrack(), [empty(0), detections(T0), swept([T0], at(5)), empty(600_000), empty(600_130)])
    assert [s.state.name for s in states] == ["TRACKING", "LOST", "SEARCHING"]
    assert (states[1].stamp_ns - START_NS) % (120 * MS) == 0


def sweeps(stage, rival_each, hits_here):
    """Sweeps of 1 s, each with or without returns of the track, and then a distant detection or none."""
    rival = T0 + [10, 0, 0]
    run(stage, [empty(0), detections(T0), swept([T0], at(5))], finish=False)
    states = []
    for k, there in enumerate(rival_each):
        start = 1000 * (k + 1)
        messages = [swept([T0], at(start + 5))] if hits_here else []
        messages += [empty(start + ms) for ms in range(10, 900, 100)]
        messages.append(detections(rival, stamp_ns=at(start + 950)) if there else detections(stamp_ns=at(start + 950)))
        states += run(stage, messages, finish=False)[1]
    return stage._state.t_hat, states


def test_a_rival_needs_two_successive_sweeps():
    assert sweeps(MeanShiftTrack(), [True], True)[0][0] == pytest.approx(T0[0])
    assert sweeps(MeanShiftTrack(), [True, False, True], True)[0][0] == pytest.approx(T0[0])
    moved, _ = sweeps(MeanShiftTrack(), [True, True], True)
    assert moved[0] == pytest.approx(T0[0] + 10)


def test_a_rival_replaces_the_track_at_once_after_a_sweep_without_returns():
    stage = MeanShiftTrack(lost_after_s=10.0)
    assert sweeps(stage, [True], False)[0][0] == pytest.approx(T0[0])  # a hit since the start: at 5 ms
    stage.on_detections(detections(T0 + [10, 0, 0], stamp_ns=at(2900)))
    assert stage._state.t_hat[0] == pytest.approx(T0[0] + 10)
    _, states = run(stage, [empty(2950), empty(3100)])
    assert any("moved 10.0 m to a detection: the last sweep had no return here" in s.reason for s in states)


def test_the_papers_tracker_ignores_rivals():
    assert sweeps(MeanShiftTrack(rival_sweeps=None), [True] * 4, True)[0][0] == pytest.approx(T0[0])


def test_a_detection_near_the_track_changes_nothing():
    stage = MeanShiftTrack()
    run(stage, [empty(0), detections(T0), swept([T0], at(5)), empty(130)], finish=False)
    stage.on_detections(detections(T0 + [0.5, 0, 0], T0 + [10, 0, 0], stamp_ns=at(140)))
    np.testing.assert_allclose(stage._state.t_hat, T0, atol=1e-5)


def test_a_drone_slower_than_a_radius_per_frame_is_tracked():
    rng = np.random.default_rng(4)
    messages = [empty(0), detections(T0)]
    for ms in range(5, 3000, 5):
        centre = T0 + np.array([3.0, -1.0, 0.5]) * ms / 1000
        messages.append(swept(centre + rng.normal(0, 0.1, (2, 3)), at(ms)))
    fixes, states = run(MeanShiftTrack(), messages)
    assert len(fixes) == 25
    truth = [T0 + np.array([3.0, -1.0, 0.5]) * (f.stamp_ns - START_NS) / 1e9 for f in fixes]
    errors = np.array([f.xyz_vehicle_m for f in fixes]) - truth
    assert np.abs(errors[1:]).max() < 0.15
    assert {s.state for s in states} == {TrackingState.TRACKING}


def test_the_fix_rotates_with_the_scene():
    rng = np.random.default_rng(2)
    points = T0 + rng.normal(0, 0.2, (30, 3))

    def fix(turn):
        xyz, start = points @ turn.T, turn @ T0
        return run(MeanShiftTrack(), [empty(0), detections(start), swept(xyz, at(5), rng.integers(0, 2, 30))])[0][0]

    R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    here, there = fix(np.eye(3)), fix(R)
    np.testing.assert_allclose(there.xyz_vehicle_m, R @ here.xyz_vehicle_m, atol=1e-5)
    np.testing.assert_allclose(there.covariance_m2, R @ here.covariance_m2 @ R.T, atol=1e-5)


def test_sweep_detection_and_tracking_follow_a_ball():
    """A sweep of 180 deg, then vibration by +-5 deg about the ball, which moves at 0.4 m/s."""

    trajectory = flying((3.0, 2.0, 12.0), (0.4, 0.0, 0.0))

    def servo_rad(t):
        aimed_s = 206.0 / 90.0  # the fan's plane goes through the ball at 26 deg, and so at 206 deg
        return np.radians(np.where(t < aimed_s, 90.0 * t, 206.0 + 5.0 * np.sin(2 * np.pi * 2.86 * (t - aimed_s))))

    sweep, detect, track = Sweep(mount=ON_ITS_SIDE), KernelDetect(span_m=0.5), MeanShiftTrack()
    fixes, summaries = [], []
    for message in seen([Ball(trajectory, 0.25)], servo_rad, 3.5):
        for out in sweep.on_servo(message) if hasattr(message, "goal_rad") else sweep.on_firings(message):
            if isinstance(out, DepthImage):
                _, found = detect.on_image(out)
                summaries.append(found.summary)
                track.on_detections(found)
            elif isinstance(out, SweptPoints):
                fixes += [m for m in track.on_points(out) if isinstance(m, DroneFix)]
    assert len(summaries) == 1
    assert summaries[0].startswith("drone at (3.")
    assert len(fixes) >= 5
    errors = np.array([f.xyz_vehicle_m for f in fixes]) - trajectory(
        np.array([f.stamp_ns - START_NS for f in fixes]) * 1e-9
    )
    nees = [e @ np.linalg.solve(f.covariance_m2, e) for e, f in zip(errors, fixes, strict=True)]
    assert np.abs(errors).max() < 0.35
    assert np.mean(nees) < 9.0


@pytest.mark.parametrize(
    "settings",
    [{"radius_m": 0.0}, {"frame_s": 0.0}, {"max_iterations": 0}, {"lost_after_s": -1}, {"min_hits": 0}, {"rival": 1}],
)
def test_impossible_settings_are_rejected(settings):
    with pytest.raises(ValidationError):
        MeanShiftTrack(**settings)
