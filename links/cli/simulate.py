"""`grd simulate`, `grd matrix`: recordings of simulated flights.

Source: DESIGN, Command line.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flow.link import LinkError
from links.cli.console import FINDING, WRONG_USE, err, in_words, out, progress_bar, warn
from links.cli.files import Overwrite

if TYPE_CHECKING:  # what simulates is installed where it is wanted
    from links.simulated.matrix.flights import Cell
    from links.simulated.matrix.making import MatrixReport

ClosedLoop = Annotated[
    Path | None,
    typer.Option("--closed-loop", metavar="CONFIG", help="Configuration whose own aim turns the servo, in its time."),
]


@in_words
def simulate_recording(
    scenario: Annotated[Path, typer.Argument(help="Scenario file, as in configs/scenarios/.")],
    out_file: Annotated[Path, typer.Option("--out", "-o", help="Recording to write.")],
    seed: Annotated[
        int | None, typer.Option("--seed", help="Another world and other noise [default: the scenario's].")
    ] = None,
    closed_loop: ClosedLoop = None,
    duration_s: Annotated[
        float | None,
        typer.Option("--duration", min=0.1, max=3600, help="Seconds to simulate [default: the scenario's]."),
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(
            "--images",
            metavar="FROM.mcap",
            help="Take the cameras' images from a recording of the same flight instead of painting them, which takes "
            "most of the time. LiDAR, servo, radio and CONFIG may differ; what images show may not.",
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Make a recording of a simulated flight.

    It holds the bytes that the sensors would have sent, and the truth beside them. The scenario's script turns the
    servo, or in closed loop a configuration's own aim does.

    Example: grd simulate configs/scenarios/experiment_1.yaml -o flight.mcap --closed-loop configs/sim.yaml --seed 3
    """
    try:
        from links.simulated.rig.run import simulate
    except ModuleNotFoundError as missing:
        raise _not_installed(missing) from None

    with progress_bar(f"simulate {scenario.name}") as step:
        report = simulate(
            scenario,
            out_file,
            seed=seed,
            overwrite=overwrite,
            progress=lambda done: step(done, 1.0),
            closed_loop=closed_loop,
            duration_s=duration_s,
            images=images,
        )
    out.print(str(report), markup=False)


@in_words
def simulate_matrix(
    folder: Annotated[Path, typer.Argument(help="Where the recordings go, one for each cell and seed.")],
    seeds: Annotated[int, typer.Option("--seeds", min=1, max=1000, help="Make so many seeds of each cell.")] = 1,
    first_seed: Annotated[int, typer.Option("--first-seed", min=0, help="The first of them.")] = 1,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", help="Cells whose name matches, as in 'campus-*-orbit-parked'; may be repeated."),
    ] = None,
    pairs: Annotated[
        bool, typer.Option("--pairs", help="Few cells in which each two of range, motion, vehicle and scene meet.")
    ] = False,
    closed_loop: ClosedLoop = None,
    calibrated: Annotated[
        bool, typer.Option("--calibrated", help="The rig knows the error of the servo's encoder and its play.")
    ] = False,
    perturbed: Annotated[
        bool,
        typer.Option(
            "--perturbed", help="Each flight's rig is not quite as its file says, its drone one of several kinds."
        ),
    ] = False,
    odometry: Annotated[bool, typer.Option("--odometry", help="The vehicle has odometry.")] = False,
    rain: Annotated[bool, typer.Option("--rain", help="It rains, 5 mm/h.")] = False,
    autopilot: Annotated[
        bool, typer.Option("--autopilot", help="The drone tells over a radio how it flies, and flies by its dynamics.")
    ] = False,
    cameras_hz: Annotated[
        float | None,
        typer.Option(
            "--cameras",
            metavar="HZ",
            min=1,
            max=15,
            help="Two fisheyes at this rate; at 720 px 0.8 s of a core a pair.",
        ),
    ] = None,
    cameras_px: Annotated[
        int | None,
        typer.Option("--pixels", min=64, max=1440, help="The fisheyes' images are this large. [default: 720]"),
    ] = None,
    readout_ms: Annotated[
        float | None,
        typer.Option(
            "--readout", metavar="MS", min=0, max=60, help="Their rolling shutter, first to last row. [default: 0]"
        ),
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(
            "--images",
            metavar="DIR",
            help="Take the images from DIR's recordings of the same names; where one is missing or of another flight "
            "that is an error (the same command without --images then paints what is left).",
        ),
    ] = None,
    results: Annotated[
        Path | None,
        typer.Option(
            "--results",
            metavar="OUT",
            help="Keep the closed loop's runs too, as OUT/<recording>-<config>: what `grd replay --config CONFIG` of "
            "each recording leaves, without the second pass. No viewer file. For `grd evaluate OUT/*`.",
        ),
    ] = None,
    jobs: Annotated[
        int, typer.Option("--jobs", min=1, max=256, help="Processes to share the recordings; the outcome is the same.")
    ] = 1,
    list_only: Annotated[bool, typer.Option("--list", help="Name the cells; make none.")] = False,
) -> None:
    """Make the recordings of the scenario matrix.

    Range x motion x vehicle x scene, an occlusion, and a drone that leaves and returns; beside them an empty sky, two
    drones, a drone to search for at 40 m, and drones at 50 m. Recordings that are there, complete and made alike (the
    same scenario and all that CONFIG and its includes say) are kept, so it can be stopped and started again; changed
    code is not noticed, take another DIR for it. When one cannot be made the others are made all the same, and it is
    named in the end. Exit code 1 when a scene had no place for a cell or a stage failed, 2 when another thing did.

    Example: grd matrix out/matrix --only '*-empty-*' --closed-loop configs/sim.yaml --results out/runs --jobs 2
    """
    try:
        from links.simulated.matrix.making import make_matrix
        from links.simulated.matrix.matrix import Conditions
    except ModuleNotFoundError as missing:
        raise _not_installed(missing) from None

    if results is not None and closed_loop is None:
        raise LinkError("--results keeps the closed loop's runs: say whose with --closed-loop CONFIG")
    of_cameras = {"--images": images, "--pixels": cameras_px, "--readout": readout_ms}
    for option, value in of_cameras.items():
        if value is not None and cameras_hz is None:
            raise LinkError(f"{option} is for recordings with cameras: say at which rate with --cameras HZ")
    wanted = _cells(folder, only or ["*"], pairs)
    if list_only:
        for cell in wanted:
            out.print(cell.name, markup=False)
        return
    size_px = cameras_px or Conditions.cameras_px
    conditions = Conditions(calibrated, odometry, rain, autopilot, cameras_hz, size_px, readout_ms or 0.0, perturbed)
    several = range(first_seed, first_seed + seeds)
    with progress_bar(f"{len(wanted) * seeds} recordings") as step:
        report = make_matrix(folder, wanted, several, closed_loop, step, conditions, results, jobs, images)
    _tell(folder, report)


def _cells(folder: Path, patterns: list[str], pairs: bool) -> list[Cell]:
    """Those of the matrix that are called so. LinkError: none is."""
    from links.simulated.matrix.matrix import cells

    wanted = cells(patterns, pairs)
    if not wanted:
        names = " or ".join(f"'{pattern}'" for pattern in patterns)
        few = " among the pairs" if pairs else ""
        raise LinkError(f"no cell{few} is called like {names}; `grd matrix {folder} --list` names them all")
    return wanted


def _tell(folder: Path, report: MatrixReport) -> None:
    """What was made, and by the exit code whether all was."""
    for text in report.impossible:
        warn(text)
    for failure in report.failed:
        err.print(failure.text, markup=False, style="red")
    text = f"{folder}: {report.made} made, {report.kept} were there already"
    out.print(f"{text}; {report.replayed} of them replayed" if report.replayed else text, markup=False)
    if any(not failure.stage_failed for failure in report.failed):
        raise typer.Exit(WRONG_USE)
    if report.impossible or report.failed:
        raise typer.Exit(FINDING)


def _not_installed(missing: ModuleNotFoundError) -> LinkError:
    return LinkError(f"simulating needs '{missing.name}', not installed: pip install -e '.[simulate]'")
