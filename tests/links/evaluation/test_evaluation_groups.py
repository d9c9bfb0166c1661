"""Many runs summed up by words of the recordings' names and by what they were made with."""

from __future__ import annotations

import csv
import math
import re

import numpy as np
import pytest

from flow.link import LinkError
from links.evaluation import evaluate, read_run
from links.evaluation.compare import uneven
from links.evaluation.groups import Spread, groups, parse_by
from links.evaluation.no_drone import alarms
from links.evaluation.summaries import group_summary
from links.evaluation.tables import median_columns
from tests.links.command import grd
from tests.links.evaluation.made_runs import add_pose, make_run, truth_at, yaw_quaternion

T_S = np.arange(0.0, 10.0, 0.1)


def judge(*folders):
    runs = [read_run(folder) for folder in folders]
    return [evaluate(run, output) for run in runs for output in run.outputs]


@pytest.fixture
def judged(tmp_path):
    """Three runs: right all the time, 5 m off all the time, silent."""
    return judge(
        make_run(tmp_path / "a", T_S, truth_at(T_S), recording="street-10m-s1"),
        make_run(tmp_path / "b", T_S, truth_at(T_S) + np.array([5.0, 0.0, 0.0]), recording="street-20m-s1"),
        make_run(tmp_path / "c", [], [], recording="park-10m-s1"),
    )


@pytest.fixture
def two_configs(tmp_path):
    """Two recordings by two configurations, in closed loop: same names, other recordings, folders called alike.

    The paper's finds one of two 3 s late and 0.2 m off, ours both at once and 0.1 m off.
    """
    late = T_S[T_S >= 3]
    for config, flights in {
        "paper": {"a-10m-s1": (late, 0.2), "b-10m-s1": ([], 0.0)},
        "ours": {"a-10m-s1": (T_S, 0.1), "b-10m-s1": (T_S, 0.1)},
    }.items():
        for recording, (t, offset_m) in flights.items():
            t = np.asarray(t, dtype=float)
            make_run(
                tmp_path / config / recording,
                t,
                truth_at(t) + np.array([0, 0, offset_m]),
                recording=recording,
                config=config,
                sweeps=[(0, 5, truth_at(t[:1]).tolist()), (5, 10, [])],
                hits_s=np.arange(0.05, 10, 0.5).tolist(),
                visible=[(0, 1)],
            )
    return [tmp_path / config / recording for recording in ("a-10m-s1", "b-10m-s1") for config in ("paper", "ours")]


def test_a_group_counts_right_false_and_silent_runs(judged):
    park, street, whole = groups(judged, (1,))
    assert (park.words, park.runs, park.ever_right, park.silent, park.mostly_false) == (("park",), 1, 0, 1, 0)
    assert (street.words, street.runs, street.ever_right, street.silent, street.mostly_false) == (
        ("street",),
        2,
        1,
        0,
        1,
    )
    assert (whole.words, whole.runs) == (("all",), 3)
    assert street.right_share == pytest.approx(50, abs=1)
    assert park.right_share == 0
    assert street.rmse_m.median == pytest.approx(0, abs=1e-6)
    assert street.false_per_h == pytest.approx(100 / (20 / 3600))


def test_numbers_stand_in_their_order_and_each_run_in_one_group(judged):
    found = groups(judged, (2,))
    assert [g.words for g in found] == [("10m",), ("20m",), ("all",)]
    assert sum(g.runs for g in found[:-1]) == len(judged) == found[-1].runs


def test_several_words_are_cells(judged):
    found = groups(judged, (2, 1))
    assert [g.words for g in found] == [("10m", "park"), ("10m", "street"), ("20m", "street"), ("all", "")]


def test_a_word_that_is_not_there_is_an_error(judged):
    with pytest.raises(LinkError, match=r"--by 4: 'street-10m-s1' has 3 words"):
        groups(judged, (4,))


@pytest.mark.parametrize(("text", "key"), [("2", (2,)), ("3,1", (3, 1)), ("config", ()), ("config, 2", (2,))])
def test_what_to_group_by_is_words_and_configurations(text, key):
    assert parse_by(text) == key


@pytest.mark.parametrize("text", ["", "0", "-1", "range", "2,", "²"])
def test_other_words_to_group_by_are_refused(text):
    with pytest.raises(LinkError, match="a word's number from 1 on, several as in 2,3, or 'config' is wanted"):
        parse_by(text)


def test_a_failure_is_infinite_in_a_median_and_a_95_percent_point():
    spread = Spread((*np.arange(1.0, 19.0).tolist(), 50.0, math.inf))
    assert (spread.median, spread.p95, spread.largest) == (10.5, 50.0, 50.0)
    assert Spread((1.0, math.inf, math.inf)).median == math.inf
    assert Spread((1.0, math.inf)).p95 == math.inf
    assert (Spread(()).median, Spread(()).p95, Spread(()).largest) == (None, None, None)
    assert Spread((2.0,)).p95 == 2.0


def test_configurations_stand_side_by_side_in_every_group(two_configs):
    found = groups(judge(*two_configs), (1,))
    assert [(g.words[0], g.config, g.runs) for g in found] == [
        ("a", "paper", 1), ("a", "ours", 1), ("b", "paper", 1), ("b", "ours", 1), ("all", "paper", 2), ("all", "ours", 2)
    ]  # fmt: skip
    paper, ours = found[-2:]
    assert (paper.ever_right, paper.silent, ours.ever_right) == (1, 1, 2)
    assert paper.first_right_s.values == (pytest.approx(3.0), math.inf)
    assert paper.shortest_failed_s == pytest.approx(10)
    assert ours.first_right_s.median == 0.0
    assert (paper.found_when_seen, ours.found_when_seen) == ((5, 20), (10, 20))  # seconds
    assert paper.hit_gap_s.values == (pytest.approx(0.5), math.inf)
    assert (paper.rmse_m.median, ours.rmse_m.median) == (pytest.approx(0.2), pytest.approx(0.1))
    assert ours.inside_95 == (200, 200)
    assert (paper.lost, ours.lost) == (0, 0)


def test_found_of_seen_weighs_time_and_not_searches_of_which_finding_makes_more(tmp_path):
    """Found in each of ten seconds, which are ten searches, and in another run not at all, in two."""
    hits = np.arange(0.05, 10, 0.1).tolist()
    found_it = [(k, k + 1, truth_at(np.array([k])).tolist()) for k in range(10)]
    half = [*found_it[:5], (5, 10, [])]
    runs = judge(
        make_run(tmp_path / "a", [], [], sweeps=found_it, hits_s=hits, recording="a-s1", config="ours"),
        make_run(
            tmp_path / "b", [], [], sweeps=[(0, 5, []), (5, 10, [])], hits_s=hits, recording="b-s1", config="ours"
        ),
        make_run(tmp_path / "c", [], [], sweeps=half, hits_s=hits, recording="c-s1", config="ours"),
    )
    assert [e.values["found_when_seen_share"].value for e in runs] == pytest.approx([100, 0, 50])
    assert [e.values["found_share"].value for e in runs] == pytest.approx([100, 0, 50])
    (whole,) = groups(runs, ())
    assert whole.found_when_seen == pytest.approx((15, 30))
    assert whole.seen == pytest.approx((30, 30))


def test_what_was_good_enough_for_the_autopilot_is_summed_up(tmp_path):
    half = T_S < 5.0
    for name, off_m, good in (("a-10m-s1", 0.3, half), ("b-10m-s1", 0.6, half & False)):
        folder = make_run(tmp_path / name, T_S, truth_at(T_S), recording=name)
        off = np.where(half, off_m, 4.0)[:, None] * np.array([0.0, 0.0, 1.0])
        add_pose(folder, T_S, truth_at(T_S) + off, yaw_quaternion(0 * T_S), np.eye(6) * 0.01, good)
    poses = [evaluate(run, run.outputs[0]) for run in (read_run(folder) for folder in sorted(tmp_path.iterdir()))]
    (group,) = groups(poses, ())
    assert group.good_share == pytest.approx(25.0, abs=0.5)
    assert group.good_max_m == pytest.approx(0.3)
    summary = group_summary([group], ())
    assert summary.rows[0][summary.heads.index("sent:\nmax [m]")] == "0.30"


def test_one_row_for_each_configuration_is_the_table_of_ablations(two_configs):
    summary = group_summary(groups(judge(*two_configs), ()), ())
    assert summary.heads[:2] == ["config", "runs"]
    assert [row[:2] for row in summary.rows] == [["paper", "2"], ["ours", "2"]]
    column = summary.heads.index("first\n95 % [s]")
    assert [row[column] for row in summary.rows] == [">10", "0.0"]
    assert "back" not in summary.heads
    assert summary.note.endswith(
        "Nothing to tell: back, back median [s], back max [s], sent [%], sent: max [m], sent: max [deg]."
    )


@pytest.mark.parametrize(
    ("folder", "sets", "config"),
    [
        ("flight-1", [], "ours"),
        ("flight-1-ours", [], "ours"),
        ("flight-1-ours-2", [], "ours"),
        ("flight-1-ours-2", ["track.misses=false", "viewer.file=null"], "ours track.misses=false"),
        ("flight-1-without_misses", ["track.misses=false"], "without_misses"),
        ("anything", ["track.misses=false"], "ours track.misses=false"),
    ],
)
def test_a_run_knows_what_it_was_made_with(tmp_path, folder, sets, config):
    made = make_run(tmp_path / folder, [], [], recording="flight-1", config="ours", sets=sets)
    assert read_run(made).config == config


def test_what_one_configuration_was_not_run_on_is_warned_of(two_configs):
    assert uneven(judge(*two_configs)) == []
    assert uneven(judge(*two_configs[:3], two_configs[1])) == [
        "ours: not run on b-10m-s1",
        "ours: counted twice or more on a-10m-s1",
    ]


def test_a_flight_judged_by_its_pose_in_one_configuration_and_by_its_fixes_in_the_other_was_run_on_by_both(tmp_path):
    ours = make_run(tmp_path / "ours", T_S, truth_at(T_S), recording="a-10m-s1", config="ours")
    add_pose(ours, T_S, truth_at(T_S), np.tile([0.0, 0.0, 0.0, 1.0], (len(T_S), 1)), None)
    papers = make_run(tmp_path / "paper", T_S, truth_at(T_S), recording="a-10m-s1", config="paper")
    both = judge(ours, papers)
    chosen = [e for e in both if e.output.name == ("pose" if e.run.config == "ours" else "fix")]
    assert [e.run.config for e in chosen] == ["ours", "paper"], [e.output.name for e in both]
    assert uneven(chosen) == []


def test_drone_free_runs_are_pooled_with_a_bound_and_named(tmp_path):
    """An hour in two runs: one invented drone of 5 outputs, then another a minute later; the second run is quiet."""
    told = [100.0, 100.5, 101.0, 101.5, 102.0, 160.0]
    runs = judge(
        make_run(
            tmp_path / "a", told, np.ones((6, 3)), truth="no drone", duration_s=1800, recording="x", config="ours"
        ),
        make_run(tmp_path / "b", [], [], truth="no drone", duration_s=1800, recording="y", config="ours"),
        make_run(tmp_path / "c", [], [], truth="no drone", duration_s=1800, recording="x", config="paper"),
    )
    ours, paper = alarms(runs)
    assert (ours.runs, ours.outputs, ours.invented, ours.by_recording) == (2, 6, 2, {"x": 2})
    assert ours.per_h == pytest.approx(2.0)
    assert ours.upper_per_h == pytest.approx(6.296, abs=1e-3)  # Poisson, 2 events
    assert (paper.hours, paper.per_h, paper.upper_per_h) == (
        pytest.approx(0.5),
        0.0,
        pytest.approx(2 * 2.996, abs=1e-2),
    )
    text = grd("evaluate", tmp_path / "a", tmp_path / "b", tmp_path / "c", "--by", "config", code=1)
    assert "ours: drones invented in x (2)" in text
    assert re.search(r"ours +│ +2 │ +1 │ +6 │ +0 │ +2 │ +2 │ +6.3 │", text)


def test_the_command_puts_configurations_side_by_side(two_configs, tmp_path):
    text = grd("evaluate", *two_configs, "--by", "2,1", "--by", "config", "--report", tmp_path / "r.html", code=1)
    assert re.search(r"│ 10m +│ a +│ paper +│ +1 │", text)
    assert re.search(r"│ all +│ +│ ours +│ +2 │", text)
    assert text.count("by config") == 1
    assert "by word 2, 1 of the recording&#x27;s name" in (tmp_path / "r.html").read_text()
    unasked = grd("evaluate", *two_configs, code=1)
    assert "by config" in unasked
    assert [name for name, _ in median_columns(judge(*two_configs))] == ["paper: median of 2", "ours: median of 2"]
    assert "--by 9: 'a-10m-s1' has 3 words" in grd("evaluate", *two_configs, "--by", "9", code=2)
    assert "with --by config" in grd("evaluate", *two_configs, "--against", two_configs[0], code=2)


def test_the_table_for_other_programs_has_a_line_a_run(two_configs, tmp_path):
    grd("evaluate", *two_configs, "--csv", tmp_path / "new" / "runs.csv", code=1)
    rows = list(csv.DictReader((tmp_path / "new" / "runs.csv").open()))
    assert [(row["recording"], row["config"]) for row in rows] == [
        ("a-10m-s1", "paper"), ("a-10m-s1", "ours"), ("b-10m-s1", "paper"), ("b-10m-s1", "ours")
    ]  # fmt: skip
    assert float(rows[0]["rmse_m"]) == pytest.approx(0.2)
    assert (rows[2]["rmse_m"], rows[2]["outputs"], rows[2]["right_share"]) == ("inf", "0", "0")
    assert rows[0]["rmse_yaw_deg"] == ""
    assert (rows[1]["found_when_seen_share_count"], rows[1]["found_when_seen_share_of"]) == ("1", "2")
    assert (rows[1]["found_when_seen_share_s"], rows[1]["found_when_seen_share_of_s"]) == ("5.0", "10.0")
