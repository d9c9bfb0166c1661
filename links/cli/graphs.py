"""`grd check`, `grd graph`, `grd schema`: look at a configuration without running it.

Source: DESIGN, flow.
"""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from flow.draw import mermaid, svg
from flow.graph import load_graph
from flow.problem import ConfigError
from flow.schema import schema as schema_of
from links.cli.console import FINDING, err, in_words, out
from links.cli.run import Overlay, Sets

Config = Annotated[Path, typer.Argument(help="Configuration file.")]
OutFile = Annotated[Path | None, typer.Option("--out", "-o", help="File to write [default: the terminal].")]


class Format(StrEnum):
    """How to draw."""

    MERMAID = "mermaid"
    SVG = "svg"


@in_words
def check(config: Config, overlay: Overlay = None, sets: Sets = None) -> None:
    """Say everything that is wrong with CONFIG.

    Each problem with its line and a suggestion; exit code 1 when there is one.

    Example: grd check configs/paper.yaml --set track.radius_m=0.8
    """
    try:
        graph = load_graph(config, overlay or (), sets or ())
    except ConfigError as error:
        for problem in error.problems:
            err.print(str(problem), markup=False, style="red")
        raise typer.Exit(FINDING) from None
    stages = sum(spec.kind == "stages" for spec in graph.nodes.values())
    out.print(f"{config}: {stages} stages, {len(graph.nodes) - stages} links, {len(graph.edges)} edges, no problems")


@in_words
def graph(
    config: Config,
    format: Annotated[Format, typer.Option("--format", help="Mermaid text or an SVG picture.")] = Format.MERMAID,
    out_file: OutFile = None,
    overlay: Overlay = None,
    sets: Sets = None,
) -> None:
    """Draw the graph of CONFIG.

    Example: grd graph configs/paper.yaml --format svg -o graph.svg
    """
    checked = load_graph(config, overlay or (), sets or ())
    _write(svg(checked) if format is Format.SVG else mermaid(checked), out_file)


@in_words
def schema(out_file: OutFile = None) -> None:
    """Write the JSON Schema of the YAML files, for editors.

    Example: grd schema -o configs/grd.schema.json
    """
    _write(json.dumps(schema_of(), indent=1, sort_keys=True) + "\n", out_file)


def _write(text: str, file: Path | None) -> None:
    if file is None:
        typer.echo(text, nl=False)
    else:
        file.write_text(text, encoding="utf-8")
        out.print(f"wrote {file}")
