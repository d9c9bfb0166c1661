"""Warm-up of a graph on a recording before it runs live."""

from __future__ import annotations

import pytest

from flow.graph import load_graph
from flow.link import Record
from links.recording import RecordingWriter
from links.runs.warm_up import RECORDING, warm_up

GRAPH = """\
stages:
  brittle: {use: tests.flow.live_toys.Brittle, inputs: {number: line.number}}
links:
  line: {use: tests.flow.live_toys.Line}
"""


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


def test_the_graph_runs_over_the_whole_recording_and_tells_how_far_it_is(graph, tmp_path):
    told = []
    assert warm_up(graph, lambda done, total: told.append((done, total)), recording(tmp_path, b"1", b"2")) is None
    assert told[-1][0] == told[-1][1] > 0


def test_a_stage_that_raises_and_a_recording_that_is_not_there_are_told_and_no_more(graph, tmp_path):
    said = warm_up(graph, lambda done, total: None, recording(tmp_path, b"1", b"666"))
    assert said.startswith("warm-up on warm.mcap failed, the first messages may be late: brittle.number")
    said = warm_up(graph, lambda done, total: None, tmp_path / "none.mcap")
    assert "none.mcap: no such file" in said


def test_the_recording_for_it_comes_with_grd():
    assert RECORDING.is_file()
