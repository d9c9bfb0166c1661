"""The command line application `grd` and its commands.

The module of a command is imported when the command is used: numba's compiled functions and Rerun take seconds.

Source: ours.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from flow.config_error import did_you_mean
from links import __version__

LOADING_LINE_AFTER_S = 1.0
COMPLETION = "_GRD_COMPLETE"  # set by the shell when it asks for completions

# name: module and function in links.cli, beginning of the help
COMMANDS = {
    "run": ("run:run", "Run CONFIG live, or over the recording that its `replay:` names."),
    "replay": ("run:replay_recording", "Replay RECORDING, deterministic and as fast as possible."),
    "check": ("graphs:check", "Report all errors of CONFIG and of the hosts file."),
    "graph": ("graphs:graph", "Draw the graph of CONFIG."),
    "schema": ("graphs:schema", "Write the JSON Schema of the YAML files, for editors."),
    "import": ("files:import_recording", "Convert a capture, a telemetry log or a ROS bag to a recording."),
    "info": (
        "links.importing.command:info",
        "Show what is in a file: kind, span, topics, and what an import makes of them.",
    ),
    "export": ("links.importing.command:export", "Write a recording or a run as a ROS 2 bag (MCAP)."),
    "recover": ("files:recover_recording", "Make a clean copy of a damaged recording."),
    "simulate": ("simulate:simulate_recording", "Make a recording of a simulated flight."),
    "matrix": ("links.simulated.matrix.command:simulate_matrix", "Make the recordings of the scenario matrix."),
    "flights": ("links.simulated.matrix.command:fly_scenarios", "Fly scenarios in closed loop and write a table."),
    "view": ("files:view", "Open a run in the Rerun viewer, or write a screenshot of it."),
    "preflight": ("preflight:preflight", "Check LiDAR, servo, cameras, autopilot, clocks, parameters, axes and disk."),
    "calibrate": ("links.calibration.command:calibrate_recording", "Estimate the LiDAR's mount on its servo."),
    "lens": (
        "links.importing.lens:import_lens",
        "Write the lens in FILE as a rig file, to include in a configuration after its rig.",
    ),
    "train-detector": (
        "links.training.command:train_detector",
        "Train the detector's model and score it on held-out runs.",
    ),
    "evaluate": ("evaluate:evaluate_runs", "Evaluate runs against truth."),
    "verify": ("verify:verify", "Replay the committed recordings and compare their output hashes."),
}


class Commands(TyperGroup):
    """Imports a command when it is asked for; lists all of them without an import."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names in the order of `COMMANDS`."""
        return [*COMMANDS, *super().list_commands(ctx)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of this name; None when there is none."""
        if cmd_name in COMMANDS:
            return command(cmd_name)
        if not ctx.resilient_parsing:  # that of completions
            ctx.fail(f"No such command '{cmd_name}'.{did_you_mean(cmd_name, COMMANDS)}")
        return super().get_command(ctx, cmd_name)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """The list of commands in the help."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in COMMANDS.items()])


def command(name: str) -> Any:
    """A command, after its module was imported."""
    module, _, function = COMMANDS[name][0].partition(":")
    one = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    with _loading_line():
        one.command(name)(getattr(import_module(module if "." in module else f"links.cli.{module}"), function))
    return typer.main.get_command(one)


@contextmanager
def _loading_line() -> Iterator[None]:
    """A line on stderr when an import takes long: a disk that has not read it yet, or kernels to compile."""
    text = "loading; a first run also compiles its kernels, which takes some minutes"
    timer = threading.Timer(LOADING_LINE_AFTER_S, typer.echo, (text,), {"err": True})
    timer.daemon = True
    if COMPLETION not in os.environ:
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


app = typer.Typer(
    name="grd",
    cls=Commands,
    help="Pose of a drone relative to a moving ground vehicle: run live, replay, check, simulate, evaluate.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"grd {__version__}")
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
