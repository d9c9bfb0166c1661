"""Drawings of a graph, and the schema for editors."""

from __future__ import annotations

import xml.etree.ElementTree as ET

from flow.config.draw import mermaid, svg
from flow.config.schema import schema
from flow.graph import load_graph
from stages.geometry.rig import Rig
from tests.flow.toys import GRAPH


def graph_of(tmp_path):
    (tmp_path / "x.yaml").write_text(GRAPH)
    return load_graph(tmp_path / "x.yaml")


def test_mermaid_has_every_node_edge_and_loose_end(tmp_path):
    assert mermaid(graph_of(tmp_path)).splitlines() == [
        "flowchart LR",
        '    numbers(["numbers<br/><small>tests.flow.toys.Numbers</small>"])',
        '    double["double<br/><small>tests.flow.toys.Double</small>"]',
        '    add["add<br/><small>tests.flow.toys.Add</small>"]',
        "    numbers -- number --> double",
        "    numbers -- number --> add",
        "    double -- number --> add",
        "    add -. sum .-> add_sum(( ))",
        "    add -. text .-> add_text(( ))",
    ]


def test_the_svg_is_well_formed_and_columns_follow_the_data(tmp_path):
    root = ET.fromstring(svg(graph_of(tmp_path)))
    space = "{http://www.w3.org/2000/svg}"
    x_of = {t.text: float(t.get("x")) for t in root.iter(f"{space}text") if t.get("font-size") == "15"}
    assert x_of["numbers"] < x_of["double"] < x_of["add"]
    arrows = [p for p in root.iter(f"{space}path") if p.get("marker-end")]
    assert len(arrows) == 3


def test_a_queue_is_drawn_where_an_edge_declares_it(tmp_path):
    declared = "number: {from: numbers.number, policy: drop_oldest, depth: 5}"
    (tmp_path / "x.yaml").write_text(GRAPH.replace("number: numbers.number", declared))
    graph = load_graph(tmp_path / "x.yaml")
    lines = mermaid(graph).splitlines()
    at = lines.index("    numbers -- number --> double")
    assert lines[at + 1] == "    %% live: double.number takes number as drop_oldest 5"
    assert sum("%% live" in line for line in lines) == 1
    assert "double.number: number; live: drop_oldest 5" in svg(graph)


def test_the_schema_accepts_an_edge_as_text_or_with_its_queue():
    edge = schema(Rig)["$defs"]["edge"]["anyOf"]
    assert edge[1]["properties"]["policy"]["enum"] == ["latest", "drop_oldest"]
    stages, links = (
        schema(Rig)["properties"][kind]["additionalProperties"]["properties"] for kind in ("stages", "links")
    )
    assert "thread" in stages
    assert "thread" in links
    assert "process" in stages
    assert "process" not in links


def test_the_schema_has_the_keys_of_the_rig_and_requires_none():
    whole = schema(Rig)
    rig = whole["properties"]["rig"]
    assert rig["additionalProperties"] is False
    assert set(rig["properties"]) == {"version", "lidar", "drone", "cameras", "odometry"}
    assert "required" not in whole["$defs"]["DroneCamera"]
