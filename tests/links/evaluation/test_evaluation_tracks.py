"""Continuity of tracks, reacquisition, searches and false tracks against numbers worked out by hand."""

from __future__ import annotations

import datetime
import math

import numpy as np
import pytest
from scipy import stats

from flow.link import LinkError
from links.evaluation.errors import poisson_upper
from links.evaluation.evaluation import MetricStatus
from links.evaluation.run_data import read_run
from links.evaluation.track_metrics import (
    count_tracks,
    gospa_m,
    longest_gap_s,
    merged,
    reacquisition_times_s,
    track_losses,
)
from tests.links.evaluation.made_runs import evaluated, make_run, truth_at, value

S = 1_000_000_000
EIGHT_HZ = np.arange(0.0, 10.0, 0.125)
NONE = np.zeros((0, 2), dtype=np.int64)


def ns(*times_s: float) -> np.ndarray:
    return np.round(np.array(times_s, dtype=float) * 1e9).astype(np.int64)


def spans(*pairs: tuple[float, float]) -> np.ndarray:
    return ns(*(t for pair in pairs for t in pair)).reshape(-1, 2)


def test_the_longest_gap_counts_both_ends_and_leaves_occlusions_out():
    hits = ns(1, 1.5, 4, 4.25, 9)
    assert longest_gap_s(hits, 0, 10 * S, NONE) == 4.75
    assert longest_gap_s(hits, 0, 20 * S, NONE) == 11.0
    assert longest_gap_s(hits, 1 * S, 5 * S, NONE) == 2.5
    assert longest_gap_s(hits, 0, 10 * S, spans((5, 8), (1.75, 2.0))) == 2.25
    assert longest_gap_s(hits, 0, 10 * S, spans((5, 1e6))) == 2.5
    assert longest_gap_s(ns(), 0, 3 * S, NONE) == 3.0


def test_spans_that_touch_are_one():
    assert merged(spans((5, 6), (1, 2), (2, 3), (5.5, 5.75))).tolist() == spans((1, 3), (5, 6)).tolist()
    assert merged(NONE).shape == (0, 2)


def test_each_occlusion_is_timed_from_its_end_to_the_first_accurate_output():
    accurate = ns(1, 6.5, 6.625, 20)
    times_s = reacquisition_times_s(accurate, spans((2, 6), (10, 12), (25, 28)), NONE, (0, 30 * S))
    assert times_s == [0.5, 8.0, math.inf]


def test_an_occlusion_after_which_no_output_is_expected_is_not_timed():
    """Occluded from the start; in sight for half a second only; after the end; out of reach."""
    assert reacquisition_times_s(ns(4), spans((0, 3)), NONE, (0, 10 * S)) == []
    assert reacquisition_times_s(ns(), spans((1, 3), (3.5, 5)), NONE, (0, 10 * S)) == [math.inf]
    assert reacquisition_times_s(ns(3.25), spans((1, 3), (3.5, 5)), NONE, (0, 5 * S)) == [0.25]
    assert reacquisition_times_s(ns(), spans((2, 12)), NONE, (0, 10 * S)) == []
    assert reacquisition_times_s(ns(), spans((2, 4)), spans((3, 9)), (0, 10 * S)) == []


def test_an_accurate_track_is_lost_by_a_gap_or_by_its_own_state():
    accurate = ns(1, 2, 3.5, 4)
    assert track_losses(accurate, [[]] * 4, NONE, 5 * S) == 1  # between 2 and 3.5
    assert track_losses(accurate, [[]] * 4, NONE, 6 * S) == 2  # and for 2 s at the end
    assert track_losses(accurate, [ns(1.5).tolist()] + [[]] * 3, NONE, 5 * S) == 2
    assert track_losses(accurate, [ns(2.5).tolist()] * 4, NONE, 5 * S) == 1  # a gap with the state LOST counts once


def test_an_occluded_drone_may_be_lost():
    accurate = ns(1, 2, 6)
    assert track_losses(accurate, [[]] * 3, spans((2.5, 5.5)), 7 * S) == 0
    assert track_losses(accurate, [ns(3).tolist()] * 3, spans((2.5, 5.5)), 7 * S) == 0
    assert track_losses(accurate, [[]] * 3, spans((3.25, 5.5)), 7 * S) == 1  # it was in sight for 1.25 s
    assert (
        track_losses(accurate, [[]] * 3, spans((1.5, 5.5)), 7 * S) == 0
    )  # accurate up to a later time, though occluded


def test_a_run_that_keeps_the_track_has_no_losses(tmp_path):
    hits = np.arange(0.05, 10, 0.2)
    e = evaluated(make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ), hits_s=hits, visible=[(0, 1)]))
    assert value(e, "track_losses") == 0
    assert value(e, "longest_return_gap_s") == pytest.approx(0.2)
    assert e.values["reacquisition_s"].status is MetricStatus.NOT_APPLICABLE
    assert e.values["identity_switches"].status is MetricStatus.NOT_APPLICABLE


def test_occlusions_gaps_and_returns_of_a_whole_run(tmp_path):
    """Accurate until 2 s and from 6.5 s on; occluded from 2.3 to 6 s; returns each 0.1 s in sight, none from 7 to 8 s."""
    t = EIGHT_HZ[(EIGHT_HZ <= 2) | (EIGHT_HZ >= 6.5)]
    hits = np.arange(0.05, 10, 0.1)
    hits = hits[(hits < 2.3) | ((hits > 6) & (hits < 7)) | (hits > 8)]
    visible = [(0, 1), (2.3, 0), (6, 1)]
    e = evaluated(make_run(tmp_path / "a", t, truth_at(t), hits_s=hits, visible=visible))
    assert value(e, "reacquisition_s") == pytest.approx(0.5)
    assert e.reacquisition_s == [0.5]
    assert value(e, "track_losses") == 0
    assert value(e, "longest_return_gap_s") == pytest.approx(1.1)  # 6.95 to 8.05
    assert value(e, "longest_return_gap_total_s") == pytest.approx(3.8)  # 2.25 to 6.05
    blind = evaluated(make_run(tmp_path / "b", t, truth_at(t), hits_s=hits))
    assert value(blind, "track_losses") == 1
    assert value(blind, "longest_return_gap_s") == pytest.approx(3.8)
    assert "all time in reach counts as in sight" in blind.values["track_losses"].note
    assert blind.values["reacquisition_s"].note == "the recording does not hold when the drone was occluded"


def test_a_track_in_state_lost_is_lost_and_the_state_of_another_track_does_not_count(tmp_path):
    states = [(0.0, "TRACKING", 1), (5.01, "LOST", 1), (3.0, "LOST", 2)]
    tracks = np.ones(len(EIGHT_HZ), dtype=int)
    e = evaluated(make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ), tracks=tracks, states=states))
    assert value(e, "track_losses") == 1
    assert (
        value(evaluated(make_run(tmp_path / "b", EIGHT_HZ, truth_at(EIGHT_HZ), states=states[2:])), "track_losses") == 0
    )


def test_a_drone_out_of_reach_may_be_lost(tmp_path):
    times = np.arange(0, 10.005, 0.01)
    path = truth_at(times) + np.where(((times > 3) & (times < 7))[:, None], [0.0, 0.0, 200.0], 0.0)
    t = EIGHT_HZ[(EIGHT_HZ < 3) | (EIGHT_HZ > 7.2)]
    assert value(evaluated(make_run(tmp_path / "a", t, truth_at(t), truth=path)), "track_losses") == 0


def test_a_run_that_was_never_accurate_failed_to_keep_a_track(tmp_path):
    e = evaluated(
        make_run(
            tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ) + 5.0, hits_s=[1.0, 2.0], visible=[(0, 1), (3, 0), (5, 1)]
        )
    )
    for key in ("track_losses", "longest_return_gap_s", "reacquisition_s"):
        assert e.values[key].failed, key
    assert e.values["reacquisition_s"].note == "not reacquired after 1 of 1 occlusions"
    assert value(e, "longest_return_gap_total_s") == pytest.approx(8.0)


def test_a_damaged_table_of_occlusions_is_named_with_its_line(tmp_path):
    folder = make_run(tmp_path / "a", [], [], visible=[(0, 1), (1, 2)])
    with pytest.raises(LinkError, match=r"truth_visible\.csv:3: visible is '2', not one of 0, 1"):
        read_run(folder)


def test_detection_rates_are_relative_to_the_observable_searches(tmp_path):
    """The drone is at (t, 3, 12). Returns in the five searches: 6, 5, 4, 1, 0."""
    searches = [
        (0.0, 2.0, [[1.0, 3.0, 12.0]]),
        (2.0, 4.0, [[30.0, 3.0, 12.0], [3.0, 3.0, 12.0]]),  # detected, but not as the best candidate
        (4.0, 6.0, []),
        (6.0, 8.0, [[7.0, 3.0, 12.0]]),
        (8.0, 10.0, []),
    ]
    hits = [1.0] * 6 + [3.0] * 5 + [5.0] * 4 + [7.0]
    e = evaluated(make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ), sweeps=searches, hits_s=hits))
    assert value(e, "observable_detection_rate") == pytest.approx(100 * 2 / 3)
    assert e.counts["observable_detection_rate"] == (2, 3)
    assert value(e, "missed_searches") == 2
    assert (value(e, "return_share"), value(e, "observable_share"), value(e, "detection_rate")) == (80.0, 60.0, 40.0)
    unseen = evaluated(make_run(tmp_path / "b", EIGHT_HZ, truth_at(EIGHT_HZ), sweeps=searches[3:], hits_s=hits))
    assert unseen.values["observable_detection_rate"].status is MetricStatus.NOT_APPLICABLE
    assert value(unseen, "return_share") == 50.0


def test_a_false_track_counts_once_until_it_has_a_gap_of_a_second():
    assert count_tracks(ns(1, 1.5, 2, 4, 4.5), None) == 2
    assert count_tracks(ns(1, 1.5, 2, 2.5), np.array([1, 2, 1, 2])) == 2
    assert count_tracks(ns(), None) == 0


def test_the_upper_bound_of_a_rate_leaves_5_percent():
    """P(N <= n) of a Poisson process of that mean, summed by hand."""
    assert poisson_upper(0) == pytest.approx(-math.log(0.05))
    for events in (1, 4):
        mean = poisson_upper(events)
        few = sum(math.exp(-mean) * mean**k / math.factorial(k) for k in range(events + 1))
        assert few == pytest.approx(0.05)
        assert stats.chi2.cdf(2 * mean, 2 * events + 2) == pytest.approx(0.95)


def test_gospa_counts_an_error_a_miss_and_each_false_estimate():
    nan = math.nan
    distance_m = np.array([[0.3, nan], [nan, nan], [5.0, nan], [0.3, 7.0], [0.6, 0.3]])
    expected = [0.3, math.sqrt(0.5), 1.0, math.sqrt(0.5 + 0.09), math.sqrt(0.5 + 0.09)]
    assert gospa_m(distance_m, True, 1.0) == pytest.approx(expected)
    assert gospa_m(distance_m, False, 1.0) == pytest.approx(np.sqrt([0.5, 0.0, 0.5, 1.0, 1.0]))


def test_gospa_is_that_of_stone_soup():
    metric = pytest.importorskip("stonesoup.metricgenerator.ospametric").GOSPAMetric(p=2, c=1.0)
    state = pytest.importorskip("stonesoup.types.state").State
    rng, when = np.random.default_rng(4), datetime.datetime(2025, 6, 1)
    compared = 0
    for _ in range(200):
        found = rng.normal(0, 0.6, (rng.integers(0, 5), 3))
        drone = bool(rng.integers(0, 2))
        truth = [state(np.zeros(3), timestamp=when)] if drone else []
        if not len(found) and not drone:
            continue
        theirs = metric.compute_gospa_metric([state(xyz, timestamp=when) for xyz in found], truth)[0].value["distance"]
        distance_m = np.linalg.norm(found, axis=1)[None] if len(found) else np.full((1, 1), np.nan)
        assert gospa_m(distance_m, drone, 1.0)[0] == pytest.approx(float(theirs))
        compared += 1
    assert compared > 100


def test_precision_and_gospa_of_a_run_with_a_second_track_that_is_false(tmp_path):
    t = np.concatenate([EIGHT_HZ, EIGHT_HZ])
    xyz = np.concatenate([truth_at(EIGHT_HZ), truth_at(EIGHT_HZ) + np.array([0.0, 8.0, 0.0])])
    tracks = np.repeat([1, 2], len(EIGHT_HZ))
    one = evaluated(make_run(tmp_path / "one", EIGHT_HZ, truth_at(EIGHT_HZ)))
    two = evaluated(make_run(tmp_path / "two", t, xyz, tracks=tracks))
    assert value(one, "precision") == 100.0
    assert value(two, "precision") == pytest.approx(50.0)
    assert value(one, "gospa_m") < 0.15 < math.sqrt(0.5) < value(two, "gospa_m") < 0.75
    assert (value(one, "false_tracks"), value(two, "false_tracks")) == (0, 1)


def test_an_output_counts_for_precision_and_gospa_only_while_it_is_recent(tmp_path):
    """Exact outputs for the first half of the run: then a miss, which is sqrt(1/2) m."""
    half = EIGHT_HZ[EIGHT_HZ <= 5.0]
    e = evaluated(make_run(tmp_path / "half", half, truth_at(half) + np.array([0.0, 0.0, 0.1])))
    assert value(e, "precision") == 100.0
    assert value(e, "gospa_m") == pytest.approx(0.5 * 0.1 + 0.5 * math.sqrt(0.5), abs=0.05)


def test_false_tracks_have_a_rate_and_a_bound_with_and_without_a_drone(tmp_path):
    t = np.array([0.0, 0.5, 4.0, 4.5])
    displaced = evaluated(make_run(tmp_path / "a", t, truth_at(t) + np.array([0.0, 5.0, 0.0])))
    empty = evaluated(make_run(tmp_path / "b", t, truth_at(t), truth="no drone"))
    for e in (displaced, empty):
        assert value(e, "false_tracks") == 2  # a pause of more than a second
        assert value(e, "false_tracks_per_h") == pytest.approx(2 * 360)
        assert value(e, "false_tracks_below_per_h") == pytest.approx(poisson_upper(2) * 360)
    none = evaluated(make_run(tmp_path / "c", [], []))
    assert value(none, "false_tracks_below_per_h") == pytest.approx(-math.log(0.05) * 360)
    assert value(none, "gospa_m") == pytest.approx(math.sqrt(0.5))
