"""Probabilities of candidates, and how often a candidate was a drone."""

from __future__ import annotations

import numpy as np
import pytest

from flow.link import LinkError, Run
from links.evaluation.groups import probability_score_table, probability_scores, reliability, reliability_table
from links.evaluation.run_data import read_run
from links.runs.results import CANDIDATES_FILE, Results
from stages.messages import CandidateLog
from tests.command import grd
from tests.links.evaluation.made_runs import all_evaluated, lines, make_run, stamp, truth_at

HEAD = "stamp_s,candidate,detector_instance,observations,probability,x_m,y_m,z_m\n"
T_S = np.arange(0.0, 10.0, 0.1)


def run_with_candidates(folder, rows, **settings):
    """`rows`: (time, candidate, probability, distance from the drone)."""
    make_run(folder, T_S, truth_at(T_S), **settings)
    text = ""
    for k, (t_s, candidate, probability, distance_m) in enumerate(rows):
        x, y, z = truth_at(np.array([t_s]))[0] + np.array([0.0, distance_m, 0.0])
        text += f"{stamp(t_s)},{candidate},7,{k + 1},{probability},{x},{y},{z}\n"
    (folder / CANDIDATES_FILE).write_text(HEAD + text)
    return folder


def rows_of(*folders):
    rows = reliability(all_evaluated(*folders))
    return {(r.low, r.high): (r.candidates, r.mean, r.drones) for r in rows.itertuples()}


def test_each_candidate_counts_once_in_a_bin_and_is_a_drone_within_a_metre(tmp_path):
    observations = [
        (1.0, 1, 0.01, 0.2),
        (2.0, 1, 0.4, 0.9),
        (3.0, 1, 0.45, 5.0),
        (4.0, 1, 0.997, 0.1),
        (5.0, 2, 0.35, 1.2),
    ]
    rows = rows_of(run_with_candidates(tmp_path / "a", observations))
    assert rows[(0.0, 0.02)] == (1, 0.01, 1)
    assert rows[(0.3, 0.5)] == (
        2,
        pytest.approx(0.375),
        1,
    )  # the second observation of candidate 1 in this bin does not count
    assert rows[(0.95, 1.0)] == (1, 0.997, 1)
    assert len(rows) == 3


def test_a_probability_of_one_is_in_the_last_bin(tmp_path):
    assert rows_of(run_with_candidates(tmp_path / "a", [(1.0, 1, 1.0, 0.0)])) == {(0.95, 1.0): (1, 1.0, 1)}


def test_without_a_drone_no_candidate_is_one_and_without_truth_none_counts(tmp_path):
    empty = run_with_candidates(tmp_path / "empty", [(1.0, 1, 0.6, 0.0)], truth="no drone")
    assert rows_of(empty) == {(0.5, 0.7): (1, 0.6, 0)}
    after = run_with_candidates(tmp_path / "after", [(1.0, 1, 0.6, 0.0), (11.0, 2, 0.6, 0.0)])
    assert rows_of(after) == {(0.5, 0.7): (1, 0.6, 1)}
    unknown = run_with_candidates(tmp_path / "unknown", [(1.0, 1, 0.6, 0.0)], truth="none")
    assert rows_of(unknown) == {}


def test_a_candidate_at_a_drone_counts_though_truth_does_not_cover_another_drone(tmp_path):
    observations = [(1.0, 1, 0.6, 0.0), (9.0, 2, 0.6, 0.0), (9.0, 3, 0.6, 5.0)]
    folder = run_with_candidates(tmp_path / "two", observations)
    other = lines(T_S[:50], truth_at(T_S[:50]) + np.array([0.0, 30.0, 0.0]))
    (folder / "truth_vehicle_drone_2.tum").write_text("# T_vehicle_drone, full pose, truth\n" + other)
    assert rows_of(folder) == {(0.5, 0.7): (2, 0.6, 2)}  # the third may have been the other one


def test_equal_numbers_in_two_runs_or_after_a_restart_of_the_detector_are_different_candidates(tmp_path):
    one, two = (run_with_candidates(tmp_path / name, [(1.0, 1, 0.6, 0.0)]) for name in "ab")
    assert rows_of(one, two)[(0.5, 0.7)][0] == 2
    text = (two / CANDIDATES_FILE).read_text()
    (two / CANDIDATES_FILE).write_text(text + text.removeprefix(HEAD).replace(",1,7,", ",1,8,"))
    assert rows_of(two)[(0.5, 0.7)][0] == 2


def test_a_damaged_table_is_rejected(tmp_path):
    folder = run_with_candidates(tmp_path / "a", [(1.0, 1, 0.6, 0.0)])
    (folder / CANDIDATES_FILE).write_text(HEAD + "1.0,1,7\n")
    with pytest.raises(LinkError, match=r"candidates.csv:2: 3 cells, the header has 8"):
        read_run(folder)


def test_the_table_has_probabilities_and_shares_of_drones(tmp_path):
    table = reliability_table(all_evaluated(run_with_candidates(tmp_path / "a", [(1.0, 1, 0.6, 0.0)])))
    assert table is not None
    assert table.frame.to_numpy().tolist() == [[".yaml", "0.5 to 0.7", "1", "60.0", "100.0", "20.7 to 100.0"]]
    folders = [str(run_with_candidates(tmp_path / name, [(1.0, 1, 0.6, 0.0)])) for name in "bc"]
    assert "reliability of the detector's probabilities" in grd("evaluate", *folders, "--by", "config")


def test_probabilities_are_scored_by_range_with_and_without_telemetry(tmp_path):
    folder = run_with_candidates(tmp_path / "a", [(1.0, 1, 0.8, 0.0), (2.0, 1, 0.6, 0.0), (2.0, 2, 0.25, 9.0)])
    rows = (folder / CANDIDATES_FILE).read_text().splitlines()
    filled = [f"{rows[0]},over_static_nats", f"{rows[1]},1.5", f"{rows[2]},", f"{rows[3]},-2.0"]
    (folder / CANDIDATES_FILE).write_text("\n".join(filled) + "\n")
    scores = {(r.telemetry, r.low): r for r in probability_scores(all_evaluated(folder)).itertuples()}
    assert set(scores) == {(True, 0.0), (True, 15.0), (False, 0.0)}  # the third is 17 m away
    assert scores[(True, 0.0)].brier == pytest.approx(0.2**2)
    assert scores[(True, 0.0)].log_loss == pytest.approx(-np.log(0.8))
    assert (scores[(True, 15.0)].drones, scores[(True, 15.0)].brier) == (0, pytest.approx(0.25**2))
    assert scores[(False, 0.0)].log_loss == pytest.approx(-np.log(0.6))
    table = probability_score_table(all_evaluated(folder))
    assert table is not None
    assert table.frame.to_numpy()[0].tolist() == [".yaml", "with", "0 to 15", "1", "1", "0.0400", "0.2231"]


def candidate_log(numbers, probability, life=7):
    n = len(numbers)
    return CandidateLog(
        stamp_ns=1_000_000_000,
        candidate_id=np.array(numbers),
        seen_ns=np.full(n, 900_000_000),
        xyz_vehicle_m=np.arange(3.0 * n).reshape(n, 3),
        probability=np.array(probability),
        features=np.column_stack([np.full(n, 12.5), np.full(n, np.nan)]),
        feature_names=("range_m", "speed_mps"),
        detector_instance=life,
    )


def test_a_run_writes_a_line_for_each_classified_candidate(tmp_path):
    results = Results()
    results.open(Run(tmp_path, "made", "", ""))
    assert results.wants(CandidateLog)
    for message in (candidate_log([1, 2], [0.1, 0.9]), candidate_log([1], [0.2], life=8)):
        results.see("detect.candidate_log", message, 0)
    results.close()
    lines = (tmp_path / CANDIDATES_FILE).read_text().splitlines()
    assert lines == [
        "stamp_s,candidate,detector_instance,probability,x_m,y_m,z_m,range_m,speed_mps",
        "0.900000000,1,7,0.1,0.000,1.000,2.000,12.5,",
        "0.900000000,2,7,0.9,3.000,4.000,5.000,12.5,",
        "0.900000000,1,8,0.2,0.000,1.000,2.000,12.5,",
    ]
