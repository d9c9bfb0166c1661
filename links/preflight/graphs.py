"""Subgraphs of a configuration that a preflight runs. Neither sends poses to the autopilot."""

from __future__ import annotations

from dataclasses import replace

from flow.graph import Graph
from flow.link import Source
from flow.stage import output_ports
from stages.messages import DroneFix, RelativePose


def sources_only(graph: Graph) -> Graph:
    """The sources only: nothing moves and no stage runs."""
    return replace(graph, nodes={n: s for n, s in graph.nodes.items() if issubclass(s.cls, Source)}, edges=())


def tracking(graph: Graph) -> Graph:
    """The sources and all nodes that the LiDAR track needs: the servo turns."""
    edges = [e for e in graph.edges if not (e.message is RelativePose and graph.nodes[e.consumer].kind == "links")]
    wanted = {name for name, spec in graph.nodes.items() if DroneFix in output_ports(spec.cls).values()}
    while more := {edge.producer for edge in edges if edge.consumer in wanted} - wanted:
        wanted |= more
    wanted |= set(sources_only(graph).nodes)
    nodes = {name: spec for name, spec in graph.nodes.items() if name in wanted}
    return replace(graph, nodes=nodes, edges=tuple(e for e in edges if {e.producer, e.consumer} <= set(nodes)))


def locates_drones(graph: Graph) -> bool:
    """Whether any stage outputs DroneFix."""
    return any(DroneFix in output_ports(spec.cls).values() for spec in graph.nodes.values())
