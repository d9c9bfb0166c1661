"""`grd info`: what is in a file.

Source: ours.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from flow.link import LinkError
from links.cli.console import out, report_errors, show_table, warn

MAX_FACT_CHARACTERS = 200


@report_errors
def info(
    file: Annotated[Path, typer.Argument(help="A recording, a run's folder, or a file that `grd import` takes.")],
    mapping: Annotated[
        Path | None, typer.Option("--map", help="Write the mapping of a ROS bag as guessed, for `grd import --map`.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing mapping file.")] = False,
) -> None:
    """Show what is in a file: kind, span, topics, and what an import makes of them.

    Example: grd info flight.bag --map mapping.yaml
    """
    from links.importing.info import file_info

    found = file_info(file)
    if mapping is not None:
        if found.mapping is None:
            raise LinkError(f"{file} is no ROS bag: only a bag has a mapping")
        if mapping.exists() and not overwrite:
            raise LinkError(f"{mapping} exists already: give another name with --map, or --overwrite")
    for name, text in found.facts:
        short = text if len(text) <= MAX_FACT_CHARACTERS else f"{text[:MAX_FACT_CHARACTERS]} ..."
        out.print(f"{name}: {short}", markup=False)
    table = Table(*found.columns)
    for row in found.rows:
        table.add_row(*row)
    show_table(table)
    for text in found.warnings:
        warn(text)
    if found.mapping is None:
        return
    if mapping is None:
        out.print("mapping as guessed (`--map FILE` writes it, `grd import --map FILE` takes it):", markup=False)
        out.print(found.mapping.yaml().rstrip() if found.mapping.uses else "nothing that grd can use", markup=False)
    else:
        mapping.write_text(found.mapping.yaml(), encoding="utf-8")
        out.print(f"wrote {mapping}", markup=False)
