"""Making the matrix: resumed where interrupted, with the runs of the closed loop, the same in several processes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from flow.config_error import ConfigError
from flow.link import LinkError
from links.cli.app import app
from links.recording import RecordingReader
from links.runs.request import RunRequest
from links.simulated.matrix import flights, making
from links.simulated.matrix.flights import Cell
from links.simulated.matrix.making import Task, TaskResult, TaskStatus, is_made, make_matrix, make_one
from links.simulated.matrix.matrix import Conditions, cells, scenario_of
from links.simulated.rig.closed_loop import ClosedLoop, loop_metadata
from links.simulated.rig.run import simulate_into

GRAPH = (Path(__file__).parents[1] / "fast_loop.yaml").read_text(encoding="utf-8")
VIEWER = "  view: {use: links.viewer.Viewer}\n"
STAMPS = "  stamps: {use: tests.flow.toys.Stamps}\n"
HOVER = Cell("open_lot", 10, "hover", "parked")
SHORT_S = 0.2


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A closed loop in two files, with a viewer and another tap."""
    (tmp_path / "stages.yaml").write_text(GRAPH, encoding="utf-8")
    file = tmp_path / "fast.yaml"
    file.write_text(f"include: stages.yaml\nlinks:\n{VIEWER}{STAMPS}", encoding="utf-8")
    return file


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flights, "USUAL_DURATION_S", SHORT_S)


def silent(done: float, whole: float) -> None:
    """Ignored progress."""


def make_short(task: Task, progress: Callable[[float], None]) -> TaskResult:
    """`make_one` in a process of its own, where nothing is patched; the file of one cell cannot be written."""
    flights.USUAL_DURATION_S = SHORT_S
    if task.cell.vehicle == "turning":
        (task.making.folder / f"{task.name}.mcap.part").mkdir()
    return make_one(task, progress)


def files_of(folder: Path) -> dict[str, bytes]:
    """Content of all files of a run; of the summary all but computing times."""
    found = {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}
    summary = json.loads(found["summary.json"])
    summary["wall_s"] = 0
    summary["compute_ms"] = {name: node["calls"] for name, node in summary["compute_ms"].items()}
    return found | {"summary.json": json.dumps(summary).encode()}


def test_complete_recordings_are_kept_and_others_made_again(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flights, "USUAL_DURATION_S", 0.2)
    selected, progress = cells(["open_lot-10m-hover-*"]), []
    first = make_matrix(tmp_path, selected, range(1, 2), None, lambda done, whole: progress.append((done, whole)))
    assert (first.made, first.kept, first.impossible) == (3, 0, ())
    assert progress[-1] == pytest.approx((0.6, 0.6))
    file = tmp_path / "open_lot-10m-hover-parked-s1.mcap"
    with RecordingReader(file) as reader:
        assert reader.metadata["scenario"] == "open_lot-10m-hover-parked"
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    again = make_matrix(tmp_path, selected, range(1, 2), None, lambda done, whole: None)
    assert (again.made, again.kept) == (1, 2)
    assert file.read_bytes() == whole
    wet = Conditions(rain=True)
    third = make_matrix(tmp_path, selected[:1], range(1, 2), None, lambda done, whole: None, wet)
    assert (third.made, third.kept) == (1, 0)


def test_an_impossible_cell_is_reported_and_the_others_are_made(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(flights.DURATION_S, "occlusion", 0.3)
    report = make_matrix(
        tmp_path, [Cell("open_lot", 35, "occlusion", "parked")], range(1, 2), None, lambda done, whole: None
    )
    assert report.made == 0
    assert report.impossible[0].startswith("seed 1: open_lot-35m-occlusion-parked: no free flight of this kind")


def test_the_run_of_the_closed_loop_is_that_of_a_replay(tmp_path, monkeypatch, config: Path) -> None:
    monkeypatch.setattr(flights, "USUAL_DURATION_S", 2.0)
    report = make_matrix(tmp_path / "m", [HOVER], range(1, 2), config, silent, results=tmp_path / "runs")
    assert (report.made, report.replayed, report.failed) == (1, 0, ())
    name = "open_lot-10m-hover-parked-s1"
    arguments = ["--config", config, "--out", tmp_path / "again", "--set", "view.file=null"]
    again = CliRunner().invoke(
        app, [str(argument) for argument in ("replay", tmp_path / "m" / f"{name}.mcap", *arguments)]
    )
    assert again.exit_code == 0, again.output
    left, replayed = files_of(tmp_path / "runs" / f"{name}-fast"), files_of(tmp_path / "again")
    assert left.keys() == replayed.keys()
    assert {file for file, data in left.items() if data != replayed[file]} == set()
    assert {
        "truth_returns.csv",
        "truth_visible.csv",
        "truth_vehicle_drone.tum",
        "stamps.txt",
    } <= left.keys()
    assert not [file for file in left if file.endswith(".rrd")]
    summary = json.loads(left["summary.json"])
    assert summary["sweeps"] >= 1
    assert summary["truth_errors"]["fixes"] > 0
    assert summary["set"] == ["view.file=null"]


def test_a_missing_or_interrupted_run_is_replayed_from_the_kept_recording(tmp_path, short, config: Path) -> None:
    runs, recordings = tmp_path / "runs", tmp_path / "m"
    make_matrix(recordings, [HOVER], range(1, 2), config, silent)  # without runs
    recording = recordings / "open_lot-10m-hover-parked-s1.mcap"
    before = recording.read_bytes()

    def again() -> tuple[int, int, int]:
        report = make_matrix(recordings, [HOVER], range(1, 2), config, silent, results=runs)
        return report.made, report.kept, report.replayed

    assert again() == (0, 1, 1)
    assert again() == (0, 1, 0)
    run = runs / "open_lot-10m-hover-parked-s1-fast"
    whole = files_of(run)
    (run / "summary.json").unlink()
    assert again() == (0, 1, 1)
    assert files_of(run) == whole
    (run / "config.yaml").write_text("stages: {}\n")  # the run of another configuration
    assert again() == (0, 1, 1)
    assert recording.read_bytes() == before
    recording.unlink()
    assert again() == (1, 0, 0)
    assert recording.read_bytes() == before
    assert files_of(run) == whole


def test_a_failed_flight_leaves_no_run_folder(tmp_path, config: Path, monkeypatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise LinkError("the drone drifts into a building")

    monkeypatch.setattr(making, "simulate_into", refuse)
    report = make_matrix(tmp_path / "m", [HOVER], range(1, 2), config, silent, results=tmp_path / "runs")
    assert len(report.failed) == 1, report
    assert list((tmp_path / "runs").iterdir()) == []


@pytest.mark.slow
def test_the_rig_has_cameras_where_the_conditions_have(tmp_path, monkeypatch) -> None:
    """Without them `vision.yaml` is `estimate.yaml`."""
    monkeypatch.setattr(flights, "USUAL_DURATION_S", 0.2)
    vision = Path(__file__).resolve().parents[4] / "configs" / "vision.yaml"
    report = make_matrix(tmp_path / "blind", [HOVER], range(1, 2), vision, silent, results=tmp_path / "runs")
    assert (report.made, report.failed) == (1, ())
    with RecordingReader(tmp_path / "blind/open_lot-10m-hover-parked-s1.mcap") as reader:
        assert "masked_px" not in str(reader.rig_yaml)
    seen = Conditions(cameras_hz=1.0)
    report = make_matrix(tmp_path, [HOVER], range(1, 2), vision, silent, seen, results=tmp_path / "seen_runs")
    assert (report.made, report.failed) == (1, ())
    with RecordingReader(tmp_path / "open_lot-10m-hover-parked-s1.mcap") as reader:
        assert reader.rig_yaml is not None
        assert "masked_px" in reader.rig_yaml


def test_a_run_of_an_older_recording_is_not_kept(tmp_path, short, config: Path) -> None:
    """The recordings were made again without runs, with rain; the existing run is of the dry ones."""
    runs, recordings, wet = tmp_path / "runs", tmp_path / "m", Conditions(rain=True)
    make_matrix(recordings, [HOVER], range(1, 2), config, silent, results=runs)
    assert make_matrix(recordings, [HOVER], range(1, 2), config, silent, wet).made == 1
    report = make_matrix(recordings, [HOVER], range(1, 2), config, silent, wet, results=runs)
    assert (report.kept, report.replayed) == (1, 1)


@pytest.mark.slow
def test_a_changed_configuration_is_detected_but_not_a_comment_or_a_viewer(tmp_path, short, config: Path) -> None:
    def made() -> int:
        return make_matrix(tmp_path / "m", [HOVER], range(1, 2), config, silent).made

    assert made() == 1
    config.write_text(config.read_text().replace("Viewer}", "Viewer, config: {slice_s: 0.2}}") + "# a comment\n")
    assert made() == 0
    (tmp_path / "stages.yaml").write_text(GRAPH.replace("sweep_rpm: 40", "sweep_rpm: 41"))
    assert made() == 1
    assert made() == 0
    config = config.rename(tmp_path / "other.yaml")
    assert made() == 1


def test_a_recording_with_the_name_of_its_configuration_only_is_made_again(tmp_path, short, config: Path) -> None:
    scenario, file = scenario_of(HOVER, 1), tmp_path / "old.mcap"
    graph = RunRequest(config).graph(scenario.rig_yaml(), "test")
    made_by = loop_metadata(config, graph)
    simulate_into(file, scenario, loop=ClosedLoop(graph, scenario.closed_loop, {"closed_loop": "fast.yaml"}))
    assert not is_made(file, scenario, made_by)
    assert not is_made(file, scenario, {})
    simulate_into(file, scenario, overwrite=True, loop=ClosedLoop(graph, scenario.closed_loop, made_by))
    assert is_made(file, scenario, made_by)
    with RecordingReader(file) as reader:
        assert reader.metadata["closed_loop"] == "fast.yaml"
        assert len(reader.metadata["closed_loop_hash"]) == 32


def test_an_interruption_leaves_no_recording_and_no_complete_run(tmp_path, short, config: Path) -> None:
    def interrupt(done: float, whole: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_matrix(tmp_path / "m", [HOVER], range(1, 2), config, interrupt, results=tmp_path / "runs")
    assert list((tmp_path / "m").iterdir()) == []
    assert not list((tmp_path / "runs").glob("*/summary.json"))
    report = make_matrix(tmp_path / "m", [HOVER], range(1, 2), config, silent, results=tmp_path / "runs")
    assert (report.made, report.replayed) == (1, 0)


def test_two_processes_make_what_one_makes_and_an_error_affects_its_own_cell_only(
    tmp_path, monkeypatch, config: Path
) -> None:
    monkeypatch.setattr(making, "make_one", make_short)
    monkeypatch.setattr(flights, "USUAL_DURATION_S", SHORT_S)
    selected, progress = cells(["open_lot-10m-hover-*"]), []
    found = []
    for jobs in (1, 2):
        out, runs = tmp_path / f"m{jobs}", tmp_path / f"runs{jobs}"
        report = make_matrix(out, selected, range(1, 2), config, lambda *a: progress.append(a), None, runs, jobs)
        assert (report.made, len(report.failed)) == (2, 1)
        assert report.failed[0].text.startswith("open_lot-10m-hover-turning-s1: ")
        assert progress[-1] == pytest.approx((0.6, 0.6))
        recordings = {file.name: file.read_bytes() for file in out.glob("*.mcap")}
        found.append((recordings, {run.name: files_of(run) for run in runs.iterdir() if "turning" not in run.name}))
    assert len(found[0][0]) == len(found[0][1]) == 2
    assert found[0] == found[1]


@pytest.mark.parametrize(("stage_failed", "code"), [(False, 2), (True, 1)])
def test_the_command_prints_failures_and_sets_its_exit_code(
    tmp_path, monkeypatch, stage_failed: bool, code: int
) -> None:
    failed = TaskResult(TaskStatus.FAILED, "campus-10m-hover-parked-s1: the disk is full", stage_failed)
    monkeypatch.setattr(
        making, "make_one", lambda task, report: failed if task.seed == 1 else TaskResult(TaskStatus.MADE)
    )
    words = ["matrix", str(tmp_path), "--only", "campus-10m-hover-parked", "--seeds", "3"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == code
    assert "campus-10m-hover-parked-s1: the disk is full\n" in result.output
    assert "2 made, 0 kept\n" in result.output


def test_seeds_start_at_first_seed(tmp_path, monkeypatch) -> None:
    made: list[int] = []
    monkeypatch.setattr(making, "make_one", lambda task, report: made.append(task.seed) or TaskResult(TaskStatus.MADE))
    words = ["matrix", str(tmp_path), "--only", "campus-10m-hover-parked", "--seeds", "3", "--first-seed", "6"]
    assert CliRunner().invoke(app, words).exit_code == 0
    assert made == [6, 7, 8]


def test_a_wrong_configuration_is_reported_once_before_anything_is_made(tmp_path, config: Path) -> None:
    config.write_text(GRAPH.replace(", inputs: {goal: aim.servo_goal}", ""))
    with pytest.raises(LinkError, match="closed loop needs exactly one servo"):
        make_matrix(tmp_path / "m", [HOVER], range(1, 3), config, silent)
    config.write_text(GRAPH.replace("lidar.Lidar", "lidar.Radar"))
    with pytest.raises(ConfigError, match=r"fast.yaml:\d+: .*unknown link"):
        make_matrix(tmp_path / "m", [HOVER], range(1, 3), config, silent)
    assert not (tmp_path / "m").exists()
    without = CliRunner().invoke(app, ["matrix", str(tmp_path / "m"), "--results", str(tmp_path / "runs")])
    assert without.exit_code == 2
    assert "add --closed-loop CONFIG" in without.output
