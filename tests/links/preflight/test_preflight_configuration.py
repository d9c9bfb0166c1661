"""Missing links of a configuration, and the subgraphs that a preflight runs."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from flow.graph import load_graph
from links.preflight.graphs import sources_only, tracking
from links.preflight.preflight import configuration_checks

CONFIGS = Path(__file__).resolve().parents[3] / "configs"


def test_missing_links_are_reported():
    field = load_graph(CONFIGS / "field.yaml")
    assert list(configuration_checks(field)) == []
    names = ("lidar", "servo", "odometry", "autopilot", "recorder", "camera_vehicle", "camera_drone")
    bare = field.__class__(
        {n: s for n, s in field.nodes.items() if n not in names and s.kind == "links"}, (), None, field.values
    )
    found = {v.name: v.level.value for v in configuration_checks(bare)}
    assert found == {
        "lidar": "fail",
        "servo": "fail",
        "stages": "fail",
        "cameras": "warning",
        "autopilot": "warning",
        "vehicle odometry": "warning",
        "recorder": "warning",
    }
    fixed = dataclasses.replace(bare, values={"rig": {"lidar": {"mount": {"turns": False}}}})
    fixed_levels = {v.name: v.level.value for v in configuration_checks(fixed)}
    assert fixed_levels["servo"] == "ok"


def test_no_pose_is_sent_and_nothing_moves_with_the_sources_only():
    field = load_graph(CONFIGS / "field.yaml")
    assert sources_only(field).edges == ()
    assert all(spec.kind == "links" for spec in sources_only(field).nodes.values())
    subgraph = tracking(field)
    assert "fuse" not in subgraph.nodes
    assert not any(edge.consumer == "autopilot" for edge in subgraph.edges)
    assert any((edge.producer, edge.consumer) == ("aim", "servo") for edge in subgraph.edges)
    assert {"lidar", "servo", "camera_drone", "detect", "track"} <= set(subgraph.nodes)


@pytest.mark.parametrize(
    ("config", "setting", "level"),
    [
        ("inertial.yaml", {}, None),
        ("inertial.yaml", {"yaw": "none"}, "InertialFuse) does not estimate the autopilot's axes"),
        ("inertial.yaml", {"yaw": "none", "send": ["landing_target"]}, None),
        ("field.yaml", {}, None),
        ("field.yaml", {"yaw": "measured"}, None),  # with cameras
        ("sim_flight.yaml", {"yaw": "measured"}, "Fuse) measures no yaw without cameras"),
    ],
)
def test_a_yaw_that_the_stage_of_the_poses_does_not_estimate_is_an_error(
    config: str, setting: dict[str, Any], level: str | None, tmp_path: Path
):
    pose = "inputs: {pose: fuse.relative_pose}"
    text = f"include: {CONFIGS / config}\nlinks: {{autopilot: {{config: {json.dumps(setting)}, {pose}}}}}\n"
    (tmp_path / "config.yaml").write_text(text, encoding="utf-8")
    found = [r for r in configuration_checks(load_graph(tmp_path / "config.yaml")) if r.name == "autopilot yaw"]
    assert [r.level.value for r in found] == ([] if level is None else ["fail"])
    assert level is None or level in found[0].sentence
