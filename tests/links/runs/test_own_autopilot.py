"""With several drones a pose must not depend on another drone's autopilot: it would be another drone's pose."""

from __future__ import annotations

import pytest

from flow.config_error import ConfigError
from links.runs.request import RunRequest

CHAIN = ["telemetry", "drone_motion", "detect", "track", "fuse", "autopilot"]
NO_CAMERA = "{rotation: null, visual_motion: null}"


def graph_of(tmp_path, nodes, fuse_inputs="{}"):
    config = tmp_path / "pair.yaml"
    config.write_text(f"""
include: [field.yaml, {{file: field.yaml, nodes: [{", ".join(nodes)}], suffix: _2}}]
stages:
  fuse_2: {{inputs: {fuse_inputs}}}
links:
  autopilot_2: {{config: {{topic: /autopilot/rx_2}}}}
""")
    return RunRequest(config).graph(None, "")


def test_each_drone_has_a_chain_of_its_own(tmp_path):
    graph = graph_of(tmp_path, CHAIN, NO_CAMERA)
    assert "autopilot" not in graph.feeding("fuse_2")
    assert {"autopilot", "camera_drone"} < graph.feeding("fuse")


@pytest.mark.parametrize(
    ("nodes", "fuse_inputs", "ports"),
    [
        (CHAIN, "{}", "rotation, visual_motion"),  # of the first drone's camera
        ([n for n in CHAIN if n != "drone_motion"], NO_CAMERA, "drone_motion"),
        ([n for n in CHAIN if n != "telemetry"], NO_CAMERA, "prior"),
        ([n for n in CHAIN if n != "track"], NO_CAMERA, "fix, track"),
    ],
)
def test_a_pose_that_depends_on_another_autopilot_is_refused(tmp_path, nodes, fuse_inputs, ports):
    with pytest.raises(ConfigError) as raised:
        graph_of(tmp_path, nodes, fuse_inputs)
    (error,) = raised.value.errors
    assert error.path == "links.autopilot_2.inputs.pose"
    assert "'fuse_2' depends on 'autopilot', the autopilot of another drone, by its inputs" in error.text
    assert all(port in error.text for port in ports.split(", "))
