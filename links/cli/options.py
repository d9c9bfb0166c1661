"""Arguments and options that several commands have.

Source: ours.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flow.link import LinkError
from links.runs.shipped import shipped, shipped_all

Config = Annotated[
    Path,
    typer.Argument(callback=shipped, help="Configuration; a name such as `quickstart` is one that comes with grd."),
]
Overlay = Annotated[
    list[Path] | None,
    typer.Option("--overlay", callback=shipped_all, help="YAML file laid over CONFIG; may be repeated."),
]
Sets = Annotated[
    list[str] | None, typer.Option("--set", metavar="NAME.SETTING=VALUE", help="Change one setting; may be repeated.")
]
Out = Annotated[Path | None, typer.Option("--out", help="Output folder [default: out/<recording>-<config>].")]
HostsFile = Annotated[
    Path | None, typer.Option("--hosts", metavar="FILE", help="Live on several hosts: see links/zenoh/README.md.")
]
HostName = Annotated[str | None, typer.Option("--host", metavar="NAME", help="Name of this host in FILE.")]
Jobs = Annotated[
    int, typer.Option("--jobs", min=1, max=256, help="Number of processes; it does not affect the results.")
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        help="Run on the workers of a dask scheduler, as tcp://127.0.0.1:8786, with the same files at the same paths.",
    ),
]
View = Annotated[bool, typer.Option("--view", help="Open the run in the Rerun viewer at its end.")]


def place_of(hosts: Path | None, host: str | None) -> tuple[Path, str] | None:
    """The hosts file and the name of this host; None: the only host. Raises LinkError for one without the other."""
    if hosts is None and host is None:
        return None
    if hosts is None or host is None:
        raise LinkError("--hosts FILE and --host NAME go together: FILE places stages on hosts, NAME is this host")
    return hosts, host
