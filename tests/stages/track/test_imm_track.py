"""Baseline DBSCAN + IMM-PDAF: follows what moves, ignores large, standing and near objects, handles absence."""

from __future__ import annotations

import numpy as np
import pytest

from stages.messages import DroneFix, TrackingState, TrackState, VehicleMotion
from tests.stages.made import START_NS, swept

pytest.importorskip("stonesoup")
pytest.importorskip("sklearn")
from stages.track.imm_pdaf import ImmPdaf, ImmSettings
from stages.track.imm_track import ImmPdafTrack

SETTINGS = ImmSettings(
    noise_mps=(0.5, 4.0), stay=0.95, sigma_m=0.15, start_speed_mps=6.0, detection_probability=0.3,
    gate_probability=0.99, clutter_per_m3=1e-4,
)  # fmt: skip
PLACE_M = np.array([0.0, 8.0, 10.0])
WALL_M = np.column_stack([np.linspace(-6, 6, 40), np.full(40, 20.0), np.full(40, 8.0)])


def at_ns(t_s):
    return START_NS + round(t_s * 1e9)


def flown(velocity_mps, seconds=4.0, others_m=(), hidden_s=(9.0, 9.0), stage=None, seed=0, place_m=PLACE_M):
    """(fixes, states) of a small object that flies past, seen once a rotor turn, and other points in each turn."""
    stage, rng = stage or ImmPdafTrack(), np.random.default_rng(seed)
    found = []
    for k in range(round(seconds * 10)):
        t_s = 0.1 * k
        shown = not hidden_s[0] <= t_s < hidden_s[1]
        own = place_m + t_s * np.asarray(velocity_mps) + rng.normal(0, 0.05, (3, 3)) if shown else np.zeros((0, 3))
        others = np.array(others_m, dtype=np.float64).reshape(-1, 3)
        found += stage.on_points(swept(np.concatenate([own, others]), at_ns(t_s)))
    fixes = [m for m in found if isinstance(m, DroneFix)]
    return fixes, [m for m in found if isinstance(m, TrackState)]


def errors_m(fixes, velocity_mps):
    times_s = np.array([(fix.stamp_ns - START_NS) * 1e-9 for fix in fixes])
    true_m = PLACE_M + times_s[:, None] * np.asarray(velocity_mps)
    return np.linalg.norm(np.array([fix.xyz_vehicle_m for fix in fixes]) - true_m, axis=1)


def test_a_small_object_that_moves_is_followed():
    fixes, states = flown((2.0, 0.5, 0.0))
    assert len(fixes) > 25
    assert errors_m(fixes, (2.0, 0.5, 0.0)).max() < 0.3
    assert states[-1].state is TrackingState.TRACKING
    assert len({fix.track_id for fix in fixes}) == 1
    assert {fix.hits for fix in fixes} == {3}
    assert {state.hits for state in states} == {0, 3}
    assert np.linalg.eigvalsh(fixes[-1].covariance_m2).min() > 0


def test_standing_and_large_objects_are_not_followed():
    still, states = flown((0.0, 0.0, 0.0), others_m=WALL_M)
    assert still == []
    assert {state.state for state in states} == {TrackingState.SEARCHING}
    by_any, _ = flown((0.0, 0.0, 0.0), stage=ImmPdafTrack(least_moved_m=0.0))
    assert len(by_any) > 25


def test_a_small_object_near_a_wall_belongs_to_it():
    near = WALL_M.mean(axis=0) + np.array([0.0, -1.5, 0.0])
    fixes, _ = flown((0.3, 0.0, 0.0), seconds=6.0, others_m=WALL_M, place_m=near)
    assert fixes == []


def test_a_track_coasts_over_a_short_gap_and_ends_after_a_long_one():
    fixes, _ = flown((1.0, 0.0, 0.0), seconds=6.0, hidden_s=(3.0, 4.0))
    assert len({fix.track_id for fix in fixes}) == 1
    assert fixes[-1].stamp_ns > at_ns(5.5)
    _, states = flown((1.0, 0.0, 0.0), seconds=7.0, hidden_s=(2.5, 9.0))
    assert any(state.state is TrackingState.LOST for state in states)
    assert states[-1].state is TrackingState.SEARCHING


def test_from_a_driving_vehicle_a_standing_object_stands_still():
    stage, found = ImmPdafTrack(), []
    for k in range(40):
        t_s, driven_m = 0.1 * k, np.array([0.5 * k, 0.0, 0.0])
        motion = VehicleMotion(stamp_ns=at_ns(t_s), xyz_map_m=driven_m, R_map_vehicle=np.eye(3), covariance=None)
        stage.on_motion(motion)
        found += stage.on_points(swept([PLACE_M + np.array([10.0, 0.0, 0.0]) - driven_m], at_ns(t_s)))
    assert not [m for m in found if isinstance(m, DroneFix)]


def test_no_points_are_no_track():
    fixes, states = flown((1.0, 0.0, 0.0), hidden_s=(0.0, 9.0))
    assert fixes == []
    assert {state.state for state in states} == {TrackingState.SEARCHING}


def test_the_manoeuvring_model_gains_in_a_turn():
    def after(path):
        track = ImmPdaf(path(0.0), 0, SETTINGS)
        for k in range(1, 40):
            assert track.step(path(0.1 * k)[None], k * 100_000_000) == 1
        return track

    straight = after(lambda t: np.array([3.0 * t, 0.0, 10.0]))
    turning = after(lambda t: np.array([3.0 * np.sin(2.0 * t), 3.0 * np.cos(2.0 * t), 10.0]))
    assert straight.probabilities[0] > 0.5 > turning.probabilities[0]
    assert straight.probabilities.sum() == pytest.approx(1.0)
    position_m, velocity_mps, _ = straight.estimate()
    np.testing.assert_allclose(position_m, [11.7, 0.0, 10.0], atol=0.05)
    np.testing.assert_allclose(velocity_mps, [3.0, 0.0, 0.0], atol=0.2)


def test_a_measurement_outside_the_gate_changes_only_the_covariance():
    track, alone = (ImmPdaf(PLACE_M, 0, SETTINGS) for _ in range(2))
    for k in range(1, 6):
        for one in (track, alone):
            one.step(PLACE_M[None], k * 100_000_000)
    assert track.step((PLACE_M + np.array([30.0, 0.0, 0.0]))[None], 600_000_000) == 0
    assert alone.step(PLACE_M[None], 600_000_000) == 1
    np.testing.assert_allclose(track.estimate()[0], alone.estimate()[0], atol=0.05)
    assert np.trace(track.estimate()[2]) > np.trace(alone.estimate()[2])
