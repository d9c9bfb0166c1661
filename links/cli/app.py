"""The commands of `grd`, put together.

Source: DESIGN, Command line.
"""

from __future__ import annotations

import typer

from links.cli import files, graphs, run

app = typer.Typer(
    name="grd",
    help="Where is the drone, relative to the vehicle? Runs, replays, checks and makes recordings.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command("run")(run.run)
app.command("replay")(run.replay_recording)
app.command("check")(graphs.check)
app.command("graph")(graphs.graph)
app.command("schema")(graphs.schema)
app.command("import")(files.import_recording)
app.command("recover")(files.recover_recording)
app.command("simulate")(files.simulate_recording)
app.command("view")(files.view)


def main() -> None:
    """Entry point of the command `grd`."""
    app()
