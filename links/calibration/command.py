"""`grd calibrate`: the LiDAR's mount on its servo, estimated from a sweep of a parked vehicle.

Source: DESIGN, Command line; the maths is in `stages/calibration`.
"""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table
from rich.text import Text

from flow.link import LinkError
from links.cli.console import EXIT_FAILED, check_output, err, out, progress_bar, report_errors, show_table, warn
from links.cli.files import Overwrite, read_rig
from links.recording.writer import beside

if TYPE_CHECKING:  # scipy and numba are imported when the command runs
    from links.calibration import Gathered
    from stages.calibration.calibrate import Calibration

ROUNDING_DEG = 1e-6
STILL_M = 0.05  # motion by the vehicle's odometry below which it stood still
DRIFT_MPS = 0.02  # allowed drift of the odometry; the surfaces decide then

LevelDeg = Annotated[
    float | None,
    typer.Option(
        "--level",
        min=0.02,
        max=1.0,
        metavar="DEG",
        help="The vehicle stands level on the ground about it, within DEG (one sigma): gives the axis's tilt.",
    ),
]
ParallelDeg = Annotated[
    float | None,
    typer.Option(
        "--parallel",
        min=0.02,
        max=1.0,
        metavar="DEG",
        help="The vehicle stands parallel to a wall at its side, within DEG (one sigma): gives the servo's zero.",
    ),
]


@report_errors
def calibrate_recording(
    recording: Annotated[
        Path, typer.Argument(help="A recording in which the vehicle stands still and the servo sweeps.")
    ],
    out_file: Annotated[
        Path | None, typer.Option("--out", "-o", help="Rig file to write [default: RECORDING with .rig.yaml].")
    ] = None,
    rig: Annotated[
        Path | None, typer.Option("--rig", help="Rig to start from [default: the one in RECORDING].")
    ] = None,
    parked: Annotated[
        bool, typer.Option("--parked", help="The vehicle stood still: for a servo that swept one way only.")
    ] = False,
    level_deg: LevelDeg = None,
    parallel_deg: ParallelDeg = None,
    from_s: Annotated[float, typer.Option("--from", min=0, help="Second of RECORDING to begin at.")] = 0.0,
    to_s: Annotated[
        float | None, typer.Option("--to", min=0, help="Second of RECORDING to end at [default: its end].")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Estimate the LiDAR's mount on its servo, from surfaces that a sweep of RECORDING observes more than once.

    Estimates tilt and offset from the servo's axis, the encoder error, the gear play and the servo's time offset, each
    with a sigma. A parameter that the sweep or the scene does not determine keeps its value, with the reason. Writes a
    new rig file and, where matplotlib is installed, figures next to it (.svg). The vehicle must stand still. A sweep in
    both directions at two speeds near walls is best. Exit code 1 if no calibration is possible, and no file is written.

    The servo's zero and the tilt of its axis in the vehicle are not observable from a sweep: give the vehicle's
    orientation with --parallel and --level. Front and rear wheel equally far from a wall within 5 mm are parallel
    within 0.15 deg.

    Example: grd calibrate parked.mcap -o rig.yaml && grd replay flight.mcap --overlay rig.yaml
    """
    from links.calibration import gather, rig_text
    from stages.calibration.calibrate import CannotCalibrate
    from stages.calibration.levelling import Standing, stand

    target = out_file or beside(recording, ".rig.yaml")
    if target.suffix not in (".yaml", ".yml"):
        raise LinkError(f"{target}: a rig file ends in .yaml")
    for file in (target, target.with_suffix(".svg")):
        check_output(file, "--out", overwrite=overwrite)
    if to_s is not None and to_s <= from_s:
        raise LinkError(f"--to {to_s:g} is not after --from {from_s:g}")
    with progress_bar(f"read {recording.name}") as step:
        rig_yaml = None if rig is None else read_rig(rig)
        gathered = gather(recording, rig_yaml, (from_s, math.inf if to_s is None else to_s), progress=step)
    for text in gathered.warnings:
        warn(text)
    standing = Standing(*(None if deg is None else math.radians(deg) for deg in (level_deg, parallel_deg)))
    try:
        found = stand(_calibrated(gathered, parked), gathered.mount, standing)
    except CannotCalibrate as why:
        err.print(f"{recording}: {why}.", markup=False, style="red")
        raise typer.Exit(EXIT_FAILED) from None
    _report(recording.name, found, gathered)
    target.write_text(rig_text(gathered.rig, found, recording.name), encoding="utf-8")
    out.print(f"rig         {target}   (use it: grd replay RECORDING --overlay {target})", markup=False)
    _draw(found, target.with_suffix(".svg"))


def _draw(found: Calibration, figures: Path) -> None:
    """Write the figures, where matplotlib is installed."""
    if importlib.util.find_spec("matplotlib") is None:
        out.print("figures     none: matplotlib is not installed: pip install -e '.[evaluate]'", markup=False)
        return
    from links.calibration.figures import draw

    figures.write_text(draw(found), encoding="utf-8")
    out.print(f"figures     {figures}", markup=False)


def _calibrated(gathered: Gathered, parked: bool) -> Calibration:
    """The calibration. Raises CannotCalibrate, also if the vehicle moved by its own odometry."""
    from stages.calibration.calibrate import CannotCalibrate, calibrate

    if gathered.driven_m is not None and gathered.driven_m > STILL_M + DRIFT_MPS * gathered.seconds:
        raise CannotCalibrate(
            f"the vehicle did not stand still: by its odometry it drove {gathered.driven_m:.2f} m. Take a "
            "recording of a parked vehicle, or a part of this one in which it stands (--from, --to)"
        )
    stood = parked or (gathered.driven_m is not None and gathered.driven_m <= STILL_M)
    return calibrate(gathered.returns, gathered.trace, gathered.mount, parked=stood)


def _report(recording: str, found: Calibration, gathered: Gathered) -> None:
    """Print the parameters with their sigmas, and why others were rejected."""
    from links.calibration import zero_found

    parts = f" of the {gathered.parts} parts of {recording}" if gathered.parts > 1 else ""
    table = Table(
        title=f"{len(found.patches.first)} flat patches in {gathered.seconds:.1f} s{parts}", title_justify="left"
    )
    for head in ("", "before", "found", "sigma", ""):
        table.add_column(Text(head), justify="left" if not head else "right")
    for f in found.findings:
        after = "-" if f.rejected else f"{f.after:.4f}"
        table.add_row(Text(f.what), f"{f.before:.4f}", after, f"{f.sigma:.4f}", f.unit)
    show_table(table)
    for f in found.findings:
        if f.rejected:
            out.print(f"{f.what} stays as it is: {f.rejected}", markup=False)
    zero_change_deg = found.mount.servo_zero_deg - gathered.mount.servo_zero_deg
    if abs(zero_change_deg) > ROUNDING_DEG and not zero_found(found):
        out.print(
            f"the zero is written as {found.mount.servo_zero_deg:.4f} deg: it takes back the mean of the encoder's "
            "error, so that the sweep as a whole points where it pointed before"
        )
    out.print(
        f"the rig takes the servo's angle as known to {found.mount.pointing_sigma_deg:.2f} deg, "
        f"{'the zero found' if zero_found(found) else 'a zero set by eye'} in it"
    )
    before_mm, after_mm = (1e3 * t for t in found.thickness.medians_m)
    out.print(
        f"encoder's error over the sweep known to {math.degrees(found.curve_sigma_rad):.4f} deg (one sigma), its mean, "
        f"which is like a zero, to {math.degrees(found.curve_mean_sigma_rad):.4f} deg"
    )
    out.print(f"flat patches: {before_mm:.1f} mm thick before, {after_mm:.1f} mm after (median)")
