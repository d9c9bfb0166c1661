"""`grd import`, `grd recover`, `grd view`: recordings and runs as files.

Source: DESIGN, Command line.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer
import yaml

from flow.config.setting_errors import check_values
from flow.config.tree import Tree, load_tree
from flow.config.yaml_text import YamlTextError, yaml_values
from flow.config_error import ConfigError, Location
from flow.link import LinkError
from links.cli.console import EXIT_FAILED, check_output, err, out, progress_bar, report_errors, warn
from stages.geometry.rig import Rig

MAX_RIG_BYTES = 100_000
BEAM_FILES = (".json", ".csv")  # an Ouster's metadata, a Hesai XT's angle correction
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing output file.")]


@report_errors
def import_recording(
    file: Annotated[
        Path,
        typer.Argument(
            help="A capture (.pcap), a log (.tlog, .bin, .ulg), a ROS bag, or the beams of one LiDAR (.json, .csv)."
        ),
    ],
    out_file: Annotated[
        Path | None, typer.Option("--out", "-o", help="Recording to write [default: next to FILE].")
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            "--rig", help="rig.yaml to attach, or an Ouster's metadata .json [default for .pcap: bolted upright]."
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option("--port", min=1, max=65535, help="UDP port of the LiDAR's data packets [default: the model's]."),
    ] = None,
    sender: Annotated[
        str | None, typer.Option("--sender", help="IPv4 address of the LiDAR, if there are several.")
    ] = None,
    mapping: Annotated[
        Path | None, typer.Option("--map", help="Which topic of a ROS bag is what [default: guessed, `grd info`].")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Convert a capture, a telemetry log or a ROS bag to a recording.

    An Ouster's metadata (.json) or the angle correction file of a Hesai XT (.csv) becomes a rig file with its model and
    its beams, to be included after your rig.

    Example: grd import flight.pcap -o flight.mcap --rig configs/rigs/standard.yaml
    """
    from links.importing import import_file
    from links.ros.mapping import read_mapping

    if file.suffix in BEAM_FILES:
        _import_beams(file, out_file, overwrite)
        return
    rig_yaml = None if rig is None else _upright_rig(rig) if rig.suffix in BEAM_FILES else read_rig(rig)
    with progress_bar(f"import {file.name}") as step:
        report = import_file(
            file,
            out_file,
            rig_yaml=rig_yaml,
            port=port,
            sender=sender,
            mapping=None if mapping is None else read_mapping(mapping),
            overwrite=overwrite,
            progress=step,
        )
    for text in report.warnings:
        warn(text)
    for reason, count in report.skipped.items():
        warn(f"{count} skipped: {reason}")
    topics = ", ".join(f"{count} on {topic}" for topic, count in report.topics.items())
    out.print(f"{report.path}: {topics}", markup=False)


def _import_beams(file: Path, out_file: Path | None, overwrite: bool) -> None:
    """Write the model and the beams in a manufacturer's file as a rig file."""
    lidar = _lidar_of(file)
    target = out_file or file.with_suffix(".yaml")
    check_output(target, "-o", overwrite=overwrite)
    target.write_text(
        yaml.safe_dump({"rig": {"lidar": lidar}}, sort_keys=False, default_flow_style=None, width=120), encoding="utf-8"
    )
    out.print(f"{target}: {lidar['model']}, {len(lidar['beams']['elevation_deg'])} beams", markup=False)


def _upright_rig(file: Path) -> str:
    """The rig of a capture without a known mount, with the beams in a manufacturer's file."""
    from links.importing.imported_file import DEFAULT_RIG

    lidar = _lidar_of(file)
    rig = yaml.safe_load(DEFAULT_RIG.format(model=lidar["model"]))
    rig["lidar"] |= lidar
    return yaml.safe_dump(rig, sort_keys=False, default_flow_style=None, width=120)


def _lidar_of(file: Path) -> dict[str, Any]:
    """Model and beams in a manufacturer's file. LinkError if it is none."""
    from links.lidar import hesai_beams, ouster_beams

    text = file.read_text(encoding="utf-8", errors="replace")
    model, beams = (ouster_beams if file.suffix == ".json" else hesai_beams)(text, str(file))
    return {"model": model, "beams": beams.model_dump(mode="json")}


def read_rig(file: Path) -> str:
    """Text of a rig file, or of the `rig:` section of a configuration with its includes, as recordings store it.

    Raises LinkError when it is not a rig.
    """
    with file.open("rb") as stream:
        data = stream.read(MAX_RIG_BYTES + 1)
    try:
        tree = yaml_values(data) if len(data) <= MAX_RIG_BYTES else None
        if isinstance(tree, dict) and "include" in tree:
            tree = _with_includes(file)
    except YamlTextError as error:
        raise LinkError(f"{file} is no rig: {error}") from None
    rig = tree.get("rig", tree) if isinstance(tree, dict) else None
    if not isinstance(rig, dict) or "lidar" not in rig:
        raise LinkError(f"{file} is no rig: it needs 'lidar:' with 'mount:' as configs/rigs/standard.yaml has")
    mount = rig["lidar"].get("mount") if isinstance(rig["lidar"], dict) else None
    if mount is None:
        raise LinkError(
            f"{file}: lidar.mount is missing: add `include: FILE` of the rig that has it, or the mount as "
            "configs/rigs/standard.yaml has it"
        )
    checked = Tree(root=Location(str(file), 0))
    check_values(checked, (), Rig, rig, "rig")
    if checked.errors:
        raise LinkError(str(checked.errors[0]))
    return yaml.safe_dump(rig, sort_keys=False)


def _with_includes(file: Path) -> dict[str, Any]:
    """Values of a configuration over those that it includes. LinkError with the first error."""
    try:
        tree = load_tree(file)
    except ConfigError as error:
        raise LinkError(str(error.errors[0])) from None
    if tree.errors:
        raise LinkError(str(tree.errors[0]))
    return tree.values


@report_errors
def recover_recording(
    file: Annotated[Path, typer.Argument(help="An unfinished or damaged recording.")],
    out_file: Annotated[
        Path | None, typer.Option("--out", "-o", help="Clean copy to write [default: FILE with .recovered.mcap].")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Make a clean copy of a damaged recording.

    Copies what can be read of a cut-off or damaged file; exit code 1 when something was lost.

    Example: grd recover flight.mcap
    """
    from links.recording import recover

    with progress_bar(f"recover {file.name}") as step:
        report = recover(file, out_file, overwrite=overwrite, progress=step)
    for text in report.warnings:
        warn(text)
    topics = ", ".join(f"{count} on {topic}" for topic, count in report.topics.items())
    out.print(f"{report.path}: {topics}", markup=False)
    if report.warnings:
        raise typer.Exit(EXIT_FAILED)


def _size(text: str) -> str:
    if not re.fullmatch(r"[1-9]\d{1,4}x[1-9]\d{1,4}", text):
        raise typer.BadParameter(f"{text} is not WIDTHxHEIGHT in pixels, as 1920x1080 is.")
    return text


def _rrd_of(run: Path | None) -> Path:
    """The .rrd file of a run; of None: of the newest run in out/. LinkError when there is none."""
    if run is None:
        found = sorted(Path("out").glob("*/*.rrd"), key=lambda file: file.stat().st_mtime)
        if not found:
            raise LinkError("out/ holds no run with a run.rrd: name the folder of a run, or: grd run quickstart")
        out.print(f"the newest run: {found[-1]}", markup=False)
        return found[-1]
    if run.suffix == ".mcap":
        raise LinkError(f"{run} is a recording: grd replay {run} --view")
    if not run.is_dir():
        return run
    file = next(iter(sorted(run.glob("*.rrd"))), None)
    if file is None:
        raise LinkError(f"{run} holds no run.rrd: its configuration has no viewer (links.viewer.Viewer)")
    return file


@report_errors
def view(
    run: Annotated[
        Path | None, typer.Argument(help="Folder of a run, or its run.rrd [default: the newest run in out/].")
    ] = None,
    png: Annotated[
        Path | None,
        typer.Option("--screenshot", help="Write an image instead of opening a window (no display needed)."),
    ] = None,
    at: Annotated[float, typer.Option("--at", min=0, max=1, help="Time of the image, as a fraction of the run.")] = 0.9,
    tab: Annotated[str | None, typer.Option("--tab", help="Tab in the image [default: Overview].")] = None,
    size: Annotated[
        str, typer.Option("--size", metavar="WxH", callback=_size, help="Size of the image [px].")
    ] = "1920x1080",
) -> None:
    """Open a run in the Rerun viewer, or write a screenshot of it.

    With --screenshot the exit code is 1 when a view has errors.

    Example: grd view out/experiment_1-quickstart --screenshot run.png
    """
    from links.viewer import screenshot, show

    rrd = _rrd_of(run)
    if png is None:
        if tab is not None:
            raise LinkError("--tab selects the tab of an image: add --screenshot FILE.png")
        show(rrd)
        return
    check_output(png, "--screenshot", overwrite=True)
    errors = screenshot(rrd, png, at=at, tab=tab, size=size)
    for text in errors:
        err.print(text, markup=False, style="red")
    out.print(f"wrote {png}", markup=False)
    if errors:
        raise typer.Exit(EXIT_FAILED)
