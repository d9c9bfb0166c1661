"""The paper's two tables next to runs: medians over seeds, failures as failures."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

from links.cli.app import app
from links.evaluation.comparison import markdown, paper_tables
from tests.links.evaluation.made_runs import (
    add_pose,
    add_rotations,
    add_true_rotations,
    all_evaluated,
    make_run,
    truth_at,
    yaw_quaternion,
)

T_S = np.arange(0.0, 10.0, 0.1)


def run(folder, recording, config, off_m=(0.0, 0.0, 0.0), t_s=T_S, name=""):
    xyz = truth_at(t_s) + np.asarray(off_m) if len(t_s) else []
    return make_run(folder / f"{recording}{name}-{config}", t_s, xyz, recording=recording, config=config)


def test_medians_over_seeds_are_next_to_the_published_row(tmp_path):
    folders = [
        run(tmp_path, f"experiment_2-s{seed}", "estimate", (0.01 * seed, 0.02 * seed, 0.03 * seed))
        for seed in (1, 2, 3)
    ]
    position, _ = paper_tables(all_evaluated(*folders))
    assert [head.replace("\n", " ") for head in position.frame.columns] == [
        *("experiment", "method", "runs", "track accuracy [%]", "x", "y", "z", "3D", "accurate outputs", "factor")
    ]
    assert position.frame.to_numpy().tolist()[0] == [
        "2",
        "published",
        "1",
        "-",
        "0.250",
        "0.310",
        "0.137",
        "-",
        "-",
        "-",
    ]
    whole = f"{np.sqrt(0.02**2 + 0.04**2 + 0.06**2):.3f}"
    assert position.frame.to_numpy().tolist()[1] == [
        "2",
        "estimate",
        "3",
        "100",
        "0.020",
        "0.040",
        "0.060",
        whole,
        whole,
        "-",
    ]


def test_a_method_that_mostly_fails_has_no_median_and_one_far_off_has_its_error(tmp_path):
    """Two of three paper runs have no output: the median is a failure. Where both have an error there is a factor."""
    folders = [run(tmp_path, f"experiment_1-s{seed}", "paper", t_s=T_S[:0]) for seed in (1, 2)]
    folders += [run(tmp_path, "experiment_1-s3", "paper", (0.2, 0, 0))]
    folders += [
        run(tmp_path, "experiment_3", "paper", (20.0, 0, 0)),
        run(tmp_path, "experiment_3", "estimate", (0.1, 0, 0)),
    ]
    position, _ = paper_tables(all_evaluated(*folders))
    rows = {(row[0], row[1]): row[2:] for row in position.frame.to_numpy().tolist()}
    assert rows["1", "paper"] == ["3", "0", "none", "none", "none", "none", "0.200", "-"]
    assert rows["3", "paper"] == ["1", "0", "20.000", "0.000", "0.000", "20.000", "-", "-"]
    assert rows["3", "estimate"][-1] == "200.0"


def test_the_rotation_is_of_the_pose_or_by_both_cameras(tmp_path):
    level = yaw_quaternion([0.0])[0]
    estimate = run(tmp_path, "experiment_4-s1", "vision")
    covariance = np.diag([1e-4] * 3 + [1e-2] * 3)
    add_pose(estimate, T_S, truth_at(T_S), yaw_quaternion(np.full(len(T_S), np.radians(2.0))), covariance)
    paper = run(tmp_path, "experiment_4-s1", "paper")
    add_rotations(paper, T_S, yaw_quaternion(np.full(len(T_S), np.radians(10.0))))
    for folder in (estimate, paper):
        add_true_rotations(folder, level, level)
    _, rotation = paper_tables(all_evaluated(*[paper, estimate]))
    rows = {row[1]: row[4:] for row in rotation.frame.to_numpy().tolist()}
    assert rows["published"][:3] == ["1.40", "3.00", "3.40"]
    assert rows["paper"] == ["0.00", "0.00", "10.00", "10.00", "-"]
    assert rows["vision"] == ["0.00", "0.00", "2.00", "2.00", "5.0"]


def test_other_recordings_are_in_no_table(tmp_path):
    assert (
        paper_tables(
            all_evaluated(*[run(tmp_path, "street-10m-s1", "estimate"), run(tmp_path, "experiment_12", "estimate")])
        )
        == []
    )


def test_the_command_writes_and_prints_the_tables(tmp_path):
    file = tmp_path / "out" / "tables.md"
    folder = run(tmp_path, "experiment_2", "estimate", (0.1, 0, 0))
    result = CliRunner().invoke(app, ["evaluate", str(folder), "--paper-tables", str(file)])
    assert "Table II: RMSE of the rotation" in result.output
    text = file.read_text()
    assert "| 2 | estimate | 1 | 100 | 0.100 | 0.000 | 0.000 | 0.100 | 0.100 | - |" in text
    assert markdown(paper_tables(all_evaluated(*[folder]))) == text


@pytest.mark.parametrize("recording", ["street", "experiment_5"])
def test_without_an_experiment_there_is_an_error(tmp_path, recording):
    folder = run(tmp_path, recording, "estimate")
    result = CliRunner().invoke(app, ["evaluate", str(folder), "--paper-tables", str(tmp_path / "t.md")])
    assert result.exit_code == 2
    assert "experiment_1" in result.output
