"""`grd run` and `grd replay`: a graph, live or over a recording, into a folder with all that people look at afterwards.

Source: DESIGN, Command line and Outputs of a run.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from flow.graph import recording_named
from flow.link import LinkError
from flow.live.report import LiveReport
from links.cli.console import FINDING, err, in_words, out, progress_bar, show_table, warn
from links.cli.live_view import LiveView
from links.runs.as_live import repeat_into
from links.runs.live_run import live_graph, run_live
from links.runs.output_hashes import hash_matches
from links.runs.results import FIX_FILE, POSE_FILE, SUMMARY_FILE, stamp_s
from links.runs.run_folder import Asked, Finished, replay_into
from links.runs.warm_up import warm_up
from links.zenoh import host_graph

TABLE_ROWS = 12
REPOSITORY = Path(__file__).resolve().parents[2]
DEFAULT_REPLAY_CONFIG = REPOSITORY / "configs" / "replay.yaml"

Overlay = Annotated[list[Path] | None, typer.Option("--overlay", help="A YAML file laid over CONFIG; may be repeated.")]
Sets = Annotated[
    list[str] | None, typer.Option("--set", metavar="NAME.SETTING=VALUE", help="Change one setting; may be repeated.")
]
Out = Annotated[Path | None, typer.Option("--out", help="Folder for the results [default: out/<recording>-<config>].")]
View = Annotated[bool, typer.Option("--view", help="Open the run in the Rerun viewer when it is done.")]


@in_words
def run(
    config: Annotated[Path, typer.Argument(help="Configuration; live, unless its `replay:` names a recording.")],
    out_dir: Out = None,
    overlay: Overlay = None,
    sets: Sets = None,
    for_s: Annotated[
        float | None,
        typer.Option("--for", min=0.1, metavar="SECONDS", help="Live: stop after so long [default: at Ctrl-C]."),
    ] = None,
    warm: Annotated[
        bool,
        typer.Option(
            "--warm-up/--no-warm-up", help="Live: try the graph on a recording first, so that all is compiled."
        ),
    ] = True,
    hosts: Annotated[
        Path | None, typer.Option("--hosts", metavar="FILE", help="Live on several hosts: links/zenoh/README.md.")
    ] = None,
    host: Annotated[
        str | None, typer.Option("--host", metavar="NAME", help="Which of FILE's hosts this one is.")
    ] = None,
    view: View = False,
) -> None:
    """Run what CONFIG says: live, or the recording it names.

    A live run records itself (`links.recording.Recorder`); Ctrl-C or SIGTERM ends it. Exit code 1 when a stage stopped
    it, or was switched off because it kept raising.

    Example: grd run configs/quickstart.yaml --set track.radius_m=0.8
    """
    recording = recording_named(config, overlay or (), sets or ())
    if (hosts is None) is not (host is None):
        raise LinkError("--hosts FILE and --host NAME go together: the file says who runs what, the name who this is")
    if recording is not None:
        if for_s is not None or hosts is not None:
            option = "--for" if for_s is not None else "--hosts"
            raise LinkError(f"{option} is of live runs, and {config} replays {recording.name}: leave it out")
        _run(recording, config, out_dir, overlay or [], sets or [], view)
        return
    asked = Asked(config, tuple(overlay or ()), tuple(sets or ()))
    graph, folder = live_graph(asked), _new_folder(out_dir, f"live-{config.stem}")
    if parts := sorted(folder.glob("*.mcap")):
        raise LinkError(
            f"{folder} holds a recording already ({parts[0].name}), of a run that was cut off: "
            "name another --out, or move it"
        )
    if hosts is not None and host is not None:
        graph = host_graph(graph, hosts, host, to_run=True)
    with progress_bar("warm up") as step:
        rough = warm_up(graph, step) if warm else None
    for text in (*graph.left_out_texts(), *([rough] if rough else ())):
        warn(text)
    with LiveView() as watch:
        finished = run_live(folder, asked, graph, watch.show, for_s, (watch.newest,))
    _tell(finished)
    if view:
        _open_viewer(finished.out_dir)
    report = finished.report
    if isinstance(report, LiveReport) and report.switched_off:
        err.print(f"'{report.switched_off[0]}' did not work to the end: it kept raising", markup=False, style="red")
        raise typer.Exit(FINDING)


@in_words
def replay_recording(
    recording: Annotated[Path, typer.Argument(help="A .mcap recording (`grd import` makes one of a .pcap or .tlog).")],
    config: Annotated[
        Path | None, typer.Option("--config", help="Configuration [default: configs/replay.yaml].")
    ] = None,
    out_dir: Out = None,
    overlay: Overlay = None,
    sets: Sets = None,
    as_live: Annotated[
        bool,
        typer.Option(
            "--as-live",
            help="A live run's recording: the run itself again, with its own configuration, drops and hash, "
            "instead of what this configuration makes of its records.",
        ),
    ] = False,
    together: Annotated[
        bool,
        typer.Option(
            "--together",
            help="One process, also where the configuration has stages work in others (several cores only). "
            "The outcome is the same.",
        ),
    ] = False,
    expect: Annotated[
        str | None,
        typer.Option("--expect", metavar="HASH", help="Exit code 1 unless the output hash is this one."),
    ] = None,
    view: View = False,
) -> None:
    """Replay RECORDING: deterministic, as fast as possible; of a live run's first part all parts, of a later one that.

    --expect takes a whole output hash, or its first 16 digits: those cover the values, the rest the texts for people.
    With --as-live each stage takes what it took in the live run, in that order; exit code 1 when the hash is not the
    live run's.

    Example: grd replay recordings/street_sweep.mcap --out out/mine
    """
    if as_live:
        if config or overlay or sets:
            raise LinkError(
                "--as-live takes the recording's own configuration: leave out --config, --overlay and --set"
            )
        digest = _repeat(recording, out_dir, view)
    else:
        chosen = config or DEFAULT_REPLAY_CONFIG
        digest = _run(recording, chosen, out_dir, overlay or [], sets or [], view, together).digest
    if expect is not None and not hash_matches(expect, digest):
        err.print(f"the output hash is {digest}, and {expect} was expected", markup=False, style="red")
        raise typer.Exit(FINDING)


def _run(
    recording: Path,
    config: Path,
    out_dir: Path | None,
    overlays: list[Path],
    sets: list[str],
    view: bool,
    together: bool = False,
) -> Finished:
    folder = _new_folder(out_dir, f"{recording.stem}-{config.stem}")
    with progress_bar(f"replay {recording.name}") as step:
        asked = Asked(config, tuple(overlays), tuple(sets))
        finished = replay_into(folder, recording, asked, step, together=together)
    _tell(finished)
    if view:
        _open_viewer(finished.out_dir)
    return finished


def _repeat(recording: Path, out_dir: Path | None, view: bool) -> str:
    folder = _new_folder(out_dir, f"{recording.stem}-as-live")
    with progress_bar(f"replay {recording.name} as live") as step:
        repeated = repeat_into(folder, recording, step)
    _tell(repeated.finished)
    out.print(repeated.verdict)
    if view:
        _open_viewer(folder)
    if not repeated.same:
        raise typer.Exit(FINDING)
    return repeated.finished.digest


def _new_folder(wanted: Path | None, name: str) -> Path:
    """Where the results go; an earlier run is never overwritten."""
    if wanted is not None:
        if (wanted / SUMMARY_FILE).exists():
            raise LinkError(f"{wanted} holds a run already: name another --out, or remove it first.")
        return wanted
    folder = Path("out", name)
    number = 1
    while folder.exists():
        number += 1
        folder = Path("out", f"{name}-{number}")
    return folder


def _tell(run: Finished) -> None:
    """The positions, the answer in a sentence, and where to look."""
    results, report = run.results, run.report
    live = isinstance(report, LiveReport)
    for text in () if live else run.warnings:  # live they were said as they came
        warn(text)
    if results.fixes:
        show_table(_table(run))
    recorded_s = (report.last_ns - report.first_ns) / 1e9
    parts = f" in {run.parts} parts" if run.parts is not None and run.parts > 1 else ""
    found = f"drone accepted in {results.sweeps_with_drone} of {results.sweeps} sweeps, {len(results.fixes)} fixes"
    out.print(
        f"{report.records} records{parts}, {recorded_s:.1f} s recorded, {run.wall_s:.1f} s to run; "
        f"{'no stage seeks a drone' if run.ran_instead else found}"
    )
    if run.ran_instead:
        out.print(f"ran: {run.ran_instead}", markup=False)
    elif not results.sweeps:
        out.print("no drone: no sweep was completed, so nothing was searched")
    elif not results.fixes:
        for verdict, count in results.verdicts[:3]:
            out.print(f"in {count} of {results.sweeps} sweeps: {verdict}", markup=False)
    for change in results.transitions[-3:]:
        who = f"track {change.track_id}" if change.track_id > 1 else "tracker"
        out.print(f"{who} at {stamp_s(change.stamp_ns)} s: {change.state}, {change.reason}", markup=False)
    if run.errors is not None and len(run.errors.stamps_ns):
        x, y, z = run.errors.rmse_xyz_m
        out.print(
            f"against the simulation's truth: RMSE x/y/z {x:.3f} {y:.3f} {z:.3f} m, 3D {run.errors.rmse_m:.3f} m; "
            f"truth inside the 95 % ellipsoid in {100 * run.errors.inside_95:.0f} % of fixes"
        )
    if results.pose_states:
        states = ", ".join(f"{count} {state}" for state, count in results.pose_states.items())
        out.print(f"fused poses: {states}; {results.resets} jumps")
    left_out = [
        f"{name}: {count} {what}"
        for name, told in report.counters.items()
        for what, count in told.items()
        if what.startswith("refused") and count
    ]
    if left_out:
        out.print(f"left out: {'; '.join(left_out)}", markup=False)
    if run.usage is not None and str(run.usage):
        out.print(f"used: {run.usage}")
    out.print(f"output hash {run.digest}")
    if not run.ran_instead:
        out.print(f"positions   {run.out_dir / FIX_FILE}")
    if results.pose_states:
        out.print(f"poses       {run.out_dir / POSE_FILE}")
    out.print(f"summary     {run.out_dir / SUMMARY_FILE}")
    if live and run.recording.is_file():
        out.print(f"flight      {run.recording}   (the same again: grd replay {run.recording} --as-live)")
    rerun_files = sorted(run.out_dir.glob("*.rrd"))
    for path in rerun_files:
        out.print(f"recording   {path}   (look at it: rerun {path})")


def _table(run: Finished) -> Table:
    """At most TABLE_ROWS fixes, evenly taken; the error column only where truth is known."""
    fixes = run.results.fixes
    error = {}
    if run.errors is not None:
        error = dict(zip(run.errors.stamps_ns.tolist(), run.errors.error_m, strict=True))
    step = max(1, -(-len(fixes) // TABLE_ROWS))
    table = Table(title=f"drone in the vehicle frame, {len(fixes[::step])} of {len(fixes)} fixes", title_justify="left")
    heads = ["t [s]", "x forward [m]", "y left [m]", "z up [m]", "sigma [m]", "hits", *(["error [m]"] if error else [])]
    for head in heads:
        table.add_column(Text(head), justify="right")
    for fix in fixes[::step]:
        since_s = (fix.stamp_ns - run.report.first_ns) / 1e9
        sigma_m = float(fix.covariance_m2.trace()) ** 0.5
        cells = [f"{since_s:.2f}", *(f"{v:.2f}" for v in fix.xyz_vehicle_m), f"{sigma_m:.2f}", str(fix.hits)]
        if error:
            wrong = error.get(fix.stamp_ns)
            cells.append("-" if wrong is None else f"{float((wrong @ wrong) ** 0.5):.2f}")
        table.add_row(*cells)
    return table


def _open_viewer(out_dir: Path) -> None:
    from links.viewer import show

    files = sorted(out_dir.glob("*.rrd"))
    if not files:
        err.print("nothing to view: the configuration has no viewer link (links.viewer.Viewer)")
        return
    show(files[0])
