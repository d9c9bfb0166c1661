"""Replays of the committed recordings: expected results on any machine, within rounding errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flow.graph import load_graph
from flow.link import Run
from flow.replay import replay
from flow.taps import Digest
from links.recording import RecordingReader
from links.runs.results import Results
from links.runs.truth import TruthLog, fix_errors
from stages.messages import SearchResult

ROOT = Path(__file__).resolve().parents[1]
ON_ITS_SIDE = {
    "about x": ["rig.lidar.mount.T_turntable_lidar.rpy_deg=[90, 0, 0]"],
    "about y": ["rig.lidar.mount.T_turntable_lidar.rpy_deg=[0, 90, 0]"],
}


def run(folder: Path, recording: str, config: str, sets: list[str] | None = None):
    """Replay strictly (every array checked), without the viewer."""
    results, digest, truth = Results(), Digest(), TruthLog()
    overlay = folder / "no_viewer.yaml"
    overlay.write_text("links: {viewer: null}\n")
    with RecordingReader(ROOT / "recordings" / f"{recording}.mcap") as reader:
        sections = {"rig": (reader.rig_yaml or "", recording)}
        graph = load_graph(ROOT / "configs" / f"{config}.yaml", [overlay], sets or [], sections)
        results.open(Run(folder, recording, "", ""))
        replay(graph, truth.without_truth(reader.records()), [results, digest], strict=True)
        results.close()
        assert reader.warnings == []
    return results, digest.hexdigest(), truth


def test_the_simulated_drone_is_detected_and_tracked(tmp_path):
    results, _, truth = run(tmp_path, "street_sweep", "replay")
    assert (results.sweeps, results.sweeps_with_drone) == (1, 1)
    assert [t.state for t in results.transitions] == ["SEARCHING", "TRACKING"]
    assert 17 <= len(results.fixes) <= 21
    errors = fix_errors(results.fixes, *truth.drone_in_vehicle())
    assert errors.without_truth == 0
    assert errors.rmse_m < 0.2
    assert np.abs(errors.error_m).max() < 0.4
    # the covariance may be too large, not too small
    assert errors.inside_95 >= 0.9


def test_the_paper_baseline_detects_a_building_as_the_drone(tmp_path):
    """A known error of the paper baseline on this recording: a building edge 30 m away has the lowest score."""
    results, _, truth = run(tmp_path, "street_sweep", "paper")
    assert results.sweeps_with_drone == 1
    assert all(np.linalg.norm(error) > 10 for error in fix_errors(results.fixes, *truth.drone_in_vehicle()).error_m)


@pytest.mark.parametrize(
    ("recording", "result"),
    [
        ("einride_vlp16", (12, "no drone: 0 of 18160 returns lie within 60 deg of straight up")),
        ("mrpt_vlp16_gps", (3, "no drone: 0 of 20522 returns lie within 60 deg of straight up")),
    ],
)
@pytest.mark.parametrize("config", ["replay", "paper"])
def test_a_real_lidar_without_returns_overhead_detects_no_drone_and_reports_why(tmp_path, recording, result, config):
    results, _, _ = run(tmp_path, recording, config)
    assert results.search_results == [(SearchResult.NO_CANDIDATE, *result)]
    assert not results.fixes
    assert [t.state for t in results.transitions] == ["SEARCHING"]


@pytest.mark.parametrize("mount", ON_ITS_SIDE)
def test_no_drone_is_detected_in_a_real_room(tmp_path, mount):
    """The returns as if the LiDAR lay on its side: the room fills the image and has no drone."""
    results, _, _ = run(tmp_path, "einride_vlp16", "replay", ON_ITS_SIDE[mount])
    assert (results.sweeps, results.sweeps_with_drone, len(results.fixes)) == (12, 0, 0)
    assert all(text.startswith("no drone: ") for _, _, text in results.search_results)


@pytest.mark.parametrize("mount", ON_ITS_SIDE)
def test_the_paper_baseline_detects_a_false_drone_in_that_room(tmp_path, mount):
    results, _, _ = run(tmp_path, "einride_vlp16", "paper", ON_ITS_SIDE[mount])
    assert (results.sweeps, results.sweeps_with_drone) == (12, 12)


def test_the_paper_baseline_fails_the_start_of_the_first_experiment(tmp_path):
    """Aimed by its own method: it detects something else as the drone, aims at it, and loses it."""
    results, _, truth = run(tmp_path, "experiment_1-paper", "paper_lidar")
    assert results.sweeps >= 1
    assert {t.state for t in results.transitions} >= {"TRACKING", "LOST"}
    assert all(np.linalg.norm(error) > 10 for error in fix_errors(results.fixes, *truth.drone_in_vehicle()).error_m)
