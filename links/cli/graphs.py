"""`grd check`, `grd graph`, `grd schema`: inspect a configuration without running it.

Source: DESIGN, flow.
"""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from flow.config.draw import mermaid, svg
from flow.config.hosts import Hosts
from flow.config.hosts_file import load_hosts
from flow.config.schema import schema as schema_of
from flow.config_error import ConfigError
from flow.graph import Graph
from links.cli.console import EXIT_FAILED, EXIT_USAGE, err, out, report_errors, warn
from links.cli.options import Config, Overlay, Sets
from links.preflight.shipped_values import shipped_values
from links.runs.request import RunRequest
from links.zenoh import host_graph
from stages.geometry.rig import Rig

OutFile = Annotated[Path | None, typer.Option("--out", "-o", help="File to write [default: the terminal].")]
HostsFile = Annotated[Path | None, typer.Option("--hosts", help="A hosts file: which host runs what.")]


class Format(StrEnum):
    """Output format of `grd graph`."""

    MERMAID = "mermaid"
    SVG = "svg"


@report_errors
def check(config: Config, overlay: Overlay = None, sets: Sets = None, hosts: HostsFile = None) -> None:
    """Report all errors of CONFIG and of the hosts file.

    Each error has its line and a suggestion; the exit code is 1 when there is one. Warnings name settings of a live
    configuration that depend on your vehicle and still have the value that comes with grd.

    Example: grd check configs/paper.yaml --set track.radius_m=0.8
    """
    try:
        graph = RunRequest(config, tuple(overlay or ()), tuple(sets or ())).graph()
        placed = load_hosts(hosts, graph) if hosts is not None else None
    except ConfigError as error:
        for entry in error.errors:
            err.print(str(entry), markup=False, style="red")
        raise typer.Exit(EXIT_FAILED) from None
    stages = sum(spec.kind == "stages" for spec in graph.nodes.values())
    as_shipped = shipped_values(graph)
    found = f"no errors, {len(as_shipped)} settings as shipped" if as_shipped else "no problems"
    out.print(f"{config}: {stages} stages, {len(graph.nodes) - stages} links, {len(graph.edges)} edges, {found}")
    for text in graph.left_out_texts():
        out.print(text, markup=False)
    for text in as_shipped:
        warn(text)
    if placed is not None:
        _print_hosts(placed)


def _print_hosts(hosts: Hosts) -> None:
    """Print what each host runs and sends."""
    for name in hosts.hosts:
        nodes = [node for node in hosts.graph.nodes if hosts.placement[node] == name]
        hub = ", the hub" if name == hosts.hub else ""
        out.print(f"{name}{hub}: runs {', '.join(nodes) or 'nothing'}", markup=False)
        for hop in hosts.hops:
            if hop.sender == name:
                out.print(f"  to {hop.receiver}: {hop.producer}.{hop.output} ({hop.queue})", markup=False)


@report_errors
def graph(
    config: Config,
    format: Annotated[Format, typer.Option("--format", help="Mermaid text or an SVG image.")] = Format.MERMAID,
    out_file: OutFile = None,
    overlay: Overlay = None,
    sets: Sets = None,
    hosts: HostsFile = None,
    host: Annotated[str | None, typer.Option("--host", help="Draw what this one of the hosts runs.")] = None,
) -> None:
    """Draw the graph of CONFIG; with --hosts a box around what each host runs, with --host what that one runs.

    Example: grd graph configs/paper.yaml --format svg -o graph.svg
    """
    checked = RunRequest(config, tuple(overlay or ()), tuple(sets or ())).graph()
    if host is not None and hosts is None:
        err.print("--host NAME needs --hosts FILE")
        raise typer.Exit(EXIT_USAGE)
    if hosts is not None and host is None and format is Format.SVG:
        err.print("an SVG shows one host: add --host NAME, or draw all hosts as Mermaid")
        raise typer.Exit(EXIT_USAGE)
    if hosts is not None and host is not None:
        checked = host_graph(checked, hosts, host)
    boxes = _boxes(checked, load_hosts(hosts, checked)) if hosts is not None and host is None else ""
    _write(svg(checked) if format is Format.SVG else mermaid(checked) + boxes, out_file)


def _boxes(graph: Graph, hosts: Hosts) -> str:
    """Mermaid subgraphs: what each host runs."""
    lines: list[str] = []
    for name in hosts.hosts:
        inside = [f"        {node}" for node in graph.nodes if hosts.placement[node] == name]
        lines += [f"    subgraph {name}", *inside, "    end"] if inside else []
    return "\n".join(lines) + "\n"


@report_errors
def schema(out_file: OutFile = None) -> None:
    """Write the JSON Schema of the YAML files, for editors.

    Example: grd schema -o configs/grd.schema.json
    """
    _write(json.dumps(schema_of(Rig), indent=1, sort_keys=True) + "\n", out_file)


def _write(text: str, file: Path | None) -> None:
    if file is None:
        typer.echo(text, nl=False)
    else:
        file.write_text(text, encoding="utf-8")
        out.print(f"wrote {file}")
