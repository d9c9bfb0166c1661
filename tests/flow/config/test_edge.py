"""Edges in a configuration: their queues, defaults and errors."""

from __future__ import annotations

import pytest

from flow.config.edge import DEPTH, QueueSettings, default_queue
from flow.config_error import ConfigError
from flow.graph import load_graph
from stages.messages import DepthImage, Image, LidarFirings, SweptPulses, VanishingDirections
from tests.flow.toys import GRAPH

LEFT = "left: numbers.number"


def queue_of(tmp_path, left: str) -> QueueSettings:
    (tmp_path / "x.yaml").write_text(GRAPH.replace(LEFT, f"left: {left}"))
    (edge,) = (e for e in load_graph(tmp_path / "x.yaml").edges if e.name == "add.left")
    return edge.queue


@pytest.mark.parametrize(
    ("declared", "queue"),
    [
        ("numbers.number", QueueSettings("drop_oldest", DEPTH, 100.0)),
        ("{from: numbers.number}", QueueSettings("drop_oldest", DEPTH, 100.0)),
        ("{from: numbers.number, policy: latest}", QueueSettings("latest", 1, 100.0)),
        ("{from: numbers.number, policy: drop_oldest, depth: 7}", QueueSettings("drop_oldest", 7, 100.0)),
        ("{from: numbers.number, depth: 64, deadline_ms: 20}", QueueSettings("drop_oldest", 64, 20.0)),
    ],
)
def test_an_edge_declares_its_queue(tmp_path, declared, queue):
    assert queue_of(tmp_path, declared) == queue


def test_by_default_only_the_newest_image_is_queued_and_half_a_second_of_lidar_data():
    assert {default_queue(kind).policy for kind in (Image, DepthImage)} == {"latest"}
    for kind in (LidarFirings, SweptPulses, VanishingDirections):
        assert default_queue(kind) == QueueSettings("drop_oldest", DEPTH)
    assert DEPTH > 754 / 2  # half a second of packets


@pytest.mark.parametrize(
    ("declared", "error"),
    [
        ("{policy: latest}", "x.yaml:9: stages.add.inputs.left: must have 'from: node.output', got None."),
        (
            "{from: numbers.number, policy: newest}",
            "x.yaml:9: stages.add.inputs.left.policy: must be 'latest' or 'drop_oldest', got 'newest'.",
        ),
        (
            "{from: numbers.number, policy: drop_oldst}",
            "x.yaml:9: stages.add.inputs.left.policy: must be 'latest' or 'drop_oldest', got 'drop_oldst'. "
            "Did you mean 'drop_oldest'?",
        ),
        (
            "{from: numbers.number, depht: 3}",
            "x.yaml:9: stages.add.inputs.left.depht: unknown key 'depht'; there is 'from', 'policy', 'depth' or "
            "'deadline_ms'. Did you mean 'depth'?",
        ),
        (
            "{from: numbers.number, policy: latest, depth: 3}",
            "x.yaml:9: stages.add.inputs.left.depth: 'latest' keeps one message: leave depth out, or take 'drop_oldest'.",
        ),
        (
            "{from: numbers.nmber}",
            "x.yaml:9: stages.add.inputs.left: 'numbers' has no output 'nmber'. Did you mean 'number'?",
        ),
        *[
            (
                f"{{from: numbers.number, depth: {depth}}}",
                f"x.yaml:9: stages.add.inputs.left.depth: must be a whole number from 1 to 100000, got {got}.",
            )
            for depth, got in [
                ("0", "0"),
                ("1.5", "1.5"),
                ("many", "'many'"),
                ("true", "True"),
                ("1000000", "1000000"),
            ]
        ],
        *[
            (
                f"{{from: numbers.number, deadline_ms: {ms}}}",
                f"x.yaml:9: stages.add.inputs.left.deadline_ms: must be a number above 0, up to 60000, got {got}.",
            )
            for ms, got in [("0", "0"), ("-1", "-1"), (".nan", "nan"), ("soon", "'soon'")]
        ],
    ],
)
def test_a_wrong_queue_is_an_error_at_its_line(tmp_path, declared, error):
    (tmp_path / "x.yaml").write_text(GRAPH.replace(LEFT, f"left: {declared}"))
    with pytest.raises(ConfigError) as caught:
        load_graph(tmp_path / "x.yaml")
    assert [str(p).replace(f"{tmp_path}/", "") for p in caught.value.errors] == [error]


def test_a_thread_has_a_name_as_stages_have(tmp_path):
    (tmp_path / "x.yaml").write_text(GRAPH.replace("  double:\n", "  double:\n    thread: No 1\n"))
    with pytest.raises(
        ConfigError, match=r"x\.yaml:3: stages\.double\.thread: must be a name as stages have, got 'No 1'"
    ):
        load_graph(tmp_path / "x.yaml")


def test_an_optional_input_that_an_included_file_wires_can_be_unwired(tmp_path):
    (tmp_path / "below.yaml").write_text(
        GRAPH.replace(LEFT, f"{LEFT}\n      words: words.text") + "  words: {use: tests.flow.toys.Words}\n"
    )
    (tmp_path / "x.yaml").write_text("include: below.yaml\nstages: {add: {inputs: {words: null}}}\n")
    assert "add.words" not in [edge.name for edge in load_graph(tmp_path / "x.yaml").edges]
