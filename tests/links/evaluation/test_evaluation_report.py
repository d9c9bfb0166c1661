"""Medians, comparisons, the report, the command and its exit codes."""

from __future__ import annotations

import builtins
import importlib.util
import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser

import numpy as np
import pytest

from flow.link import LinkError
from links.evaluation.comparison import common_rmse_m, pair_up
from links.evaluation.figures import MAX_POINTS, worst_of_each
from links.evaluation.tables import medians, ranks
from tests.command import grd
from tests.links.evaluation.made_runs import add_pose, evaluated, lines, make_run, truth_at

EIGHT_HZ = np.arange(0.0, 10.0, 0.125)


def fly(folder, offset_m=0.1, recording="flight", t=EIGHT_HZ, **settings):
    return make_run(folder, t, truth_at(t) + np.array([0, 0, offset_m]), recording=recording, **settings)


def test_a_run_that_failed_counts_as_the_worst_in_a_median(tmp_path):
    runs = [evaluated(fly(tmp_path / str(i), offset)) for i, offset in enumerate([0.1, 0.2, 0.3])]
    runs += [evaluated(make_run(tmp_path / f"none{i}", [], [])) for i in range(2)]
    found = medians(ranks(runs)).loc["rmse_m"]
    assert (found["median"], found.runs, found.failed, found.not_evaluated) == (pytest.approx(0.3), 5, 2, 0)
    assert medians(ranks(runs[2:]))["median"].rmse_m == float("inf")
    assert medians(ranks(runs))["median"].track_accuracy == pytest.approx(100.0)


def test_a_run_without_truth_is_left_out_of_a_median_and_counted(tmp_path):
    runs = [evaluated(fly(tmp_path / "a")), evaluated(fly(tmp_path / "b", truth="none"))]
    found = medians(ranks(runs)).loc["rmse_m"]
    assert (found["median"], found.runs, found.not_evaluated) == (pytest.approx(0.1), 1, 1)


def test_runs_are_paired_by_recording(tmp_path):
    own = [evaluated(fly(tmp_path / name, 0.1, name)) for name in ("one", "two", "three")]
    others = [evaluated(fly(tmp_path / f"o{name}", 0.2, name)) for name in ("two", "one")]
    pairs, warnings = pair_up(own, others)
    assert [(p.own.run.recording, p.other.run.recording) for p in pairs] == [("one", "one"), ("two", "two")]
    assert warnings == ["on one side only, left out of the comparison: three"]
    with pytest.raises(LinkError, match="two runs of recording 'one'"):
        pair_up([own[0], own[0]], others)
    with pytest.raises(LinkError, match="no recording is in both: RUN has three; --against has one, two"):
        pair_up([own[2]], others)


def test_other_recordings_and_other_flights_are_warnings(tmp_path):
    a, b = evaluated(fly(tmp_path / "a")), evaluated(fly(tmp_path / "b", recording="other"))
    assert "another recording" in pair_up([a], [b])[1][0]
    whole = np.arange(0, 10.005, 0.01)
    moved = evaluated(make_run(tmp_path / "c", EIGHT_HZ, truth_at(EIGHT_HZ), truth=truth_at(whole) + 1.0))
    assert "different truth: not the same flight" in pair_up([a], [moved])[1][0]


def test_two_runs_are_compared_in_the_time_both_have_an_output(tmp_path):
    """One run is 0.5 m off all the time; the other is exact for 4 s, then has no output. In that time it is better."""
    late = EIGHT_HZ[EIGHT_HZ < 4]
    a, b = evaluated(fly(tmp_path / "a", 0.5)), evaluated(fly(tmp_path / "b", 0.0, t=late))
    both = pair_up([a], [b])[0][0].common_rmse_m()
    assert both is not None
    assert both[0] > 0.5 > both[1]


def test_the_errors_of_an_even_number_of_pairs_are_the_mean_of_the_middle_two(tmp_path):
    pairs = [
        pair_up([evaluated(fly(tmp_path / f"own{k}", off_m))], [evaluated(fly(tmp_path / f"other{k}", 0.1))])[0][0]
        for k, off_m in enumerate((0.2, 0.4))
    ]
    each = [errors for pair in pairs if (errors := pair.common_rmse_m()) is not None]
    assert common_rmse_m(pairs) == pytest.approx(np.mean(each, axis=0))
    assert each[0][0] < 0.9 * each[1][0]


def test_the_json_file_has_numbers_or_reasons_but_never_nan(tmp_path):
    folder = fly(tmp_path / "a", truth="none")
    grd("evaluate", folder, "--out", tmp_path / "numbers")
    text = (tmp_path / "numbers" / "evaluation.json").read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    metrics = json.loads(text)["runs"][0]["metrics"]
    assert metrics["rmse_m"] == {
        "value": None,
        "unit": "m",
        "status": "not evaluated",
        "note": "the recording holds no truth (real flight?); give one with --truth FILE.tum",
    }
    assert metrics["rate_hz"]["value"] == pytest.approx(8.0)


def test_exit_codes_are_0_without_findings_1_with_findings_2_for_wrong_use(tmp_path):
    fine = fly(tmp_path / "fine", 0.1, sigma_m=0.1)
    assert "RMSE z [m]" in grd("evaluate", fine)
    text = grd("evaluate", fly(tmp_path / "false", 5.0), code=1)
    assert "80 of 80 outputs are false" in text
    assert "no summary.json" in grd("evaluate", tmp_path, code=2)
    assert "No such file" in grd("evaluate", tmp_path / "nothing.tum", code=2)
    assert "contradict" in grd("evaluate", fine, "--no-drone", "--truth", fine / "truth_vehicle_drone.tum", code=2)


def test_a_truth_file_is_taken_for_a_real_flight(tmp_path):
    folder = fly(tmp_path / "a", truth="none")
    truth = tmp_path / "total_station.tum"
    times = np.arange(0, 10.05, 0.11)  # 9 Hz
    truth.write_text(lines(times, truth_at(times)))
    text = grd("evaluate", folder, "--truth", truth)
    assert re.search(r"RMSE z \[m\] +│ +0.100", text)


def test_many_runs_are_rows_and_a_median(tmp_path):
    folders = [fly(tmp_path / f"seed{i}", 0.1 * (i + 1), f"seed{i}", sigma_m=0.4) for i in range(6)]
    text = grd("evaluate", *folders, "--out", tmp_path / "out", "--report", tmp_path / "out" / "r.html")
    assert "median of 6" in text
    assert text.count("the run gives no rotation") == 1  # a text that holds for all runs is printed once
    assert "all 6 runs: evaluated over 10.00 s" in text
    pool = json.loads((tmp_path / "out" / "evaluation.json").read_text())["median"]["rmse_z_m"]
    assert pool["median"] == pytest.approx(0.35)
    assert pool["runs"] == 6


def test_the_outputs_of_one_run_are_not_called_runs(tmp_path):
    folder = fly(tmp_path / "a")
    add_pose(folder, EIGHT_HZ, truth_at(EIGHT_HZ), np.tile([0.0, 0, 0, 1], (len(EIGHT_HZ), 1)), None)
    text = grd("evaluate", folder)
    assert "all 2 outputs: " in text
    assert "all 2 runs" not in text


def test_the_medians_of_fixes_and_of_poses_are_not_mixed(tmp_path):
    """And no name and no number is cut where the table is wider than a pipe's 80 columns."""
    folders = [fly(tmp_path / f"a-street-with-a-long-name-seed{i}", 0.1, f"seed{i}") for i in range(6)]
    for folder in folders:
        at = truth_at(EIGHT_HZ) + np.array([0, 0, 0.3])
        add_pose(folder, EIGHT_HZ, at, np.tile([0.0, 0, 0, 1], (len(at), 1)), None)
    text = grd("evaluate", *folders, "--out", tmp_path / "out")
    assert "a-street-with-a-long-name-seed5 fix " in text
    assert "…" not in text
    pools = json.loads((tmp_path / "out" / "evaluation.json").read_text())["median_by_config"]
    of = {name.split()[-1]: pool["rmse_z_m"] for name, pool in pools.items()}
    assert {name: (pool["median"], pool["runs"]) for name, pool in of.items()} == {
        "pose": (pytest.approx(0.3), 6),
        "fix": (pytest.approx(0.1), 6),
    }


def test_against_another_run_there_are_both_columns_and_the_ratio(tmp_path):
    a, b = fly(tmp_path / "estimate", 0.1), fly(tmp_path / "theirs", 0.2)
    text = grd("evaluate", a, "--against", b, "--out", tmp_path / "out")
    assert re.search(r"RMSE z \[m\] +│ +0.100 │ +0.200 │ +0.5 │ better", text)
    tree = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert tree["against"]["metrics"]["rmse_z_m"]["ratio"] == pytest.approx(0.5)
    assert tree["against"]["pairs"][0]["recording"] == "flight"


class Links(HTMLParser):
    """Everything in a page that would fetch something, and its open tags."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.tags: set[str] = set()
        self.open: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.found += [v or "" for k, v in attrs if k in ("src", "href", "xlink:href", "data", "action")]
        if tag not in ("meta", "br"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.add(tag)
        self.found += [v or "" for k, v in attrs if k in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_report_needs_no_other_file_and_escapes_all_names(tmp_path):
    evil = tmp_path / "a<img src=x onerror=alert(1)>&b"
    fly(evil, 3.0, sweeps=[(0, 5.0, [[1, 2, 3]])], hits_s=[1.0, 2.0], states=[(0.1, "<script>"), (3.0, "TRACKING")])
    report = tmp_path / "report.html"
    grd("evaluate", evil, "--against", fly(tmp_path / "other", 0.1), "--report", report, code=1)
    text = report.read_text()
    page = Links()
    page.feed(text)
    assert all(link.startswith("#") for link in page.found), page.found  # inside the page
    assert page.open == []
    assert not page.tags & {"img", "script", "link", "iframe", "object"}
    assert "&lt;img src=x" in text
    assert "url(http" not in text
    assert "@import" not in text
    for title in ("from above", "from the side", "3D error over time", "error along x (forward)", "returns of the drone",
                  "NEES of the position", "error by range", "states"):  # fmt: skip
        assert f">{title}</text>" in text
    assert text.index("</svg>") < text.index("<table>")  # figures first
    assert text.count("<svg") == text.count("</svg>") == 6
    assert max(row.count("<th>") for row in text.split("<tr>")) <= 16  # no wider than a screen
    assert (tmp_path / "evaluation.json").exists()


BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
PROBE = """<script>addEventListener('load', () => {document.title = document.documentElement.scrollWidth + ' ' +
getComputedStyle(document.body).backgroundColor + ' ' + document.querySelectorAll('svg').length})</script></body>"""


@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
@pytest.mark.parametrize(("scheme", "background"), [(0, "rgb(20, 23, 28)"), (1, "rgb(246, 247, 249)")])
def test_a_browser_1280_px_wide_shows_the_report_without_scrolling_sideways_dark_and_light(
    tmp_path, scheme, background
):
    """With a long name, in a comparison of several runs: the widest tables."""
    runs = [fly(tmp_path / f"{'long_name_' * 12}{i}", 0.1, f"flight_{i}") for i in range(6)]
    page = tmp_path / "report.html"
    grd("evaluate", *runs, "--report", page)
    page.write_text(page.read_text().replace("</body>", PROBE))
    assert BROWSER is not None
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    options += [f"--blink-settings=preferredColorScheme={scheme}", "--window-size=1280,900", "--dump-dom"]
    done = subprocess.run([BROWSER, *options, page.as_uri()], capture_output=True, text=True, check=False, timeout=300)
    title = re.search(r"<title>(\d+) (rgb\(.*?\)) (\d+)</title>", done.stdout)
    assert title is not None, done.stderr[-500:]
    assert int(title[1]) <= 1280
    assert title[2] == background
    assert int(title[3]) >= 6


def test_a_report_without_values_has_the_reasons(tmp_path):
    report = tmp_path / "r.html"
    grd("evaluate", make_run(tmp_path / "a", [], [], truth="none"), "--report", report)
    assert "Not evaluated" in report.read_text()


def test_without_evo_its_metrics_name_the_missing_extra(tmp_path, monkeypatch):
    real = builtins.__import__

    def no_evo(name, *rest):
        if name.split(".")[0] == "evo":
            raise ModuleNotFoundError("No module named 'evo'", name="evo")
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", no_evo)
    e = evaluated(fly(tmp_path / "a"))
    assert e.values["evo_ape_rmse_m"].note == "evo is not installed: pip install -e '.[evaluate]'"
    assert e.values["rmse_m"].value == pytest.approx(0.1)


def test_thinning_a_long_series_keeps_its_worst_values():
    values = np.zeros(100_000)
    values[[3, 50_001, 99_999]] = 9.0
    kept = worst_of_each(values)
    assert len(kept) == MAX_POINTS
    assert {3, 50_001, 99_999} <= set(kept.tolist())
    assert worst_of_each(values[:10]).tolist() == list(range(10))


@pytest.mark.parametrize("missing", ["pandas", "matplotlib"])
def test_without_the_extra_the_command_fails_with_its_name(tmp_path, monkeypatch, missing):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == missing else find_spec(name))
    text = grd("evaluate", tmp_path, code=2)
    assert text == f"evaluating needs {missing}, not installed: pip install -e '.[evaluate]'\n"


def test_the_commands_start_without_the_extra():
    """Packages of the extra `evaluate`, one of which is GPL, are imported by `grd evaluate` alone."""
    code = "import sys, links.cli.app, links.runs.truth; print(sorted({'pandas', 'matplotlib', 'evo'} & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
