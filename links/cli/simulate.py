"""`grd simulate`: a recording of a simulated flight.

Source: DESIGN, Command line.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flow.link import LinkError
from links.cli.console import out, progress_bar, report_errors
from links.cli.files import Overwrite
from links.runs.shipped import shipped_option, shipped_scenario

ClosedLoop = Annotated[
    Path | None,
    typer.Option(
        "--closed-loop",
        metavar="CONFIG",
        callback=shipped_option,
        help="Configuration whose pipeline commands the servo.",
    ),
]


@report_errors
def simulate_recording(
    scenario: Annotated[
        Path, typer.Argument(callback=shipped_scenario, help="Scenario file, as in configs/scenarios/.")
    ],
    out_file: Annotated[Path, typer.Option("--out", "-o", help="Recording to write.")],
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, help="Seed of scene and noise [default: the scenario's].")
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
            help="Use the camera images of a recording of the same flight: rendering takes most of the time. LiDAR, "
            "servo, radio and CONFIG may differ; settings that affect the images may not.",
        ),
    ] = None,
    sets: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a setting of SCENARIO, as in autopilot.imu_hz=25."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Make a recording of a simulated flight.

    The recording has the bytes that the sensors send, and the ground truth. The servo is commanded by the script of the
    scenario or, in closed loop, by the pipeline of a configuration.

    Example: grd simulate configs/scenarios/experiment_1.yaml -o flight.mcap --closed-loop configs/sim.yaml --seed 3
    """
    try:
        from links.simulated.rig.run import simulate
    except ModuleNotFoundError as missing:
        raise not_installed(missing) from None

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
            sets=sets or (),
        )
    out.print(str(report), markup=False)


def not_installed(missing: ModuleNotFoundError) -> LinkError:
    """The error for a command of the simulator without its extra."""
    return LinkError(f"simulating needs '{missing.name}', not installed: pip install -e '.[simulate]'")
