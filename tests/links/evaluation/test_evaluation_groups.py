"""Many runs grouped by fields of the recordings' names and by configuration."""

from __future__ import annotations

import csv
import math
import re

import numpy as np
import pandas as pd
import pytest

from flow.link import LinkError
from links.evaluation.comparison import uneven_warnings
from links.evaluation.groups import (
    false_track_numbers,
    group_numbers,
    group_table,
    grouped,
    parse_by,
    quantile_95,
)
from links.evaluation.run_data import OutputKind, read_run
from links.evaluation.tables import median_columns, medians, read_parquet, runs_table
from tests.command import grd
from tests.links.evaluation.made_runs import add_pose, all_evaluated, evaluated, make_run, truth_at, yaw_quaternion

T_S = np.arange(0.0, 10.0, 0.1)


def numbers(evaluations, key):
    """Statistics of each group by heading, with line breaks as spaces, and the fields of the group."""
    groups = grouped(runs_table(evaluations), key)
    table = group_numbers(groups)
    table.columns = [head.replace("\n", " ") for head in table.columns]
    rows = zip(table.to_dict("records"), groups, strict=True)
    return [row | {"fields": fields, "config": config} for row, (fields, config, _) in rows]


@pytest.fixture
def three_runs(tmp_path):
    """Three runs: accurate all the time, 5 m off all the time, without output."""
    return all_evaluated(
        make_run(tmp_path / "a", T_S, truth_at(T_S), recording="street-10m-s1"),
        make_run(tmp_path / "b", T_S, truth_at(T_S) + np.array([5.0, 0.0, 0.0]), recording="street-20m-s1"),
        make_run(tmp_path / "c", [], [], recording="park-10m-s1"),
    )


@pytest.fixture
def two_configs(tmp_path):
    """Two recordings by two configurations, in closed loop: other recordings with the same names and folders.

    `paper` detects one of two drones 3 s late and 0.2 m off, `estimate` both at once and 0.1 m off.
    """
    late = T_S[T_S >= 3]
    for config, flights in {
        "paper": {"a-10m-s1": (late, 0.2), "b-10m-s1": ([], 0.0)},
        "estimate": {"a-10m-s1": (T_S, 0.1), "b-10m-s1": (T_S, 0.1)},
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
    return [tmp_path / config / recording for recording in ("a-10m-s1", "b-10m-s1") for config in ("paper", "estimate")]


def test_a_group_counts_accurate_false_and_empty_runs(three_runs):
    park, street, whole = numbers(three_runs, (1,))
    counts = ("runs", "ever accurate", "no output", "mostly false")
    assert (park["fields"], [park[name] for name in counts]) == (("park",), [1, 0, 1, 0])
    assert (street["fields"], [street[name] for name in counts]) == (("street",), [2, 1, 0, 1])
    assert (whole["fields"], whole["runs"]) == (("all",), 3)
    assert street["track accuracy [%]"] == pytest.approx(50, abs=1)
    assert park["track accuracy [%]"] == 0
    assert street["3D RMSE median [m]"] == pytest.approx(0, abs=1e-6)
    assert street["false [/h]"] == pytest.approx(100 / (20 / 3600))
    assert whole["false tracks [/h]"] == pytest.approx(1 / (30 / 3600))
    assert whole["below [/h] (95 %)"] == pytest.approx(4.744 / (30 / 3600), rel=1e-3)  # Poisson, 1 event


def test_numbers_are_in_their_order_and_each_run_is_in_one_group(three_runs):
    found = numbers(three_runs, (2,))
    assert [g["fields"] for g in found] == [("10m",), ("20m",), ("all",)]
    assert sum(g["runs"] for g in found[:-1]) == len(three_runs) == found[-1]["runs"]


def test_several_fields_are_cells(three_runs):
    fields = [fields for fields, *_ in grouped(runs_table(three_runs), (2, 1))]
    assert fields == [("10m", "park"), ("10m", "street"), ("20m", "street"), ("all", "")]


def test_a_missing_field_is_an_error(three_runs):
    with pytest.raises(LinkError, match=r"--by 4: 'street-10m-s1' has 3 fields"):
        grouped(runs_table(three_runs), (4,))


@pytest.mark.parametrize(("text", "key"), [("2", (2,)), ("3,1", (3, 1)), ("config", ()), ("config, 2", (2,))])
def test_by_takes_fields_and_configurations(text, key):
    assert parse_by(text) == key


@pytest.mark.parametrize("text", ["", "0", "-1", "range", "2,", "²"])
def test_by_rejects_everything_else(text):
    with pytest.raises(LinkError, match="expected the number of a field from 1 on, several as in 2,3, or 'config'"):
        parse_by(text)


def test_a_failure_is_infinite_in_a_median_and_a_95_percent_point():
    def median(values):
        return medians(values.to_frame("metric")).loc["metric", "median"]

    ranks = pd.Series([*np.arange(1.0, 19.0).tolist(), 50.0, math.inf])
    assert (median(ranks), quantile_95(ranks)) == (10.5, 50.0)
    assert median(pd.Series([1.0, math.inf, math.inf])) == math.inf
    assert median(pd.Series([1.0, math.inf])) == math.inf
    assert quantile_95(pd.Series([1.0, math.inf])) == math.inf
    nothing = pd.Series([math.nan])
    assert math.isnan(median(nothing))
    assert math.isnan(quantile_95(nothing))
    assert quantile_95(pd.Series([2.0])) == 2.0
    for n in (19, 20, 21, 40, 100):  # the smallest value that 95 % do not exceed
        assert quantile_95(pd.Series(np.arange(1.0, n + 1))) == math.ceil(0.95 * n - 1e-9)


def test_configurations_are_side_by_side_in_every_group(two_configs):
    evaluations = all_evaluated(*two_configs)
    found = numbers(evaluations, (1,))
    assert [(g["fields"][0], g["config"], g["runs"]) for g in found] == [
        ("a", "paper", 1), ("a", "estimate", 1), ("b", "paper", 1), ("b", "estimate", 1), ("all", "paper", 2), ("all", "estimate", 2)
    ]  # fmt: skip
    paper, estimate = found[-2:]
    assert (paper["ever accurate"], paper["no output"], estimate["ever accurate"]) == (1, 1, 2)
    runs = runs_table(evaluations).groupby("config")
    assert sorted(runs.first_accurate_s.get_group("paper")) == [pytest.approx(3.0), math.inf]
    assert (paper["first accurate median [s]"], estimate["first accurate median [s]"]) == (math.inf, 0.0)
    assert (paper["of observable [%]"], estimate["of observable [%]"]) == (100 * 5 / 20, 100 * 10 / 20)
    seconds = runs[["observable_detection_rate_s", "observable_detection_rate_of_s"]].sum()
    assert seconds.loc["paper"].tolist() == [5, 20]
    assert seconds.loc["estimate"].tolist() == [10, 20]
    assert sorted(runs.longest_return_gap_s.get_group("paper")) == [pytest.approx(0.5), math.inf]
    assert (paper["return gap median [s]"], paper["return gap max [s]"]) == (math.inf, pytest.approx(0.5))
    rmse = "3D RMSE median [m]"
    assert (paper[rmse], estimate[rmse]) == (pytest.approx(0.2), pytest.approx(0.1))
    counts = runs[["inside_95_share_count", "inside_95_share_of"]].sum()
    assert counts.loc["estimate"].tolist() == [200, 200]
    assert estimate["in 95 % [%]"] == 100
    assert (paper["track losses"], estimate["track losses"]) == (0, 0)


def test_detection_rates_weigh_time_and_not_searches_of_which_detections_make_more(tmp_path):
    """Detected in each of ten seconds, which are ten searches, and in another run not at all, in two."""
    hits = np.arange(0.05, 10, 0.1).tolist()
    detected = [(k, k + 1, truth_at(np.array([k])).tolist()) for k in range(10)]
    half = [*detected[:5], (5, 10, [])]
    runs = all_evaluated(
        make_run(tmp_path / "a", [], [], sweeps=detected, hits_s=hits, recording="a-s1", config="estimate"),
        make_run(
            tmp_path / "b", [], [], sweeps=[(0, 5, []), (5, 10, [])], hits_s=hits, recording="b-s1", config="estimate"
        ),
        make_run(tmp_path / "c", [], [], sweeps=half, hits_s=hits, recording="c-s1", config="estimate"),
    )
    assert [e.values["observable_detection_rate"].value for e in runs] == pytest.approx([100, 0, 50])
    assert [e.values["detection_rate"].value for e in runs] == pytest.approx([100, 0, 50])
    (whole,) = numbers(runs, ())
    assert whole["of observable [%]"] == pytest.approx(100 * 15 / 30)
    assert whole["observable [%]"] == pytest.approx(100)
    seconds = runs_table(runs)[["observable_detection_rate_s", "observable_detection_rate_of_s"]].sum()
    assert seconds.tolist() == pytest.approx([15, 30])


def test_poses_that_the_autopilot_gate_accepts_are_summed_up(tmp_path):
    half = T_S < 5.0
    for name, off_m, good in (("a-10m-s1", 0.3, half), ("b-10m-s1", 0.6, half & False)):
        folder = make_run(tmp_path / name, T_S, truth_at(T_S), recording=name)
        off = np.where(half, off_m, 4.0)[:, None] * np.array([0.0, 0.0, 1.0])
        add_pose(folder, T_S, truth_at(T_S) + off, yaw_quaternion(0 * T_S), np.eye(6) * 0.01, good)
    poses = [evaluated(folder) for folder in sorted(tmp_path.iterdir())]
    (group,) = numbers(poses, ())
    assert group["sent [%]"] == pytest.approx(25.0, abs=0.5)
    assert group["sent: max [m]"] == pytest.approx(0.3)
    assert group_table(runs_table(poses), ()).frame["sent:\nmax [m]"].tolist() == ["0.30"]


def test_one_row_for_each_configuration_is_the_table_of_ablations(two_configs):
    table = group_table(runs_table(all_evaluated(*two_configs)), ())
    assert table.frame.columns[:2].tolist() == ["config", "runs"]
    assert table.frame[["config", "runs"]].to_numpy().tolist() == [["paper", "2"], ["estimate", "2"]]
    assert table.frame["first accurate\n95 % [s]"].tolist() == [">10", "0.0"]
    assert "reacquired" not in table.frame
    assert table.note.endswith(
        "Without values: reacquired, of occlusions, reacquired median [s], reacquired max [s], sent [%], sent: max [m], "
        "sent: max [deg]."
    )


@pytest.mark.parametrize(
    ("folder", "sets", "config"),
    [
        ("flight-1", [], "estimate"),
        ("flight-1-estimate", [], "estimate"),
        ("flight-1-estimate-2", [], "estimate"),
        (
            "flight-1-estimate-2",
            ["track.use_pass_throughs=false", "viewer.file=null"],
            "estimate track.use_pass_throughs=false",
        ),
        ("flight-1-no_pass_throughs", ["track.use_pass_throughs=false"], "no_pass_throughs"),
        ("anything", ["track.use_pass_throughs=false"], "estimate track.use_pass_throughs=false"),
    ],
)
def test_a_run_has_the_name_of_its_configuration(tmp_path, folder, sets, config):
    made = make_run(tmp_path / folder, [], [], recording="flight-1", config="estimate", sets=sets)
    assert read_run(made).config == config


def test_a_recording_that_a_configuration_was_not_run_on_is_a_warning(two_configs):
    assert uneven_warnings(all_evaluated(*two_configs)) == []
    assert uneven_warnings(all_evaluated(*two_configs[:3], two_configs[1])) == [
        "estimate: not run on b-10m-s1",
        "estimate: counted twice or more on a-10m-s1",
    ]


def test_a_recording_with_a_pose_in_one_configuration_and_fixes_in_the_other_was_run_with_both(tmp_path):
    estimate = make_run(tmp_path / "estimate", T_S, truth_at(T_S), recording="a-10m-s1", config="estimate")
    add_pose(estimate, T_S, truth_at(T_S), np.tile([0.0, 0.0, 0.0, 1.0], (len(T_S), 1)), None)
    papers = make_run(tmp_path / "paper", T_S, truth_at(T_S), recording="a-10m-s1", config="paper")
    both = all_evaluated(estimate, papers)
    kinds = {"estimate": OutputKind.POSE, "paper": OutputKind.FIX}
    chosen = [e for e in both if e.output.kind is kinds[e.run.config]]
    assert [e.run.config for e in chosen] == ["estimate", "paper"], [e.output.kind for e in both]
    assert uneven_warnings(chosen) == []


def test_runs_without_a_drone_are_pooled_with_a_bound_and_named(tmp_path):
    """An hour in two runs: a false track of 5 outputs, another a minute later; no output in the second run."""
    outputs_s = [100.0, 100.5, 101.0, 101.5, 102.0, 160.0]
    runs = all_evaluated(
        make_run(
            tmp_path / "a",
            outputs_s,
            np.ones((6, 3)),
            truth="no drone",
            duration_s=1800,
            recording="x",
            config="estimate",
        ),
        make_run(tmp_path / "b", [], [], truth="no drone", duration_s=1800, recording="y", config="estimate"),
        make_run(tmp_path / "c", [], [], truth="no drone", duration_s=1800, recording="x", config="paper"),
    )
    estimate, paper = false_track_numbers(runs_table(runs)).to_dict("records")
    assert (estimate["runs"], estimate["outputs"], estimate["false\ntracks"]) == (2, 6, 2)
    assert estimate["[/h]"] == pytest.approx(2.0)
    assert estimate["below [/h]\n(95 %)"] == pytest.approx(6.296, abs=1e-3)  # Poisson, 2 events
    assert (paper["hours"], paper["[/h]"]) == (pytest.approx(0.5), 0.0)
    assert paper["below [/h]\n(95 %)"] == pytest.approx(2 * 2.996, abs=1e-2)
    text = grd("evaluate", tmp_path / "a", tmp_path / "b", tmp_path / "c", "--by", "config", code=1)
    assert "estimate: false tracks in x (2)" in text
    assert re.search(r"estimate +│ +2 │ +1 │ +6 │ +0 │ +2 │ +2 │ +6.3 │", text)


def test_the_command_puts_configurations_side_by_side(two_configs, tmp_path):
    text = grd("evaluate", *two_configs, "--by", "2,1", "--by", "config", "--report", tmp_path / "r.html", code=1)
    assert re.search(r"│ 10m +│ a +│ paper +│ +1 │", text)
    assert re.search(r"│ all +│ +│ estimate +│ +2 │", text)
    assert text.count("by config") == 1
    assert "by field 2, 1 of the recording&#x27;s name" in (tmp_path / "r.html").read_text()
    without_by = grd("evaluate", *two_configs, code=1)
    assert "by config" in without_by
    assert list(median_columns(all_evaluated(*two_configs))) == ["paper: median of 2", "estimate: median of 2"]
    assert "--by 9: 'a-10m-s1' has 3 fields" in grd("evaluate", *two_configs, "--by", "9", code=2)
    assert "with --by config" in grd("evaluate", *two_configs, "--against", two_configs[0], code=2)


def test_a_parquet_table_gives_the_same_tables_as_the_runs(two_configs, tmp_path):
    empty = make_run(tmp_path / "empty", [], [], truth="no drone", duration_s=900, recording="x", config="paper")
    file = tmp_path / "new" / "runs.parquet"
    by = ("--by", "2,1", "--by", "config")
    of_runs = grd("evaluate", *two_configs, empty, *by, "--parquet", file, code=1)
    of_table = grd("evaluate", file, *by)
    rows = [line for line in of_table.splitlines() if line.startswith("│")]
    assert len(rows) >= 8
    assert [row for row in rows if row not in of_runs] == []
    more = read_parquet(file)
    assert len(more) == len(all_evaluated(*two_configs, empty))
    twice = grd("evaluate", file, file, "--by", "config")  # as of two folders with runs of the same names
    assert re.search(r"paper +│ +4 │", twice)
    assert "give tables alone" in grd("evaluate", file, two_configs[0], code=2)
    assert "give tables alone" in grd("evaluate", file, "--csv", tmp_path / "a.csv", code=2)


def test_another_file_is_no_table(tmp_path):
    (tmp_path / "text.parquet").write_text("not one")
    assert "not a Parquet table" in grd("evaluate", tmp_path / "text.parquet", code=2)
    pd.DataFrame({"a": [1]}).to_parquet(tmp_path / "other.parquet")
    assert "--parquet FILE" in grd("evaluate", tmp_path / "other.parquet", code=2)


def test_runs_evaluated_on_two_processes_have_the_same_metrics(two_configs, tmp_path):
    pytest.importorskip("distributed")
    for jobs in ("1", "2"):
        grd("evaluate", *two_configs, "--csv", tmp_path / f"{jobs}.csv", "--jobs", jobs, code=1)
    assert (tmp_path / "1.csv").read_text() == (tmp_path / "2.csv").read_text()


def test_the_csv_table_has_a_line_for_each_run(two_configs, tmp_path):
    grd("evaluate", *two_configs, "--csv", tmp_path / "new" / "runs.csv", code=1)
    rows = list(csv.DictReader((tmp_path / "new" / "runs.csv").open()))
    assert [(row["recording"], row["config"]) for row in rows] == [
        ("a-10m-s1", "paper"), ("a-10m-s1", "estimate"), ("b-10m-s1", "paper"), ("b-10m-s1", "estimate")
    ]  # fmt: skip
    assert float(rows[0]["rmse_m"]) == pytest.approx(0.2)
    assert (rows[2]["rmse_m"], rows[2]["outputs"], rows[2]["track_accuracy"]) == ("inf", "0", "0")
    assert rows[0]["rmse_yaw_deg"] == ""
    assert (rows[1]["observable_detection_rate_count"], rows[1]["observable_detection_rate_of"]) == ("1", "2")
    assert (rows[1]["observable_detection_rate_s"], rows[1]["observable_detection_rate_of_s"]) == ("5", "10")
