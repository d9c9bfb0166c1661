"""`grd info`: what is in a file; `grd export`: a recording or a run as a ROS 2 bag.

Source: ours.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from flow.link import LinkError
from links.cli.console import check_output, out, progress_bar, report_errors, show_table, warn
from links.cli.files import read_rig

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
        check_output(mapping, "--map", overwrite=overwrite)
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


@report_errors
def export(
    source: Annotated[Path, typer.Argument(help="A recording, or the folder of a run.")],
    out_folder: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder or file to write [default: next to SOURCE, NAME_ros2].")
    ] = None,
    recording: Annotated[
        Path | None, typer.Option("--recording", help="Recording of the run, to add the sensors' data.")
    ] = None,
    rig: Annotated[Path | None, typer.Option("--rig", help="rig.yaml of a recording that has none.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing bag or file.")] = False,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="Write one MCAP file in Foxglove's schemas [NAME_foxglove.mcap].")
    ] = False,
) -> None:
    """Write a recording or a run as a ROS 2 bag (MCAP) for RViz and ros2 bag play, or as a file for Foxglove.

    Example: grd export out/street_sweep-estimate --recording recordings/street_sweep.mcap --foxglove
    """
    from links.foxglove import export as write_foxglove
    from links.ros.export import export as write_ros

    if recording is not None and not source.is_dir():
        raise LinkError("--recording adds the sensors' data to a run's folder: without it give the recording itself")
    write, ending = (write_foxglove, "_foxglove.mcap") if foxglove else (write_ros, "_ros2")
    target = out_folder or source.absolute().parent / f"{source.absolute().stem}{ending}"
    with progress_bar(f"export {source.name}") as step:
        rig_yaml = None if rig is None else read_rig(rig)
        report = write(source, target, recording=recording, rig_yaml=rig_yaml, overwrite=overwrite, progress=step)
    for text in report.warnings:
        warn(text)
    topics = ", ".join(f"{count} on {topic}" for topic, count in report.topics.items())
    out.print(f"{report.path}: {topics}", markup=False)
