"""`grd matrix`: recordings of the scenario matrix; `grd flights`: outcomes of flights in closed loop.

Source: DESIGN, Command line.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flow.link import LinkError
from links.cli.console import EXIT_FAILED, EXIT_USAGE, err, out, progress_bar, report_errors, warn
from links.cli.options import Jobs, Scheduler
from links.cli.simulate import ClosedLoop, not_installed
from links.runs.shipped import shipped, shipped_scenarios
from stages.geometry.lidar_models import LIDAR_MODELS

if TYPE_CHECKING:  # the simulator is an optional dependency
    from types import ModuleType

    from links.simulated.matrix.flights import Cell
    from links.simulated.matrix.making import MatrixReport
    from links.simulated.matrix.matrix import Conditions

Folder = Annotated[Path, typer.Argument(help="Folder for the recordings, one per cell and seed.")]
Seeds = Annotated[int, typer.Option("--seeds", min=1, max=1000, help="Number of seeds per cell.")]
FirstSeed = Annotated[int, typer.Option("--first-seed", min=0, help="First seed.")]
Only = Annotated[
    list[str] | None,
    typer.Option("--only", help="Cells whose name matches, as 'campus-*-orbit-parked'; may be repeated."),
]
Pairs = Annotated[
    bool, typer.Option("--pairs", help="Subset of cells that has any two of range, motion, vehicle and scene.")
]
Calibrated = Annotated[
    bool, typer.Option("--calibrated", help="The rig file has the encoder's error and the backlash of the servo.")
]
Perturbed = Annotated[
    bool,
    typer.Option("--perturbed", help="Each flight has a rig that differs from its file, and a random kind of drone."),
]
Odometry = Annotated[bool, typer.Option("--odometry", help="The vehicle sends odometry.")]
Rain = Annotated[bool, typer.Option("--rain", help="Rain of 5 mm/h.")]
Sparse = Annotated[bool, typer.Option("--sparse", help="Fewer rays per LiDAR pulse, in half the time.")]
VariedSky = Annotated[
    bool,
    typer.Option("--varied-sky", help="Gliding, circling and hovering birds, flocks, insects, kites, bags."),
]
Clutter = Annotated[
    bool,
    typer.Option(
        "--clutter",
        help="Furniture, signs, boards, wires, people, reflections; cameras with rolling shutter, dirt and flare.",
    ),
]
LidarName = Annotated[
    str, typer.Option("--lidar", metavar="MODEL", help="LiDAR of the rig, as `rig.lidar.model`: XT32, OS1-64, ...")
]
WithAutopilot = Annotated[
    bool, typer.Option("--autopilot", help="The drone sends telemetry over a radio, and obeys flight dynamics.")
]
CamerasHz = Annotated[
    float | None,
    typer.Option(
        "--cameras",
        metavar="HZ",
        min=1,
        max=15,
        help="Rate of two fisheyes; rendering a pair of 720 px images takes 0.8 s of a core.",
    ),
]
CamerasPx = Annotated[
    int | None,
    typer.Option("--pixels", min=64, max=1440, help="Size of the fisheye images. [default: 720]"),
]
ReadoutMs = Annotated[
    float | None,
    typer.Option("--readout", metavar="MS", min=0, max=60, help="Rolling shutter, first to last row. [default: 0]"),
]
ImagesFrom = Annotated[
    Path | None,
    typer.Option(
        "--images",
        metavar="DIR",
        help="Use the images of the recordings of the same names in DIR. It is an error if one is missing or shows "
        "another flight (the same command without --images then renders the rest).",
    ),
]
Results = Annotated[
    Path | None,
    typer.Option(
        "--results",
        metavar="OUT",
        help="Keep the runs of the closed loop, as OUT/<recording>-<config>: the output of `grd replay --config "
        "CONFIG` of each recording, without the second pass, without .rrd file. For `grd evaluate OUT/*`.",
    ),
]
ListOnly = Annotated[bool, typer.Option("--list", help="Print the names of the cells and exit.")]


@report_errors
def simulate_matrix(
    folder: Folder,
    seeds: Seeds = 1,
    first_seed: FirstSeed = 1,
    only: Only = None,
    pairs: Pairs = False,
    closed_loop: ClosedLoop = None,
    calibrated: Calibrated = False,
    perturbed: Perturbed = False,
    odometry: Odometry = False,
    rain: Rain = False,
    sparse: Sparse = False,
    varied_sky: VariedSky = False,
    clutter: Clutter = False,
    lidar: LidarName = "VLP-16",
    autopilot: WithAutopilot = False,
    cameras_hz: CamerasHz = None,
    cameras_px: CamerasPx = None,
    readout_ms: ReadoutMs = None,
    images: ImagesFrom = None,
    results: Results = None,
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
    list_only: ListOnly = False,
) -> None:
    """Make the recordings of the scenario matrix.

    Range x motion x vehicle x scene, an occlusion, and a drone that leaves and returns; also an empty sky, two drones,
    a drone to search for at 40 m, and drones at 50 m. Existing recordings are kept if they are complete and made in the
    same way (the same scenario, and the same CONFIG with its includes), so the command can be interrupted and repeated.
    Changed code is not detected: use another DIR after a change. A recording that fails does not stop the others.
    Exit code 1 when a scene does not allow a cell or a stage failed, 2 for any other failure.

    Example: grd matrix out/matrix --only '*-empty-*' --closed-loop configs/sim.yaml --results out/runs --jobs 2
    """
    _check_options(lidar, closed_loop, results)
    _check_cameras(cameras_hz, {"--images": images, "--pixels": cameras_px, "--readout": readout_ms})
    selected = _cells(folder, only or ["*"], pairs)
    if list_only:
        out.print("\n".join(cell.name for cell in selected), markup=False)
        return
    conditions = _matrix().Conditions(
        calibrated=calibrated,
        odometry=odometry,
        rain=rain,
        autopilot=autopilot,
        cameras_hz=cameras_hz,
        cameras_px=cameras_px or _matrix().Conditions.cameras_px,
        readout_ms=readout_ms or 0.0,
        lidar=lidar,
        perturbed=perturbed,
        sparse=sparse,
        varied_sky=varied_sky,
        clutter=clutter,
    )
    several = range(first_seed, first_seed + seeds)
    _make(folder, selected, several, closed_loop, conditions, results, scheduler or jobs, images)


def _matrix() -> ModuleType:
    """The module of the matrix. LinkError when the simulator is not installed."""
    try:
        from links.simulated.matrix import matrix
    except ModuleNotFoundError as missing:
        raise not_installed(missing) from None
    return matrix


def _check_options(lidar: str, closed_loop: Path | None, results: Path | None) -> None:
    """LinkError for an unknown LiDAR, and for runs to keep without a closed loop."""
    if lidar not in LIDAR_MODELS:
        raise LinkError(f"--lidar {lidar}: not one of {', '.join(LIDAR_MODELS)}")
    if results is not None and closed_loop is None:
        raise LinkError("--results keeps the runs of a closed loop: add --closed-loop CONFIG")


def _make(
    folder: Path,
    selected: list[Cell],
    seeds: range,
    closed_loop: Path | None,
    conditions: Conditions,
    results: Path | None,
    workers: int | str,
    images: Path | None,
) -> None:
    """Make the recordings, print the summary, and exit with its code."""
    from links.simulated.matrix.making import make_matrix

    with progress_bar(f"{len(selected) * len(seeds)} recordings") as step:
        report = make_matrix(folder, selected, seeds, closed_loop, step, conditions, results, workers, images)
    _report(folder, report)


def _check_cameras(cameras_hz: float | None, of_cameras: dict[str, object]) -> None:
    """LinkError for an option of the cameras without cameras."""
    for option, value in of_cameras.items():
        if value is not None and cameras_hz is None:
            raise LinkError(f"{option} is for recordings with cameras: add --cameras HZ")


def _cells(folder: Path, patterns: list[str], pairs: bool) -> list[Cell]:
    """The cells whose name matches. LinkError when none does."""
    selected: list[Cell] = _matrix().cells(patterns, pairs)
    if not selected:
        names = " or ".join(f"'{pattern}'" for pattern in patterns)
        few = " among the pairs" if pairs else ""
        raise LinkError(f"no cell{few} matches {names}; `grd matrix {folder} --list` prints all names")
    return selected


def _report(folder: Path, report: MatrixReport) -> None:
    """Print the summary and exit with its code."""
    for text in report.impossible:
        warn(text)
    for failure in report.failed:
        err.print(failure.text, markup=False, style="red")
    text = f"{folder}: {report.made} made, {report.kept} kept"
    out.print(f"{text}; {report.replayed} of them replayed" if report.replayed else text, markup=False)
    if any(not failure.stage_failed for failure in report.failed):
        raise typer.Exit(EXIT_USAGE)
    if report.impossible or report.failed:
        raise typer.Exit(EXIT_FAILED)


@report_errors
def fly_scenarios(
    scenarios: Annotated[
        list[Path], typer.Argument(callback=shipped_scenarios, help="Scenarios with an autopilot in the loop.")
    ],
    closed_loop: Annotated[
        Path,
        typer.Option(
            "--closed-loop", metavar="CONFIG", callback=shipped, help="Configuration on whose poses the drone flies."
        ),
    ],
    folder: Annotated[Path, typer.Option("--out", "-o", help="Folder for the outcomes and the table.")],
    seeds: Annotated[int, typer.Option("--seeds", min=1, max=1000, help="Number of seeds per scenario.")] = 3,
    first_seed: Annotated[int, typer.Option("--first-seed", min=0, help="First seed.")] = 1,
    sets: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a setting of all scenarios; repeatable."),
    ] = None,
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
) -> None:
    """Fly scenarios in closed loop and write a table: OUT/flights.md, and OUT/flights.csv with a line per flight.

    Outcomes of the same scenario, settings, CONFIG and seed are kept, so the command can be interrupted and repeated.
    Changed code is not detected: use another OUT after a change. Exit code 1 when a flight was lost or sent a wrong
    pose.

    Example: grd flights configs/scenarios/flight/matrix/*.yaml --closed-loop configs/sim_flight_fixes.yaml -o out/m
    """
    try:
        from links.simulated.matrix.flight_runs import fly_all
        from links.simulated.matrix.flight_table import markdown_table, write_csv
    except ModuleNotFoundError as missing:
        raise not_installed(missing) from None

    several = range(first_seed, first_seed + seeds)
    with progress_bar(f"{len(scenarios) * seeds} flights") as step:
        results = fly_all(scenarios, sets or (), closed_loop, several, folder, scheduler or jobs, step)
    for result in results:
        out.print(str(result), markup=False)
    table = markdown_table(results)
    (folder / "flights.md").write_text(table, encoding="utf-8")
    write_csv(folder / "flights.csv", results)
    out.print(table, markup=False)
    if any(r.outcome is None or r.outcome["lost_s"] is not None or r.outcome["wrong_poses"] for r in results):
        raise typer.Exit(EXIT_FAILED)
