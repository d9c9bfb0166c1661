"""`grd train-detector`: rows from runs, labels by truth, a reproducible file, scores on held-out runs, wrong input."""

from __future__ import annotations

import csv
import math

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from flow.link import LinkError
from links.cli.app import app
from links.evaluation.text_files import NO_DRONE
from links.runs import results
from links.training.candidates import FIRST_ROWS, lidar_model_of, read_candidates
from links.training.fit import USED, scores, train
from stages.detect.trained.features import FEATURES, GROUPS, NAMES, TELEMETRY
from stages.detect.trained.model import DetectorModel

DRONE_M = np.array([5.0, 8.0, 10.0])


def write_run(folder, seed, candidates=60, rows=6, drop=(), drone_mps=2.0):
    """A run in which drones, at DRONE_M, differ from others by speed, and by telemetry where there is some."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    (folder / results.SUMMARY_FILE).write_text("{}")
    header = "# T_vehicle_drone, position only, truth\n"
    lines = header + "".join(f"{t:.2f} 5 8 10 0 0 0 1\n" for t in np.arange(0.0, 30.0, 0.1))
    (folder / results.TRUTH_FILE).write_text(lines)
    names = [name for name in NAMES if name not in drop]
    with (folder / results.CANDIDATES_FILE).open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["stamp_s", "candidate", "detector_instance", "probability", "x_m", "y_m", "z_m", *names])
        for number in range(candidates):
            drone = number % 3 == 0
            for k in range(rows):
                values = dict.fromkeys(NAMES, 0.0) | {
                    "range_m": rng.uniform(5, 40),
                    "top_mps": rng.normal(drone_mps if drone else 6.0, 1.0),
                    "over_static_nats": 1.0 if number % 2 else math.nan,
                    "displaced_nats": rng.normal(4.0 if drone else -4.0) if number % 2 else math.nan,
                }
                at = DRONE_M + (rng.normal(0, 0.1, 3) if drone else rng.uniform(3, 9, 3))
                cells = ["" if math.isnan(values[name]) else f"{values[name]:.5g}" for name in names]
                writer.writerow([f"{1.0 + 0.1 * k:.9f}", number, 7, 0.5, *(f"{v:.3f}" for v in at), *cells])
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return [write_run(folder / f"park-20m-hover-parked-s{seed}-detector", seed) for seed in (1, 2, 3)]


def test_a_candidate_at_the_drone_is_a_drone_and_the_name_has_the_seed(runs):
    rows = read_candidates(runs)
    assert rows.is_drone.sum() == 3 * 20 * 6
    assert np.unique(rows.seed).tolist() == [1, 2, 3]
    assert len(np.unique(rows.candidate)) == 180
    assert rows.with_telemetry.mean() == 0.5
    assert rows.logged.tolist() == [0.5] * len(rows.X)


def test_runs_of_one_recording_are_on_the_same_side_of_a_split(tmp_path):
    names = ["park-20m-s1-detector", "park-20m-s1-imu_only", "park-20m-s2-detector", "campus-20m-s1-detector"]
    rows = read_candidates([write_run(tmp_path / name, k, candidates=4) for k, name in enumerate(names)])
    first, again, *others = (np.unique(rows.recording[24 * k : 24 * k + 24]) for k in range(4))
    assert first.tolist() == again.tolist()
    assert len(np.unique([first, *others])) == 3


def test_later_rows_of_a_candidate_are_used_more_sparsely(tmp_path):
    run = write_run(tmp_path / "x-s1-y", 1, candidates=3, rows=200)
    thin, every = read_candidates([run]), read_candidates([run], thin=False)
    assert len(every.X) == 600
    assert 3 * FIRST_ROWS < len(thin.X) < 3 * (FIRST_ROWS + 20)


def test_a_run_without_a_drone_has_no_drones(tmp_path, runs):
    empty = write_run(tmp_path / "sky-s9-y", 9)
    (empty / results.TRUTH_FILE).write_text(f"# {NO_DRONE} in this recording\n")
    assert not read_candidates([empty]).is_drone.any()


def test_the_model_separates_what_differs_and_is_calibrated_by_other_seeds(runs):
    rows = read_candidates(runs)
    model = train(rows, {})
    p = np.array([1 / (1 + math.exp(-model.predict(x).log_odds)) for x in rows.X])
    assert p[rows.is_drone].mean() > 0.85 > 0.2 > p[~rows.is_drone].mean()
    assert p.mean() == pytest.approx(rows.is_drone.mean(), abs=0.03)
    assert all(score.brier < 0.12 for score in scores(rows, p))


def test_the_scores_are_those_of_the_formula(runs):
    rows = read_candidates(runs)
    for score in scores(rows, np.full(len(rows.X), 0.25)):
        share = score.drones / score.rows
        assert score.brier == pytest.approx(share * 0.75**2 + (1 - share) * 0.25**2)
        assert score.log_loss == pytest.approx(-share * math.log(0.25) - (1 - share) * math.log(0.75))


def test_a_feature_left_out_is_not_used(runs):
    model = train(read_candidates(runs), {}, ["top_mps"])
    x = np.zeros(len(NAMES))
    faster = np.where([f.name == "top_mps" for f in FEATURES], 50.0, x)
    assert model.predict(x).log_odds == model.predict(faster).log_odds


def test_the_command_writes_a_file_that_the_configuration_takes_and_that_is_reproduced(runs, tmp_path):
    files = [tmp_path / "one.yaml", tmp_path / "two.yaml"]
    for file in files:
        arguments = ["train-detector", *map(str, runs[:2]), "-o", str(file), "--held-out", str(tmp_path / "held")]
        if not (tmp_path / "held").exists():
            write_run(tmp_path / "held" / "village-20m-hover-parked-s8-detector", 8)
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, result.output
    assert "with telemetry" in result.output
    model, again = (yaml.safe_load(file.read_text())["stages"]["detect"]["config"]["model"] for file in files)
    commands = [one["trained"].pop("command") for one in (model, again)]
    assert model == again
    assert [command.replace("two.yaml", "one.yaml") for command in commands] == commands[:1] * 2
    trained = DetectorModel.model_validate(model).trained
    assert trained["seeds"] == [1, 2]
    assert trained["held_out"][0]["log_loss"] < trained["held_out"][0]["logged_log_loss"]


def test_the_file_names_the_options_of_the_command_also_for_many_runs(tmp_path):
    many = [write_run(tmp_path / "runs" / f"a-s{seed}-b", seed, candidates=12, rows=5) for seed in range(1, 13)]
    write_run(tmp_path / "held" / "a-s20-b", 20, candidates=12)
    file, held = tmp_path / "one.yaml", str(tmp_path / "held")
    options = ["-o", str(file), "--held-out", held, "--without", "top_mps", "--without", "calm_s"]
    result = CliRunner().invoke(app, ["train-detector", *map(str, many), *options])
    assert result.exit_code == 0, result.output
    trained = yaml.safe_load(file.read_text())["stages"]["detect"]["config"]["model"]["trained"]
    assert trained["command"] == f"grd train-detector RUNS (12) {' '.join(options)}"


def test_a_penalty_at_the_end_of_those_tried_is_a_warning(tmp_path, monkeypatch):
    few = [write_run(tmp_path / f"park-s{seed}-detector", seed, candidates=18, drone_mps=5.0) for seed in (1, 2, 3)]
    for name, tried, expected in (("one", (1e5, 1e6), True), ("two", (1e-3, 1.0, 1e6), False)):
        monkeypatch.setattr("links.training.fit.STRENGTHS", tried)
        arguments = ["train-detector", *map(str, few), "-o", str(tmp_path / f"{name}.yaml")]
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, result.output
        assert ("is at an end of those tried" in result.output) == expected


def test_the_model_is_for_the_lidar_of_its_runs(tmp_path):
    folders = [write_run(tmp_path / f"a-s{seed}-b", seed, candidates=12) for seed in (1, 2)]
    assert lidar_model_of(folders) == "VLP-16"
    (folders[0] / "config.yaml").write_text("rig: {lidar: {model: XT16}}\n")
    assert lidar_model_of(folders[:1]) == "XT16"
    assert train(read_candidates([*folders, write_run(tmp_path / "a-s3-b", 3)]), {}, (), "XT16").lidar_model == "XT16"
    with pytest.raises(LinkError, match="different LiDARs"):
        lidar_model_of(folders)
    (folders[0] / "config.yaml").write_text("rig: {lidar: {model: XT99}}\n")
    with pytest.raises(LinkError, match=r"config.yaml: .*"):
        lidar_model_of(folders)


def test_a_run_without_a_seed_in_its_name_is_refused(tmp_path):
    with pytest.raises(LinkError, match="must contain the seed"):
        read_candidates([write_run(tmp_path / "park-20m-hover", 1)])


def test_runs_that_cannot_be_used_are_named(tmp_path, runs):
    with pytest.raises(LinkError, match="not the folder of a complete run"):
        read_candidates([tmp_path])
    with pytest.raises(LinkError, match="no feature calm_s"):
        read_candidates([write_run(tmp_path / "old-s1-x", 1, drop=("calm_s",))])
    with pytest.raises(LinkError, match="two recordings"):
        train(read_candidates(runs[:1]), {})


@pytest.mark.parametrize(
    ("column", "cell", "expected"),
    [
        ("range_m", "", "range_m is missing"),
        ("range_m", "nan", "range_m is missing"),
        ("top_mps", "fast", "top_mps is 'fast', not a finite number"),
        ("top_mps", "inf", "top_mps is 'inf', not a finite number"),
    ],
)
def test_a_value_that_is_no_number_is_named_with_its_line(tmp_path, column, cell, expected):
    broken = write_run(tmp_path / "broken-s1-x", 1)
    text = (broken / results.CANDIDATES_FILE).read_text().splitlines()
    cells = text[4].split(",")
    cells[text[0].split(",").index(column)] = cell
    (broken / results.CANDIDATES_FILE).write_text("\n".join([*text[:4], ",".join(cells), *text[5:]]) + "\n")
    with pytest.raises(LinkError, match=rf"candidates.csv:5: {expected}"):
        read_candidates([broken])


def test_every_feature_but_the_range_is_used_by_the_model_or_says_whether_there_is_telemetry():
    unused = {"range_m", NAMES[TELEMETRY]}  # logged only
    assert {name for names in USED for name in names} == set(NAMES) - unused


def test_training_that_starts_from_a_model_keeps_it_where_the_runs_say_nothing_new(runs, tmp_path):
    rows = read_candidates(runs)
    first = train(rows, {})
    again = train(rows, {}, start=first, strengths=[1e6])
    assert [term.knots for term in again.terms] == [term.knots for term in first.terms]
    features = rows.X[::40]
    differences = [again.predict(x).log_odds - first.predict(x).log_odds for x in features]
    assert np.abs(differences).max() < 0.05
    moved = train(rows.take(rows.seed < 3), {}, start=first, strengths=[0.01])
    assert np.abs([moved.predict(x).log_odds - first.predict(x).log_odds for x in features]).max() > 0.05


def test_the_ablation_scores_a_model_without_each_group(runs, tmp_path):
    file, held = tmp_path / "one.yaml", tmp_path / "held"
    write_run(held / "village-20m-hover-parked-s8-detector", 8)
    arguments = ["train-detector", *map(str, runs), "-o", str(file), "--ablation"]
    refused = CliRunner().invoke(app, arguments)
    assert refused.exit_code != 0
    assert "--ablation needs --held-out" in refused.output
    result = CliRunner().invoke(app, [*arguments, "--held-out", str(held)])
    assert result.exit_code == 0, result.output
    trained = yaml.safe_load(file.read_text())["stages"]["detect"]["config"]["model"]["trained"]
    assert set(trained["ablation"]) == {"nothing", *GROUPS}
    losses = {group: scores["with telemetry"][1] for group, scores in trained["ablation"].items()}
    assert losses["shape"] == pytest.approx(losses["nothing"], rel=0.1)
    assert losses["telemetry"] > 1.2 * losses["nothing"]  # the made runs differ by telemetry and top speed
    assert "without 'motion', without telemetry: Brier" in result.output


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("stages: {}", "not a weights file"),
        (None, "train it again"),
        ("- [", "not a weights file"),
        ("\udcff", "is not UTF-8 text"),
        ("c: " + "[" * 60 + "]" * 60, "too large or too deep"),
    ],
)
def test_a_model_to_start_from_that_does_not_fit_is_refused(runs, tmp_path, text, expected):
    file = tmp_path / "start.yaml"
    if text is None:
        made = train(read_candidates(runs), {}).model_dump(mode="json") | {"feature_version": 1}
        text = yaml.safe_dump({"stages": {"detect": {"config": {"model": made}}}})
    file.write_text(text, errors="surrogateescape")
    arguments = ["train-detector", *map(str, runs), "-o", str(tmp_path / "one.yaml"), "--start", str(file)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code != 0
    assert expected in " ".join(result.output.split())


def test_an_existing_file_and_a_missing_folder_are_refused_before_the_training(tmp_path):
    (tmp_path / "one.yaml").write_text("precious")
    for target, expected in (("one.yaml", "exists already"), ("none/one.yaml", "there is no folder"), ("", "a folder")):
        arguments = ["train-detector", str(tmp_path / "no_runs"), "-o", str(tmp_path / target)]
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 2
        assert expected in " ".join(result.output.split())
    assert (tmp_path / "one.yaml").read_text() == "precious"
    overwritten = CliRunner().invoke(
        app, ["train-detector", str(tmp_path / "no_runs"), "-o", str(tmp_path / "one.yaml"), "--overwrite"]
    )
    assert "not the folder of a complete run" in " ".join(overwritten.output.split())
