"""`grd preflight`: check everything that a configuration declares before the flight; prints GO or NO-GO."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from flow.graph import Graph
from flow.link import LinkError
from links.cli.console import EXIT_FAILED, err, out, progress_bar, report_errors, warn
from links.cli.options import Config, HostName, HostsFile, Overlay, Sets, place_of
from links.preflight.check_result import CheckResult, Level, is_go
from links.preflight.hand_motion import HandMotion
from links.preflight.preflight import OUT_DIR, preflight_live, preflight_recording
from links.recording import Session
from links.runs.live_run import live_graph
from links.runs.request import RunRequest
from links.zenoh import host_graph

COLOURS = {Level.OK: "green", Level.WARNING: "yellow", Level.FAIL: "red"}
LABELS = {Level.OK: "ok", Level.WARNING: "warn", Level.FAIL: "NO GO"}


@report_errors
def preflight(
    config: Config,
    overlay: Overlay = None,
    sets: Sets = None,
    recording: Annotated[
        Path | None, typer.Option("--recording", help="Check a recording instead of what is connected.")
    ] = None,
    for_s: Annotated[
        float,
        typer.Option(
            "--for",
            min=0.5,
            max=600,
            metavar="SECONDS",
            help="Live: observation time, from when every source has sent.",
        ),
    ] = 5.0,
    out_dir: Annotated[
        Path, typer.Option("--out", help="Live: the output folder of `grd run`; its disk is checked.")
    ] = OUT_DIR,
    motion: Annotated[
        bool,
        typer.Option(
            "--motion/--no-motion", help="Move the drone by hand; in a recording: compare axes, track the drone."
        ),
    ] = True,
    step_s: Annotated[
        float, typer.Option("--step", min=0.5, max=120, metavar="SECONDS", help="Time for each motion by hand.")
    ] = 6.0,
    hosts: HostsFile = None,
    host: HostName = None,
) -> None:
    """Check LiDAR, servo, cameras, autopilot, clocks, parameters, axes and disk; print GO or NO-GO.

    Live, the turntable is still at first; for the motions by hand it turns. Poses are not sent to the autopilot.
    With --hosts run it on all hosts at the same time: the connections are checked too. Warnings ("warn") are for you to
    assess. Exit code 0: go, 1: no go, 2: wrong use.

    Example: grd preflight configs/field.yaml --set lidar.bind=192.168.1.100 --set lidar.sender=192.168.1.201
    """
    request = RunRequest(config, tuple(overlay or ()), tuple(sets or ()))
    place = place_of(hosts, host)
    if recording is None:
        whole = live_graph(request)
        _warn_left_out(whole)
        graph = whole if place is None else host_graph(whole, *place, to_run=True)
        results = _print_results(preflight_live(graph, for_s, _wait, _ask if motion else None, step_s, out_dir, whole))
    elif place is not None:
        raise LinkError("--hosts is for a live preflight, --recording for one on a recording: leave one of them out")
    else:
        results = _on_recording(request, recording, motion)
    failed = [v for v in results if v.level is Level.FAIL]
    warnings = sum(v.level is Level.WARNING for v in results)
    more = f"; {warnings} warnings" if warnings else ""
    if is_go(results):
        out.print(Text(f"GO: {len(results)} checks, no failure{more}", style="bold green"))
        return
    names = ", ".join(v.name for v in failed)
    out.print(Text(f"NO-GO: {len(failed)} of {len(results)} checks failed ({names}){more}", style="bold red"))
    raise typer.Exit(EXIT_FAILED)


def _on_recording(request: RunRequest, recording: Path, motion: bool) -> list[CheckResult]:
    session = Session(recording)
    graph = request.graph_on(session)
    _warn_left_out(graph)
    with progress_bar(f"replay {recording.name}") as step:
        results = list(preflight_recording(graph, session, motion, step))
    for text in session.warnings:
        warn(text)
    if len(session.parts) > 1:
        out.print(f"{len(session.parts)} parts of the recording, checked together")
    return _print_results(iter(results))


def _warn_left_out(graph: Graph) -> None:
    """Without cameras in the rig no camera is checked."""
    for text in graph.left_out_texts():
        warn(text)


def _print_results(results: Iterator[CheckResult]) -> list[CheckResult]:
    """Print each result when it is known; returns all."""
    printed: list[CheckResult] = []
    for result in results:
        line = Text(f"{LABELS[result.level]:<6}", style=COLOURS[result.level]).append(f"{result.name}: ", style="bold")
        out.print(line.append(result.sentence, style="default"))
        printed.append(result)
    if not printed:
        raise LinkError("this configuration has nothing to check")
    return printed


def _wait(seconds: float) -> None:
    time.sleep(seconds)


def _ask(motion: HandMotion) -> None:
    """Print the instruction; at a terminal, wait until the operator starts."""
    err.print(motion.instruction, markup=False, style="bold")
    if sys.stdin.isatty():
        typer.prompt("Press Enter to start", default="", show_default=False, err=True)
