"""The graph as a picture and the schema for editors."""

from __future__ import annotations

import xml.etree.ElementTree as ET

from flow.draw import mermaid, svg
from flow.graph import load_graph
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
