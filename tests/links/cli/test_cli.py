"""The command line from the outside: output, files and exit codes."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from flow import subprocess_replay
from flow.subprocess_replay import can_use_subprocesses
from links.cli.app import COMMANDS
from links.cli.app import command as command_named
from links.cli.files import read_rig

ROOT = Path(__file__).resolve().parents[3]
STREET = ROOT / "recordings" / "street_sweep.mcap"


def without_viewer(folder: Path) -> Path:
    overlay = folder / "no_viewer.yaml"
    overlay.write_text("links: {viewer: null}\n")
    return overlay


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_a_help_text_with_an_example(grd, command):
    assert f"Example: grd {command} " in grd(command, "--help").replace("\n  ", " ").replace("  ", " ")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["view", "none.rrd"], "none.rrd: no such file"),
        (["view", "none.rrd", "--tab", "Fusion"], "--screenshot"),
        (["view", "none.rrd", "--size", "big", "--screenshot", "x.png"], "big is not WIDTHxHEIGHT"),
        (["run", "street_sweep"], "street_sweep.mcap is a recording: grd replay"),
    ],
)
def test_a_wrong_argument_is_explained(grd, arguments, message):
    assert message in grd(*arguments, code=2)


def test_a_run_prints_the_pose_of_the_drone_its_errors_and_the_result_files(grd, tmp_path):
    lenient = ("--set", "detect.parked=true", "--set", "detect.accept_probability=0.5")  # nothing is known of the drone
    text = grd("replay", STREET, "--config", ROOT / "configs" / "estimate.yaml", *lenient)
    info = grd("info", tmp_path / "out" / "street_sweep-estimate")
    for what in ("LiDAR positions against the truth, rmse_3d_m: 0.", "fused poses against the truth, rmse_xyz_m: [0."):
        assert what in info
    folder = tmp_path / "out" / "street_sweep-estimate"
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/how-to/query-runs.md").read_text(), re.S)
    shown = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    ).stdout
    assert re.search(r"^\d{3,} poses; .*sensor_time", shown)
    for words in (
        "vehicle frame",
        "yaw [deg]",
        "error [deg]",
        "output hash",
        "fix_vehicle_drone.tum",
        "never FULL, at",
    ):
        assert words in text
    for what in ("LiDAR positions", "fused poses"):
        assert re.search(rf"^{what}, errors against the truth: RMSE x/y/z( 0\.\d+){{3}} m, 3D 0\.\d+ m", text, re.M)
    names = {path.name for path in folder.iterdir()}
    assert names == {
        "candidates.csv",
        "config.yaml",
        "detections.csv",
        "fix_covariance.csv",
        "fix_vehicle_drone.tum",
        "pose_covariance.csv",
        "pose_vehicle_drone.tum",
        "run.log",
        "run.rrd",
        "summary.json",
        "truth_returns.csv",
        "truth_vehicle_drone.tum",
        "truth_world_vehicle.tum",
    }
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["output_hash"] in text
    assert 0 < max(summary["pose_errors"]["rmse_xyz_m"]) < summary["pose_errors"]["max_m"] < 1
    fixes = [line.split() for line in (folder / "fix_vehicle_drone.tum").read_text().splitlines()[1:]]
    assert len(fixes) == summary["fixes"] > 0
    assert all(len(line) == 8 for line in fixes)


def test_a_run_without_a_fuse_stage_prints_the_positions_of_the_drone(grd, tmp_path):
    text = grd("replay", STREET, "--config", "replay", "--overlay", without_viewer(tmp_path))
    assert "x forward [m]" in text
    assert "LiDAR positions, errors against the truth" in text
    assert "fused" not in text


def test_a_second_configuration_is_run_on_the_same_recording_and_printed_next_to_the_first(grd, tmp_path):
    (tmp_path / "one.yaml").write_text(
        f"include: {ROOT}/configs/replay.yaml\nreplay: {STREET}\nlinks: {{viewer: null}}\n"
    )
    text = grd("run", "one.yaml", "--against", ROOT / "configs" / "paper.yaml", "--out", "a")
    assert (tmp_path / "a" / "summary.json").is_file()
    assert (tmp_path / "a-paper" / "summary.json").is_file()
    table = text[text.index("side by side") :]
    assert re.search(r"one .* paper", table)
    assert re.search(r"recording .* street_sweep .* street_sweep", table)
    near = re.search(r"within 1 m of the drone │\s+(\d+) │\s+(\d+) ", table)
    assert near is not None
    assert int(near[1]) > 10
    assert int(near[2]) == 0
    assert re.search(r"FULL\) after \[s\]\s+│\s+never │\s+never ", table)


def test_a_live_configuration_has_nothing_to_be_run_against(grd):
    assert "--against is for" in grd("run", "sim_live.yaml", "--against", "paper.yaml", code=2)


@pytest.mark.slow
def test_the_quickstart_reaches_the_whole_pose_and_the_paper_does_not(grd, tmp_path):
    text = grd("run", "quickstart", "--against", "quickstart_paper")
    summary = json.loads((tmp_path / "out" / "experiment_1-quickstart" / "summary.json").read_text())
    assert summary["recorded_s"] >= 30
    assert summary["poses"]["states"]["FULL"] > 1000
    assert max(summary["pose_errors"]["rmse_xyz_m"]) < 0.1
    assert summary["pose_errors"]["rmse_deg"] < 0.5
    assert re.search(r"FULL\) after \[s\]\s+│\s+\d\.\d │\s+never ", text)


def test_two_replays_have_one_hash_and_one_never_overwrites_the_other(grd, tmp_path):
    overlay = without_viewer(tmp_path)
    for _ in range(2):
        grd("replay", STREET, "--config", "replay", "--overlay", overlay)
    names = ["street_sweep-replay", "street_sweep-replay-2"]
    hashes = {json.loads((tmp_path / "out" / name / "summary.json").read_text())["output_hash"] for name in names}
    assert len(hashes) == 1
    again = grd("replay", STREET, "--out", tmp_path / "out" / names[0], code=2)
    assert "has a run already" in again


def test_a_replay_without_the_hash_leaves_the_same_fixes(grd, tmp_path):
    overlay = without_viewer(tmp_path)
    grd("replay", STREET, "--config", "replay", "--overlay", overlay, "--out", "a")
    text = grd("replay", STREET, "--config", "replay", "--overlay", overlay, "--out", "b", "--no-hash")
    assert "output hash" not in text
    assert json.loads((tmp_path / "b" / "summary.json").read_text())["output_hash"] is None
    fixes = [(tmp_path / name / "fix_vehicle_drone.tum").read_text() for name in "ab"]
    assert fixes[0] == fixes[1]
    assert "--no-hash" in grd("replay", STREET, "--no-hash", "--expect", "0" * 16, code=2)


def test_several_recordings_are_replayed_on_processes_and_complete_runs_are_kept(grd, tmp_path):
    pytest.importorskip("distributed")
    for name in ("one", "two"):
        shutil.copy(STREET, tmp_path / f"{name}.mcap")
    (tmp_path / "broken.mcap").write_bytes(b"no recording")
    several = ("replay", "one.mcap", "broken.mcap", "two.mcap", "--config", "replay", "--out", "runs")
    several += ("--overlay", without_viewer(tmp_path))
    text = grd(*several, "--jobs", "2", code=1)
    summaries = [json.loads((tmp_path / "runs" / f"{n}-replay" / "summary.json").read_text()) for n in ("one", "two")]
    pinned = json.loads((ROOT / "recordings" / "hashes.json").read_text())["street_sweep.mcap"]["replay"]
    assert {summary["output_hash"] for summary in summaries} == {pinned}
    assert text.count(": made, output hash") == 2
    assert "broken.mcap: " in text
    assert grd(*several, code=1).count(": kept, output hash") == 2
    before = (tmp_path / "runs" / "one-replay" / "summary.json").read_bytes()
    assert grd(*several, "--set", "track.frame_s=0.1", code=1).count("has a run with other settings") == 2
    assert (tmp_path / "runs" / "one-replay" / "summary.json").read_bytes() == before
    assert "for one recording" in grd("replay", "one.mcap", "two.mcap", "--expect", "0" * 16, code=2)
    assert "several recordings are named one" in grd("replay", "one.mcap", tmp_path / "one.mcap", code=2)


@pytest.mark.skipif(not can_use_subprocesses(), reason="one core, or no fork: there is one process anyway")
def test_a_replay_in_several_processes_writes_the_files_of_one(grd, tmp_path, monkeypatch):
    started = []
    start = subprocess_replay._Partition.start
    monkeypatch.setattr(
        subprocess_replay._Partition, "start", lambda partition: (started.append(partition.topics), start(partition))[1]
    )
    (tmp_path / "processes.yaml").write_text("stages: {sweep: {process: lidar}}\nlinks: {viewer: null}\n")
    both = ("replay", STREET, "--config", ROOT / "configs" / "estimate.yaml", "--overlay", "processes.yaml")
    grd(*both, "--out", "together", "--single-process")
    assert not started
    grd(*both, "--out", "processes")
    assert [sorted(topics) for topics in started] == [["/lidar/packets", "/servo/state"]]
    names = {path.name for path in (tmp_path / "together").iterdir()}
    assert names == {path.name for path in (tmp_path / "processes").iterdir()} > {"run.log", "fix_vehicle_drone.tum"}
    for name in names - {"summary.json"}:  # it contains the duration of the run
        assert (tmp_path / "together" / name).read_bytes() == (tmp_path / "processes" / name).read_bytes(), name


def test_a_changed_setting_changes_the_hash(grd, tmp_path):
    overlay = without_viewer(tmp_path)
    grd("replay", STREET, "--config", "replay", "--overlay", overlay, "--out", "a")
    grd("replay", STREET, "--config", "replay", "--overlay", overlay, "--out", "b", "--set", "track.frame_s=0.1")
    a, b = (json.loads((tmp_path / name / "summary.json").read_text()) for name in "ab")
    assert a["output_hash"] != b["output_hash"]
    assert b["set"] == ["track.frame_s=0.1"]


def test_all_errors_of_a_configuration_are_reported_together(grd, tmp_path):
    (tmp_path / "wrong.yaml").write_text(
        f"include: {ROOT}/configs/replay.yaml\nstages:\n  track:\n    config: {{radius: 2}}\n    inputs: {{points: sweep.depth_image}}\n"
    )
    text = grd("check", "wrong.yaml", code=1)
    assert "wrong.yaml:4: stages.track.config.radius: unknown setting 'radius'. Did you mean 'radius_m'?" in text
    assert (
        "wrong.yaml:5: stages.track.inputs.points: type mismatch: sweep.depth_image is DepthImage, "
        "track.points takes SweptPoints." in text
    )
    assert grd("replay", STREET, "--config", "wrong.yaml", code=2) == text


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such"),
        (b"", "empty"),
        (b"hello, this is no recording\n" * 10, ""),
    ],
)
def test_a_file_that_is_no_recording_is_reported_in_one_line(grd, tmp_path, content, words):
    if content is not None:
        (tmp_path / "x.mcap").write_bytes(content)
    text = grd("replay", "x.mcap", code=2)
    assert "x.mcap" in text
    assert words in text.lower()
    assert "Traceback" not in text
    assert not (tmp_path / "out").exists()


def test_a_truncated_recording_is_replayed_to_its_end_with_a_warning(grd, tmp_path):
    data = STREET.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    text = grd("replay", "cut.mcap", "--config", "replay", "--overlay", without_viewer(tmp_path))
    assert "warning: " in text
    assert "byte" in text
    summary = json.loads((tmp_path / "out" / "cut-replay" / "summary.json").read_text())
    assert summary["records"] > 0
    assert summary["warnings"]


def test_a_configuration_without_a_recording_runs_live_and_reports_missing_devices(grd, tmp_path):
    overlay = without_viewer(tmp_path)
    text = grd("run", ROOT / "configs" / "paper.yaml", "--for", 0.3, "--no-warm-up", "--overlay", overlay, code=1)
    assert "no links.recording.Recorder is configured: nothing is recorded" in text
    assert "no drone: no sweep was completed" in text


def test_a_recording_from_another_place_is_replayed_with_its_own_rig(grd, tmp_path):
    shutil.copy(ROOT / "recordings" / "einride_vlp16.mcap", tmp_path / "room.mcap")
    text = grd("replay", "room.mcap", "--config", "replay", "--overlay", without_viewer(tmp_path))
    assert "no drone: " in text
    assert "0 fixes" in text
    config = (tmp_path / "out" / "room-replay" / "config.yaml").read_text()
    assert "turns: false" in config


def test_an_import_takes_the_rig_of_a_file_or_of_a_configuration(grd, tmp_path):
    capture = ROOT / "tests" / "links" / "recording" / "none.pcap"
    assert grd("import", capture, code=2).startswith(f"{capture}: no such file")
    for name, text, words in [
        (
            "a.yaml",
            "lidar: {mount: {turn: true}}",
            "a.yaml: lidar.mount.turn: unknown setting 'turn'. Did you mean 'turns'?",
        ),
        ("e.yaml", "lidar: {mount: {}}\ndrone: {span: 1}", "e.yaml: drone.span: unknown setting 'span'."),
        ("b.yaml", "- 1", "b.yaml is no rig: it needs 'lidar:'"),
        ("c.yaml", "a: [", "c.yaml is no rig: "),
        ("d.yaml", "rig: {lidar: {model: XT16}}", "d.yaml: lidar.mount is missing: add `include: FILE`"),
        ("e.yaml", "include: none.yaml\nrig: {lidar: {model: XT16}}", "e.yaml:1: include: no such file 'none.yaml'"),
    ]:
        (tmp_path / name).write_text(text)
        assert words in grd("import", capture, "--rig", name, code=2)
    rig = yaml.safe_load(read_rig(ROOT / "configs" / "rigs" / "standard.yaml"))
    assert rig["lidar"]["mount"]["T_turntable_lidar"]["rpy_deg"] == [90.0, 0.0, 0.0]
    with_include = yaml.safe_load(read_rig(ROOT / "configs" / "rigs" / "xt32.yaml"))
    assert with_include == {**rig, "lidar": {**rig["lidar"], "model": "XT32"}}


def test_view_opens_the_newest_run_or_the_one_in_a_folder(grd, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr("links.viewer.show", lambda file: shown.append(str(file)))
    assert "out/ holds no run" in grd("view", code=2)
    for age_s, name in enumerate(("new", "old")):
        (tmp_path / "out" / name).mkdir(parents=True)
        (tmp_path / "out" / name / "run.rrd").write_text("")
        os.utime(tmp_path / "out" / name / "run.rrd", (1000 - age_s, 1000 - age_s))
    assert "the newest run: out/new/run.rrd" in grd("view")
    grd("view", "out/old")
    grd("view", "out/old/run.rrd")
    assert shown == ["out/new/run.rrd", "out/old/run.rrd", "out/old/run.rrd"]
    (tmp_path / "empty").mkdir()
    assert "empty holds no run.rrd" in grd("view", "empty", code=2)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_list_of_commands_has_the_beginning_of_the_help_of_each(grd, name):
    _, text = COMMANDS[name]
    assert " ".join((command_named(name).help or "").split()).startswith(text.rstrip("."))
    assert text.endswith(".")
    assert text in " ".join(grd("--help").split())


def test_the_help_of_a_second_configuration_says_that_overlays_and_settings_are_the_firsts(grd):
    assert "--overlay and --set apply to the first CONFIG alone" in " ".join(grd("run", "--help").split())


@pytest.mark.parametrize("option", ["--version", "--help"])
def test_version_and_help_import_no_stage_and_no_viewer(option):
    code = f"import sys; sys.argv = ['grd', {option!r}]; from links.cli import main; main()"
    done = subprocess.run([sys.executable, "-X", "importtime", "-c", code], capture_output=True, text=True, check=True)
    imported = {line.split("|")[-1].strip() for line in done.stderr.splitlines() if line.startswith("import time:")}
    assert "typer" in imported
    assert not {"numba", "rerun", "scipy", "cv2", "gtsam", "pymavlink", "flow.graph"} & imported


def test_graph_and_schema_are_written(grd, tmp_path):
    grd("graph", ROOT / "configs" / "paper.yaml", "--format", "svg", "-o", "graph.svg")
    assert (tmp_path / "graph.svg").read_text().startswith("<svg ")
    assert "flowchart LR" in grd("graph", ROOT / "configs" / "paper.yaml")
    assert json.loads(grd("schema"))["title"] == "grd configuration"


def test_the_pipeline_of_the_quickstart_runs_without_the_packages_of_any_extra(tmp_path):
    """The README's first command installs none of them."""
    packages = ("embreex", "evo", "matplotlib", "pandas", "zenoh", "hypothesis", "velodyne_decoder", "mkdocs", "pytest")
    for arguments in (
        ("check", "configs/quickstart.yaml"),
        ("replay", str(STREET), "--config", "configs/estimate.yaml", "--out", str(tmp_path / "out")),
    ):
        code = (
            f"import sys; sys.modules.update(dict.fromkeys({packages})); from links.cli import main; "
            f"sys.argv = {['grd', *arguments]!r}; main()"
        )
        done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    assert "output hash" in done.stdout
