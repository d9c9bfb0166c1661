"""What is kept, lost, found again and found at all, against numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flow.link import LinkError
from links.evaluation import evaluate, read_run
from links.evaluation.faults import stretches
from links.evaluation.judged import Evaluation
from links.evaluation.keeping import longest_gap_s, lost_count, merged, times_to_find_again_s
from links.evaluation.statistics import chi2_cdf, poisson_upper
from tests.links.evaluation.made_runs import make_run, truth_at

S = 1_000_000_000
EIGHT_HZ = np.arange(0.0, 10.0, 0.125)
NONE = np.zeros((0, 2), dtype=np.int64)


def judge(folder) -> Evaluation:
    run = read_run(folder)
    return evaluate(run, run.outputs[0])


def value(e: Evaluation, key: str) -> float:
    found = e.values[key]
    assert found.value is not None, (key, found.note)
    return found.value


def ns(*times_s: float) -> np.ndarray:
    return np.round(np.array(times_s, dtype=float) * 1e9).astype(np.int64)


def spans(*pairs: tuple[float, float]) -> np.ndarray:
    return ns(*(t for pair in pairs for t in pair)).reshape(-1, 2)


def test_the_longest_gap_counts_both_ends_and_leaves_hidden_time_out():
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


def test_each_coming_back_is_timed_until_the_first_right_output():
    right = ns(1, 6.5, 6.625, 20)
    back = times_to_find_again_s(right, spans((2, 6), (10, 12), (25, 28)), NONE, (0, 30 * S))
    assert back == [0.5, 8.0, math.inf]


def test_a_coming_back_that_asks_for_nothing_is_not_timed():
    """Hidden from the start; back for half a second only; back after the end; back out of reach."""
    assert times_to_find_again_s(ns(4), spans((0, 3)), NONE, (0, 10 * S)) == []
    assert times_to_find_again_s(ns(), spans((1, 3), (3.5, 5)), NONE, (0, 10 * S)) == [math.inf]
    assert times_to_find_again_s(ns(3.25), spans((1, 3), (3.5, 5)), NONE, (0, 5 * S)) == [0.25]
    assert times_to_find_again_s(ns(), spans((2, 12)), NONE, (0, 10 * S)) == []
    assert times_to_find_again_s(ns(), spans((2, 4)), spans((3, 9)), (0, 10 * S)) == []


def test_a_right_track_is_lost_by_silence_or_by_its_own_word():
    right = ns(1, 2, 3.5, 4)
    assert lost_count(right, [[]] * 4, NONE, 5 * S) == 1  # between 2 and 3.5
    assert lost_count(right, [[]] * 4, NONE, 6 * S) == 2  # and for 2 s at the end
    assert lost_count(right, [ns(1.5).tolist()] + [[]] * 3, NONE, 5 * S) == 2
    assert lost_count(right, [ns(2.5).tolist()] * 4, NONE, 5 * S) == 1  # a silence that was said counts once


def test_a_drone_that_hides_may_be_lost():
    right = ns(1, 2, 6)
    assert lost_count(right, [[]] * 3, spans((2.5, 5.5)), 7 * S) == 0
    assert lost_count(right, [ns(3).tolist()] * 3, spans((2.5, 5.5)), 7 * S) == 0
    assert lost_count(right, [[]] * 3, spans((3.25, 5.5)), 7 * S) == 1  # it was in sight for 1.25 s
    assert lost_count(right, [[]] * 3, spans((1.5, 5.5)), 7 * S) == 0  # right to the last, though hidden


def test_a_run_that_keeps_the_drone_has_lost_nothing(tmp_path):
    hits = np.arange(0.05, 10, 0.2)
    e = judge(make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ), hits_s=hits, visible=[(0, 1)]))
    assert value(e, "lost_count") == 0
    assert value(e, "longest_hit_gap_s") == pytest.approx(0.2)
    assert not e.values["reacquired_s"].applies
    assert not e.values["identity_swaps"].applies


def test_hiding_silence_and_returns_of_a_whole_run(tmp_path):
    """Right until 2 s and from 6.5 s on; hidden from 2.3 to 6 s; returns each 0.1 s while in sight, none from 7 to 8 s."""
    t = EIGHT_HZ[(EIGHT_HZ <= 2) | (EIGHT_HZ >= 6.5)]
    hits = np.arange(0.05, 10, 0.1)
    hits = hits[(hits < 2.3) | ((hits > 6) & (hits < 7)) | (hits > 8)]
    shown = [(0, 1), (2.3, 0), (6, 1)]
    e = judge(make_run(tmp_path / "a", t, truth_at(t), hits_s=hits, visible=shown))
    assert value(e, "reacquired_s") == pytest.approx(0.5)
    assert e.reappeared_s == [0.5]
    assert value(e, "lost_count") == 0
    assert value(e, "longest_hit_gap_s") == pytest.approx(1.1)  # 6.95 to 8.05
    assert value(e, "longest_hit_gap_whole_s") == pytest.approx(3.8)  # 2.25 to 6.05
    blind = judge(make_run(tmp_path / "b", t, truth_at(t), hits_s=hits))
    assert value(blind, "lost_count") == 1
    assert value(blind, "longest_hit_gap_s") == pytest.approx(3.8)
    assert "all time in reach counts as in sight" in blind.values["lost_count"].note
    assert blind.values["reacquired_s"].note == "the recording does not say when the drone was hidden"


def test_a_track_that_says_lost_is_lost_and_another_ones_word_does_not_count(tmp_path):
    states = [(0.0, "TRACKING", 1), (5.01, "LOST", 1), (3.0, "LOST", 2)]
    tracks = np.ones(len(EIGHT_HZ), dtype=int)
    e = judge(make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ), tracks=tracks, states=states))
    assert value(e, "lost_count") == 1
    assert value(judge(make_run(tmp_path / "b", EIGHT_HZ, truth_at(EIGHT_HZ), states=states[2:])), "lost_count") == 0


def test_a_drone_out_of_reach_may_be_lost(tmp_path):
    times = np.arange(0, 10.005, 0.01)
    path = truth_at(times) + np.where(((times > 3) & (times < 7))[:, None], [0.0, 0.0, 200.0], 0.0)
    t = EIGHT_HZ[(EIGHT_HZ < 3) | (EIGHT_HZ > 7.2)]
    assert value(judge(make_run(tmp_path / "a", t, truth_at(t), truth=path)), "lost_count") == 0


def test_a_run_that_never_was_right_failed_to_keep_anything(tmp_path):
    e = judge(
        make_run(
            tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ) + 5.0, hits_s=[1.0, 2.0], visible=[(0, 1), (3, 0), (5, 1)]
        )
    )
    for key in ("lost_count", "longest_hit_gap_s", "reacquired_s"):
        assert e.values[key].failed, key
    assert e.values["reacquired_s"].note == "1 of 1 times it was not found again"
    assert value(e, "longest_hit_gap_whole_s") == pytest.approx(8.0)


def test_a_damaged_table_of_what_was_in_sight_is_named_with_its_line(tmp_path):
    folder = make_run(tmp_path / "a", [], [], visible=[(0, 1), (1, 2)])
    with pytest.raises(LinkError, match=r"truth_visible\.csv:3: visible is '2', neither 0 nor 1"):
        read_run(folder)


def test_searches_are_judged_by_what_could_be_seen_in_them(tmp_path):
    """The drone is at (t, 3, 12). Returns in the five searches: 6, 5, 4, 1, 0."""
    searches = [
        (0.0, 2.0, [[1.0, 3.0, 12.0]]),
        (2.0, 4.0, [[30.0, 3.0, 12.0], [3.0, 3.0, 12.0]]),  # seen, but not as the best one
        (4.0, 6.0, []),
        (6.0, 8.0, [[7.0, 3.0, 12.0]]),
        (8.0, 10.0, []),
    ]
    hits = [1.0] * 6 + [3.0] * 5 + [5.0] * 4 + [7.0]
    e = judge(make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ), sweeps=searches, hits_s=hits))
    assert value(e, "found_when_seen_share") == pytest.approx(100 * 2 / 3)
    assert e.counts["found_when_seen_share"] == (2, 3)
    assert value(e, "missed_sweeps") == 2
    assert (value(e, "hit_share"), value(e, "seen_share"), value(e, "found_share")) == (80.0, 60.0, 40.0)
    unseen = judge(make_run(tmp_path / "b", EIGHT_HZ, truth_at(EIGHT_HZ), sweeps=searches[3:], hits_s=hits))
    assert not unseen.values["found_when_seen_share"].applies
    assert value(unseen, "hit_share") == 50.0


def test_an_invented_drone_is_one_however_often_it_is_told():
    assert stretches(ns(1, 1.5, 2, 4, 4.5), None) == 2
    assert stretches(ns(1, 1.5, 2, 2.5), np.array([1, 2, 1, 2])) == 2
    assert stretches(ns(), None) == 0


def test_the_upper_bound_of_a_rate_leaves_5_percent():
    """P(N <= n) of a Poisson process of that mean, summed by hand."""
    assert poisson_upper(0) == pytest.approx(-math.log(0.05))
    for events in (1, 4):
        mean = poisson_upper(events)
        few = sum(math.exp(-mean) * mean**k / math.factorial(k) for k in range(events + 1))
        assert few == pytest.approx(0.05)
        assert chi2_cdf(2 * mean, 2 * events + 2) == pytest.approx(0.95)
