"""Warm-up of a graph on a recording before it runs live."""

from __future__ import annotations

import subprocess
import sys

import pytest

from flow.graph import load_graph
from flow.link import Record
from links.lidar import Lidar
from links.recording import RecordingWriter
from links.runs.request import RunRequest
from links.runs.shipped import CONFIGS
from links.runs.warm_up import RECORDING, REPLAYED_NS, warm_up, warm_up_graph
from tests.test_architecture import ROOT

GRAPH = """\
stages:
  brittle: {use: tests.flow.live_toys.Brittle, inputs: {number: line.number}}
links:
  line: {use: tests.flow.live_toys.Line}
"""


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr("links.runs.warm_up.FOLDER", tmp_path / "cache")
    return tmp_path / "cache"


@pytest.fixture
def graph(tmp_path):
    (tmp_path / "x.yaml").write_text(GRAPH)
    return load_graph(tmp_path / "x.yaml")


def recording(folder, *values):
    with RecordingWriter(folder / "warm.mcap", lossless=True) as writer:
        for number, value in enumerate(values):
            writer.write(Record("/numbers", 1_000 + number, 1_000 + number, value))
        writer.write(Record("/truth/drone", 2_000, 2_000, b"no stage may see this"))
    return folder / "warm.mcap"


def test_the_graph_runs_over_the_whole_recording_and_reports_progress(graph, tmp_path):
    progress = []
    assert warm_up(graph, lambda done, total: progress.append((done, total)), recording(tmp_path, b"1", b"2")) is None
    assert progress[-1][0] == progress[-1][1] > 0


def test_a_later_start_loads_the_functions_that_were_called_in_place_of_the_replay(graph, tmp_path):
    """In a process of its own. One function is compiled when it is called, the other when it is imported."""
    one = recording(tmp_path, b"1")
    program = f"""
import sys
from pathlib import Path
from flow.graph import load_graph
from links.runs import warm_up
from stages.kernels.geometry.so3 import exp_rotation, nearly_rotation
import numpy as np

folder, progress = Path({str(tmp_path)!r}), []
warm_up.FOLDER = folder / "cache"
if sys.argv[1] == "first":
    exp_rotation(np.zeros(3))
graph = load_graph(folder / "x.yaml")
failed = warm_up.warm_up(graph, lambda *shares: progress.append(shares), folder / "warm.mcap")
print(failed, progress[-1][0] == progress[-1][1], len(exp_rotation.signatures), len(nearly_rotation.signatures))
"""

    def start(which):
        command = [sys.executable, "-c", program, which]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()

    assert start("first") == ["None", "True", "1", "1"]
    one.unlink()  # it is not replayed
    assert start("second") == ["None", "True", "1", "1"]


@pytest.mark.parametrize("damage", [b"", b"no pickle", bytes(100), b"\x80\x04K", b"cmissing\nname\n.", None])
def test_without_a_file_of_the_calls_the_recording_is_replayed(graph, tmp_path, cache, damage):
    one = recording(tmp_path, b"1")
    assert warm_up(graph, lambda done, total: None, one) is None
    (kept,) = cache.glob("calls-*.pickle")
    kept.unlink() if damage is None else kept.write_bytes(damage)
    progress = []
    assert warm_up(graph, lambda done, total: progress.append(total), one) is None
    assert progress[-1] == REPLAYED_NS
    assert len(list(cache.iterdir())) == 1
    assert kept.stat().st_size > 20


def test_a_function_that_no_longer_exists_is_replayed(graph, tmp_path, monkeypatch):
    one, progress = recording(tmp_path, b"1"), []
    assert warm_up(graph, lambda done, total: None, one) is None
    monkeypatch.setattr("stages.kernels.calls.FUNCTIONS", [])
    assert warm_up(graph, lambda done, total: progress.append(total), one) is None
    assert progress[-1] == REPLAYED_NS


def test_a_stage_that_raises_and_a_missing_recording_are_only_reported(graph, tmp_path):
    status = warm_up(graph, lambda done, total: None, recording(tmp_path, b"1", b"666"))
    assert status.startswith("warm-up on warm.mcap failed, the first messages may be late: brittle.number")
    status = warm_up(graph, lambda done, total: None, tmp_path / "none.mcap")
    assert "none.mcap: no such file" in status


@pytest.mark.parametrize(
    ("config", "sets"), [("sim_live_xt16.yaml", ()), ("sim_live.yaml", ("rig.lidar.model=HDL-32E",))]
)
def test_another_lidar_is_warmed_up_with_the_rig_of_the_recording(config, sets):
    request = RunRequest(CONFIGS / config, sets=sets)
    graph = request.graph(None, "")
    assert model_of(graph) != "VLP-16"
    assert model_of(warm_up_graph(graph, request)) == "VLP-16"


def test_the_lidar_of_the_recording_is_warmed_up_as_configured():
    request = RunRequest(CONFIGS / "sim_live.yaml", sets=("rig.drone.span_m=0.7",))
    graph = request.graph(None, "")
    assert warm_up_graph(graph, request) is graph


def model_of(graph):
    return next(spec.cls(**spec.config).settings.unit.model for spec in graph.nodes.values() if spec.cls is Lidar)


def test_its_recording_is_part_of_grd():
    assert RECORDING.is_file()
