"""The committed recordings, replayed: what each must give, on any machine, within the width of a rounding error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from flow.config_error import Location
from flow.graph import load_graph
from flow.link import Run
from flow.replay import replay
from flow.taps import Digest
from links.recording import RecordingReader
from links.runs.results import Results
from links.runs.truth import TruthLog, fix_errors

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
        sections = {"rig": (yaml.safe_load(reader.rig_yaml or ""), Location(recording, 0))}
        graph = load_graph(ROOT / "configs" / f"{config}.yaml", [overlay], sets or [], sections)
        results.open(Run(folder, recording, "", ""))
        replay(graph, truth.aside(reader.records()), [results, digest], strict=True)
        results.close()
        assert reader.warnings == []
    return results, digest.hexdigest(), truth


def test_the_simulated_drone_is_found_and_followed(tmp_path):
    results, _, truth = run(tmp_path, "street_sweep", "replay")
    assert (results.sweeps, results.sweeps_with_drone) == (1, 1)
    assert [t.state for t in results.transitions] == ["SEARCHING", "TRACKING"]
    assert 17 <= len(results.fixes) <= 21
    errors = fix_errors(results.fixes, *truth.drone_in_vehicle())
    assert errors.not_covered == 0
    assert errors.rmse_m < 0.2
    assert np.abs(errors.error_m).max() < 0.4
    # the covariance may be careful, it may not promise too much
    assert errors.inside_95 >= 0.9


def test_the_paper_literally_takes_a_building_for_the_drone(tmp_path):
    """What the literal method gets wrong on this recording, kept as a fact: a house edge 30 m away scores lowest."""
    results, _, truth = run(tmp_path, "street_sweep", "paper")
    assert results.sweeps_with_drone == 1
    assert all(np.linalg.norm(error) > 10 for error in fix_errors(results.fixes, *truth.drone_in_vehicle()).error_m)


@pytest.mark.parametrize(
    ("recording", "verdict"),
    [
        ("einride_vlp16", ("no drone: 0 of 14917 returns lie within 60 deg of straight up", 13)),
        ("mrpt_vlp16_gps", ("no drone: 0 of 16978 returns lie within 60 deg of straight up", 3)),
    ],
)
@pytest.mark.parametrize("config", ["replay", "paper"])
def test_a_real_lidar_that_does_not_look_up_sees_no_drone_and_says_why(tmp_path, recording, verdict, config):
    results, _, _ = run(tmp_path, recording, config)
    assert results.verdicts == [verdict]
    assert not results.fixes
    assert [t.state for t in results.transitions] == ["SEARCHING"]


@pytest.mark.parametrize("mount", ON_ITS_SIDE)
def test_a_real_room_seen_from_its_floor_holds_no_drone(tmp_path, mount):
    """The same returns as if the LiDAR lay on its side: a whole room fills the image, and no drone is in it."""
    results, _, _ = run(tmp_path, "einride_vlp16", "replay", ON_ITS_SIDE[mount])
    assert (results.sweeps, results.sweeps_with_drone, len(results.fixes)) == (13, 0, 0)
    assert all(verdict.startswith("no drone: ") for verdict, _ in results.verdicts)


@pytest.mark.parametrize("mount", ON_ITS_SIDE)
def test_the_paper_literally_invents_a_drone_in_that_room(tmp_path, mount):
    results, _, _ = run(tmp_path, "einride_vlp16", "paper", ON_ITS_SIDE[mount])
    assert (results.sweeps, results.sweeps_with_drone) == (13, 13)


@pytest.mark.parametrize(
    ("number", "fixes", "states"),
    [
        (1, 0, ["SEARCHING", "TRACKING", "LOST", "SEARCHING"]),
        (2, 36, ["SEARCHING", "TRACKING"]),
        (3, 0, ["SEARCHING", "TRACKING", "LOST", "SEARCHING"]),
        (4, 0, ["SEARCHING", "TRACKING", "LOST", "SEARCHING"]),
    ],
)
def test_the_paper_literally_fails_the_first_seconds_of_each_experiment(tmp_path, number, fixes, states):
    """It takes something else for the drone, aims at it, and either keeps it (2) or finds nothing there."""
    results, _, truth = run(tmp_path, f"experiment_{number}", "paper")
    assert (results.sweeps, len(results.fixes)) == (1, fixes)
    assert [t.state for t in results.transitions] == states
    assert all(np.linalg.norm(error) > 10 for error in fix_errors(results.fixes, *truth.drone_in_vehicle()).error_m)
