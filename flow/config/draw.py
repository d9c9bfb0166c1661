"""Drawings of a graph: Mermaid text for documents and the viewer, SVG for people. Data flows to the right.

Source: ours.
"""

from __future__ import annotations

from html import escape

from flow.config.edge import default_queue
from flow.config.node_spec import NodeSpec
from flow.graph import Graph
from flow.link import Tap
from flow.stage import output_ports

_BOX_W, _BOX_H, _GAP_X, _GAP_Y, _MARGIN, _LANE = 210, 58, 130, 42, 24, 14
_LEFT = 90  # space for edges back to the first column
_FILL = {"stages": "#e8f0fe", "links": "#fef3e0"}


def mermaid(graph: Graph) -> str:
    """Flowchart text: stages as boxes, links as rounded boxes, each edge with its message; unwired outputs dotted.

    A comment gives the queue of an edge where it is not the default of its message type.
    """
    lines = ["flowchart LR"]
    for spec in graph.nodes.values():
        label = f'"{spec.name}<br/><small>{_caption(spec)}</small>"'
        lines.append(f"    {spec.name}[{label}]" if spec.kind == "stages" else f"    {spec.name}([{label}])")
    for edge in graph.edges:
        lines.append(f"    {edge.producer} -- {edge.output} --> {edge.consumer}")
        if edge.queue != default_queue(edge.message):
            lines.append(f"    %% live: {edge.name} takes {edge.output} as {edge.queue}")
    wired = {(edge.producer, edge.output) for edge in graph.edges}
    for node, output, _ in graph.outputs():
        if (node, output) not in wired:
            lines.append(f"    {node} -. {output} .-> {node}_{output}(( ))")
    return "\n".join(lines) + "\n"


def svg(graph: Graph) -> str:
    """A self-contained SVG. A node's column is the length of the longest path to it; edges past columns run below."""
    column = _columns(graph)
    rows: dict[int, list[str]] = {}
    for name in graph.nodes:
        rows.setdefault(column[name], []).append(name)
    tallest = max(len(names) for names in rows.values())
    at: dict[str, tuple[float, float]] = {}
    for col, names in rows.items():
        spare = (tallest - len(names)) * (_BOX_H + _GAP_Y) / 2
        for row, name in enumerate(names):
            at[name] = (_LEFT + col * (_BOX_W + _GAP_X), _MARGIN + spare + row * (_BOX_H + _GAP_Y))
    width = max(x for x, _ in at.values()) + _BOX_W + _MARGIN + _GAP_X
    long_edges = sum(column[e.consumer] != column[e.producer] + 1 for e in graph.edges)
    height = max(y for _, y in at.values()) + _BOX_H + 2 * _MARGIN + _LANE * long_edges
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" '
        f'width="{width:.0f}" height="{height:.0f}" font-family="sans-serif">',
        '<defs><marker id="a" markerWidth="8" markerHeight="8" refX="7" refY="3" orient="auto">'
        '<path d="M0,0 L7,3 L0,6 z" fill="#555"/></marker></defs>',
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="white"/>',
    ]
    parts += _edges(graph, at)
    for spec in graph.nodes.values():
        x, y = at[spec.name]
        radius = 6 if spec.kind == "stages" else 26
        parts.append(
            f'<rect x="{x:.0f}" y="{y:.0f}" width="{_BOX_W}" height="{_BOX_H}" rx="{radius}" '
            f'fill="{_FILL[spec.kind]}" stroke="#555"/>'
            f'<text x="{x + _BOX_W / 2:.0f}" y="{y + 25:.0f}" text-anchor="middle" font-size="15">'
            f"{escape(spec.name)}</text>"
            f'<text x="{x + _BOX_W / 2:.0f}" y="{y + 43:.0f}" text-anchor="middle" font-size="9" fill="#555">'
            f"{escape(_caption(spec))}</text>"
        )
    return "\n".join([*parts, "</svg>"]) + "\n"


def _caption(spec: NodeSpec) -> str:
    return f"{spec.use}, receives every message" if issubclass(spec.cls, Tap) else spec.use


def _columns(graph: Graph) -> dict[str, int]:
    column: dict[str, int] = {}
    for name in graph.nodes:  # rank order: producers come first
        before = [column[e.producer] + 1 for e in graph.edges if e.consumer == name and e.producer in column]
        column[name] = max(before, default=0)
    return column


def _edges(graph: Graph, at: dict[str, tuple[float, float]]) -> list[str]:
    parts: list[str] = []
    wired = {(edge.producer, edge.output) for edge in graph.edges}
    low = lane = max(y for _, y in at.values()) + _BOX_H
    for spec in graph.nodes.values():
        outputs = list(output_ports(spec.cls))
        for index, output in enumerate(outputs):
            x, y = at[spec.name]
            x, y = x + _BOX_W, y + _BOX_H * (index + 1) / (len(outputs) + 1)
            label = f'<text x="{x + 6:.0f}" y="{y - 4:.0f}" font-size="11" fill="#333">{escape(output)}</text>'
            parts.append(label)
            if (spec.name, output) not in wired:
                parts.append(f'<path d="M{x:.0f},{y:.0f} h40" stroke="#999" fill="none" stroke-dasharray="4 3"/>')
            for edge in graph.edges:
                if (edge.producer, edge.output) != (spec.name, output):
                    continue
                incoming = [e for e in graph.edges if e.consumer == edge.consumer]
                tx, ty = at[edge.consumer]
                ty += _BOX_H * (incoming.index(edge) + 1) / (len(incoming) + 1)
                if 0 <= tx - x <= _GAP_X:
                    bend = (tx - x) / 2
                    path = f"M{x:.0f},{y:.0f} C{x + bend:.0f},{y:.0f} {tx - bend:.0f},{ty:.0f} {tx:.0f},{ty:.0f}"
                else:  # past other columns, or back: along its own lane below all boxes
                    lane += _LANE
                    turn, back = x + _LANE + (lane - low) / 2, tx - _LANE - (lane - low) / 2
                    path = f"M{x:.0f},{y:.0f} H{turn:.0f} V{lane:.0f} H{back:.0f} V{ty:.0f} H{tx:.0f}"
                tip = f"<title>{escape(f'{edge.name}: {edge.output}; live: {edge.queue}')}</title>"
                parts.append(f'<path d="{path}" stroke="#555" fill="none" marker-end="url(#a)">{tip}</path>')
    return parts
