"""The command line application `grd` and its commands.

Source: ours.
"""

from __future__ import annotations

from typing import Annotated

import typer

from links import __version__
from links.cli.calibrate import calibrate_recording
from links.cli.console import out
from links.cli.evaluate import evaluate_runs
from links.cli.files import import_recording, recover_recording, view
from links.cli.graphs import check, graph, schema
from links.cli.lens import import_lens
from links.cli.preflight import preflight
from links.cli.run import replay_recording, run
from links.cli.simulate import fly_scenarios, simulate_matrix, simulate_recording
from links.cli.verify import verify
from links.training.command import train_detector

app = typer.Typer(
    name="grd",
    help="Pose of a drone relative to a moving ground vehicle: run live, replay, check, simulate, evaluate.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command("run")(run)
app.command("replay")(replay_recording)
app.command("check")(check)
app.command("graph")(graph)
app.command("schema")(schema)
app.command("import")(import_recording)
app.command("recover")(recover_recording)
app.command("simulate")(simulate_recording)
app.command("matrix")(simulate_matrix)
app.command("flights")(fly_scenarios)
app.command("view")(view)
app.command("preflight")(preflight)
app.command("calibrate")(calibrate_recording)
app.command("lens")(import_lens)
app.command("train-detector")(train_detector)
app.command("evaluate")(evaluate_runs)
app.command("verify")(verify)


def _version(wanted: bool) -> None:
    if wanted:
        out.print(f"grd {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    del version


def main() -> None:
    """Entry point of the command `grd`."""
    app()
