"""`grd run` and `grd replay`: run a graph live or over a recording, into an output folder.

Source: ours.
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
from links.cli.console import EXIT_FAILED, err, out, progress_bar, report_errors, show_table, warn
from links.cli.live_view import LiveView
from links.runs.as_live import rerun_into
from links.runs.live_run import live_graph, run_live
from links.runs.output_hashes import hash_matches
from links.runs.request import RunRequest, RunResult
from links.runs.results import FIX_FILE, POSE_FILE, SUMMARY_FILE, stamp_s
from links.runs.run_folder import replay_into
from links.runs.warm_up import warm_up
from links.zenoh import host_graph

TABLE_ROWS = 12
REPOSITORY = Path(__file__).resolve().parents[2]
DEFAULT_REPLAY_CONFIG = REPOSITORY / "configs" / "replay.yaml"

Overlay = Annotated[list[Path] | None, typer.Option("--overlay", help="YAML file laid over CONFIG; may be repeated.")]
Sets = Annotated[
    list[str] | None, typer.Option("--set", metavar="NAME.SETTING=VALUE", help="Change one setting; may be repeated.")
]
Out = Annotated[Path | None, typer.Option("--out", help="Output folder [default: out/<recording>-<config>].")]
View = Annotated[bool, typer.Option("--view", help="Open the run in the Rerun viewer at its end.")]


@report_errors
def run(
    config: Annotated[Path, typer.Argument(help="Configuration. It runs live unless its `replay:` names a recording.")],
    out_dir: Out = None,
    overlay: Overlay = None,
    sets: Sets = None,
    for_s: Annotated[
        float | None,
        typer.Option("--for", min=0.1, metavar="SECONDS", help="Live: stop after this time [default: at Ctrl-C]."),
    ] = None,
    warm: Annotated[
        bool,
        typer.Option(
            "--warm-up/--no-warm-up", help="Live: replay a recording first, so that all kernels are compiled."
        ),
    ] = True,
    hosts: Annotated[
        Path | None, typer.Option("--hosts", metavar="FILE", help="Live on several hosts: see links/zenoh/README.md.")
    ] = None,
    host: Annotated[str | None, typer.Option("--host", metavar="NAME", help="Name of this host in FILE.")] = None,
    view: View = False,
) -> None:
    """Run CONFIG live, or over the recording that it names.

    A live run is recorded (`links.recording.Recorder`); Ctrl-C or SIGTERM ends it. Exit code 1 when a stage stopped
    the run or was switched off after repeated errors.

    Example: grd run configs/quickstart.yaml --set track.radius_m=0.8
    """
    recording = recording_named(config, overlay or (), sets or ())
    if (hosts is None) is not (host is None):
        raise LinkError("--hosts FILE and --host NAME go together: FILE places stages on hosts, NAME is this host")
    if recording is not None:
        if for_s is not None or hosts is not None:
            option = "--for" if for_s is not None else "--hosts"
            raise LinkError(f"{option} is for live runs, and {config} replays {recording.name}: leave it out")
        _run(recording, config, out_dir, overlay or [], sets or [], view)
        return
    request = RunRequest(config, tuple(overlay or ()), tuple(sets or ()))
    graph, folder = live_graph(request), _new_folder(out_dir, f"live-{config.stem}")
    if parts := sorted(folder.glob("*.mcap")):
        raise LinkError(
            f"{folder} has the recording of an interrupted run already ({parts[0].name}): "
            "name another --out, or move it"
        )
    if hosts is not None and host is not None:
        graph = host_graph(graph, hosts, host, to_run=True)
    with progress_bar("warm up") as step:
        not_warm = warm_up(graph, step) if warm else None
    for text in (*graph.left_out_texts(), *([not_warm] if not_warm else ())):
        warn(text)
    with LiveView() as view_of_run:
        result = run_live(folder, request, graph, view_of_run.show, for_s, (view_of_run.latest,))
    _print_result(result)
    if view:
        _open_viewer(result.out_dir)
    report = result.report
    if isinstance(report, LiveReport) and report.switched_off:
        err.print(f"'{report.switched_off[0]}' was switched off after repeated errors", markup=False, style="red")
        raise typer.Exit(EXIT_FAILED)


@report_errors
def replay_recording(
    recording: Annotated[Path, typer.Argument(help="A .mcap recording (`grd import` converts a .pcap or .tlog).")],
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
            help="Recording of a live run: re-run it with its own configuration, input order and drops, "
            "and compare the output hash.",
        ),
    ] = False,
    trust: Annotated[
        bool,
        typer.Option(
            "--trust",
            help="With --as-live: the recording is your own, so import its own stages and run its taps.",
        ),
    ] = False,
    single_process: Annotated[
        bool,
        typer.Option(
            "--single-process",
            help="Run in one process, even if the configuration places stages in subprocesses. "
            "The results are the same.",
        ),
    ] = False,
    expect: Annotated[
        str | None,
        typer.Option("--expect", metavar="HASH", help="Exit code 1 unless the output hash is this one."),
    ] = None,
    view: View = False,
) -> None:
    """Replay RECORDING, deterministic and as fast as possible.

    The first part of a split recording stands for all parts; a later part is replayed alone. --expect takes a whole
    output hash or its first 16 digits: those cover the values, the rest covers the reason texts. With --as-live each
    stage gets the inputs of the live run in the same order; exit code 1 when the hash differs from that of the run.
    The configuration in a recording is data: it may use the stages and links of grd only, and writes to --out only.

    Example: grd replay recordings/street_sweep.mcap --out out/mine
    """
    if as_live:
        if config or overlay or sets:
            raise LinkError(
                "--as-live takes the recording's own configuration: leave out --config, --overlay and --set"
            )
        output_hash = _rerun(recording, out_dir, view, trust)
    else:
        chosen = config or DEFAULT_REPLAY_CONFIG
        output_hash = _run(recording, chosen, out_dir, overlay or [], sets or [], view, single_process).output_hash
    if expect is not None and not hash_matches(expect, output_hash):
        err.print(f"the output hash is {output_hash}, expected {expect}", markup=False, style="red")
        raise typer.Exit(EXIT_FAILED)


def _run(
    recording: Path,
    config: Path,
    out_dir: Path | None,
    overlays: list[Path],
    sets: list[str],
    view: bool,
    single_process: bool = False,
) -> RunResult:
    folder = _new_folder(out_dir, f"{recording.stem}-{config.stem}")
    with progress_bar(f"replay {recording.name}") as step:
        request = RunRequest(config, tuple(overlays), tuple(sets))
        result = replay_into(folder, recording, request, step, single_process=single_process)
    _print_result(result)
    if view:
        _open_viewer(result.out_dir)
    return result


def _rerun(recording: Path, out_dir: Path | None, view: bool, trusted: bool) -> str:
    folder = _new_folder(out_dir, f"{recording.stem}-as-live")
    with progress_bar(f"replay {recording.name} as live") as step:
        rerun = rerun_into(folder, recording, step, trusted=trusted)
    _print_result(rerun.result)
    out.print(rerun.comparison)
    if view:
        _open_viewer(folder)
    if not rerun.same_hash:
        raise typer.Exit(EXIT_FAILED)
    return rerun.result.output_hash


def _new_folder(wanted: Path | None, name: str) -> Path:
    """The output folder: `wanted`, or a new one under out/. Raises LinkError instead of overwriting a run."""
    if wanted is not None:
        if (wanted / SUMMARY_FILE).exists():
            raise LinkError(f"{wanted} has a run already: name another --out, or remove it first.")
        return wanted
    folder = Path("out", name)
    number = 1
    while folder.exists():
        number += 1
        folder = Path("out", f"{name}-{number}")
    return folder


def _print_result(run: RunResult) -> None:
    """Print the fixes, a summary, and the paths of the output files."""
    results, report = run.results, run.report
    live = isinstance(report, LiveReport)
    for text in () if live else run.warnings:  # a live run has printed them already
        warn(text)
    if results.fixes:
        show_table(_fix_table(run))
    recorded_s = (report.last_ns - report.first_ns) / 1e9
    parts = f" in {run.parts} parts" if run.parts is not None and run.parts > 1 else ""
    found = f"drone accepted in {results.sweeps_with_drone} of {results.sweeps} sweeps, {len(results.fixes)} fixes"
    out.print(
        f"{report.records} records{parts}, {recorded_s:.1f} s recorded, {run.wall_s:.1f} s to run; "
        f"{'no stage searches for a drone' if run.stage_outputs else found}"
    )
    if run.stage_outputs:
        out.print(f"ran: {run.stage_outputs}", markup=False)
    elif not results.sweeps:
        out.print("no drone: no sweep was completed")
    elif not results.fixes:
        for result, count, example in results.search_results:
            out.print(f"in {count} of {results.sweeps} sweeps: {result.value}; the first: {example}", markup=False)
    for change in results.transitions[-3:]:
        name = f"track {change.track_id}" if change.track_id > 1 else "tracker"
        out.print(f"{name} at {stamp_s(change.stamp_ns)} s: {change.state}, {change.reason}", markup=False)
    if run.errors is not None and len(run.errors.stamps_ns):
        x, y, z = run.errors.rmse_xyz_m
        out.print(
            f"errors against the truth: RMSE x/y/z {x:.3f} {y:.3f} {z:.3f} m, 3D {run.errors.rmse_m:.3f} m; "
            f"truth inside the 95 % ellipsoid in {100 * run.errors.inside_95:.0f} % of fixes"
        )
    if results.pose_states:
        states = ", ".join(f"{count} {state}" for state, count in results.pose_states.items())
        out.print(f"fused poses: {states}; {results.resets} jumps")
    rejected = [
        f"{name}: {count} {reason}"
        for name, counters in report.counters.items()
        for reason, count in counters.rejected.items()
        if count
    ]
    if rejected:
        out.print(f"rejected: {'; '.join(rejected)}", markup=False)
    if run.usage is not None and str(run.usage):
        out.print(f"used: {run.usage}")
    out.print(f"output hash {run.output_hash}")
    if not run.stage_outputs:
        out.print(f"positions   {run.out_dir / FIX_FILE}")
    if results.pose_states:
        out.print(f"poses       {run.out_dir / POSE_FILE}")
    out.print(f"summary     {run.out_dir / SUMMARY_FILE}")
    if live and run.recording.is_file():
        out.print(f"flight      {run.recording}   (re-run: grd replay {run.recording} --as-live)")
    rerun_files = sorted(run.out_dir.glob("*.rrd"))
    for path in rerun_files:
        out.print(f"recording   {path}   (view: rerun {path})")


def _fix_table(run: RunResult) -> Table:
    """A table of at most TABLE_ROWS fixes, evenly spaced; with a column of errors when the truth is known."""
    fixes = run.results.fixes
    errors = {}
    if run.errors is not None:
        errors = dict(zip(run.errors.stamps_ns.tolist(), run.errors.error_m, strict=True))
    step = max(1, -(-len(fixes) // TABLE_ROWS))
    table = Table(title=f"drone in the vehicle frame, {len(fixes[::step])} of {len(fixes)} fixes", title_justify="left")
    heads = [
        "t [s]",
        "x forward [m]",
        "y left [m]",
        "z up [m]",
        "sigma [m]",
        "returns",
        *(["error [m]"] if errors else []),
    ]
    for head in heads:
        table.add_column(Text(head), justify="right")
    for fix in fixes[::step]:
        elapsed_s = (fix.stamp_ns - run.report.first_ns) / 1e9
        sigma_m = float(fix.covariance_m2.trace()) ** 0.5
        cells = [f"{elapsed_s:.2f}", *(f"{v:.2f}" for v in fix.xyz_vehicle_m), f"{sigma_m:.2f}", str(fix.hits)]
        if errors:
            error = errors.get(fix.stamp_ns)
            cells.append("-" if error is None else f"{float((error @ error) ** 0.5):.2f}")
        table.add_row(*cells)
    return table


def _open_viewer(out_dir: Path) -> None:
    from links.viewer import show

    files = sorted(out_dir.glob("*.rrd"))
    if not files:
        err.print("nothing to view: the configuration has no viewer (links.viewer.Viewer)")
        return
    show(files[0])
