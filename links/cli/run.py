"""`grd run` and `grd replay`: run a graph live or over a recording, into an output folder.

Source: ours.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flow.graph import recording_named
from flow.jobs import Workers
from flow.link import LinkError
from flow.live.report import LiveReport
from links.cli.console import EXIT_FAILED, err, out, progress_bar, report_errors, show_table, warn
from links.cli.live_view import LiveView
from links.cli.options import Config, HostName, HostsFile, Jobs, Out, Overlay, Scheduler, Sets, View, place_of
from links.cli.run_output import nothing_found, print_result
from links.cli.side_by_side import side_by_side
from links.preflight.shipped_values import shipped_values
from links.runs.as_live import rerun_into
from links.runs.live_run import live_graph, run_live
from links.runs.output_hashes import hash_matches
from links.runs.request import RunRequest, RunResult, fitting_request
from links.runs.results import SUMMARY_FILE
from links.runs.run_folder import replay_all, replay_into
from links.runs.shipped import shipped_all, shipped_option
from links.runs.warm_up import warm_up, warm_up_graph
from links.zenoh import host_graph

ReplayConfig = Annotated[
    Path | None,
    typer.Option(
        "--config",
        callback=shipped_option,
        help="Configuration [default: configs/vision.yaml if the rig in RECORDING has cameras, otherwise "
        "configs/estimate.yaml].",
    ),
]
AsLive = Annotated[
    bool,
    typer.Option(
        "--as-live",
        help="Recording of a live run: re-run it with its own configuration, input order and drops, "
        "and compare the output hash.",
    ),
]
Trust = Annotated[
    bool,
    typer.Option(
        "--trust",
        help="With --as-live: the recording is your own, so import its own stages and run its taps.",
    ),
]
Hashed = Annotated[
    bool, typer.Option("--hash/--no-hash", help="Compute the output hash, an eighth of the time without cameras.")
]
Expect = Annotated[
    str | None, typer.Option("--expect", metavar="HASH", help="Exit code 1 unless the output hash is this one.")
]
SingleProcess = Annotated[
    bool,
    typer.Option(
        "--single-process",
        help="Run in one process, even if the configuration places stages in subprocesses. The results are the same.",
    ),
]


@report_errors
def run(
    config: Config,
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
    hashed: Annotated[
        bool,
        typer.Option("--hash", help="Live: compute the output hash, so that grd replay --as-live can compare it."),
    ] = False,
    hosts: HostsFile = None,
    host: HostName = None,
    against: Annotated[
        Path | None,
        typer.Option(
            "--against",
            metavar="CONFIG",
            callback=shipped_option,
            help="Then run this configuration, on its own recording or else on the same one, and print both runs "
            "side by side. --overlay and --set apply to the first CONFIG alone.",
        ),
    ] = None,
    view: View = False,
) -> None:
    """Run CONFIG live, or over the recording that its `replay:` names.

    A live run is recorded (`links.recording.Recorder`); Ctrl-C or SIGTERM ends it. Exit code 1 when a stage stopped
    the run; live also when a stage was switched off after repeated errors, no sensor sent anything, or no drone was
    found; of a recording also when none of its records was decoded.

    Example: grd run configs/quickstart.yaml --against configs/quickstart_paper.yaml
    """
    if config.suffix == ".mcap":
        raise LinkError(f"{config} is a recording: grd replay {config}")
    recording = recording_named(config, overlay or (), sets or ())
    request = RunRequest(config, tuple(overlay or ()), tuple(sets or ()))
    place = place_of(hosts, host)
    if recording is not None:
        if for_s is not None or place is not None:
            option = "--for" if for_s is not None else "--hosts"
            raise LinkError(f"{option} is for live runs, and {config} replays {recording.name}: leave it out")
        result = _run(recording, request, out_dir, view)
        if against is not None:
            other = _run_against(against, recording, out_dir)
            show_table(side_by_side([(config.stem, result), (against.stem, other)]))
        return
    if against is not None:
        raise LinkError(f"--against is for a configuration that replays a recording, and {config} runs live")
    _run_live(request, _new_folder(out_dir, f"live-{config.stem}"), for_s, warm, hashed, place, view)


@report_errors
def replay_recording(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORDING...",
            callback=shipped_all,
            help="A .mcap recording (`grd import` converts a .pcap or .tlog), or several.",
        ),
    ],
    config: ReplayConfig = None,
    out_dir: Out = None,
    overlay: Overlay = None,
    sets: Sets = None,
    as_live: AsLive = False,
    trust: Trust = False,
    single_process: SingleProcess = False,
    hashed: Hashed = True,
    expect: Expect = None,
    view: View = False,
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
) -> None:
    """Replay RECORDING, deterministic and as fast as possible.

    Several recordings are replayed into folders of --out [default: out], on --jobs processes or the workers of
    --scheduler; complete runs with the same settings are kept. Exit code 1 when a stage failed, or when no record was
    decoded.

    The first part of a split recording stands for all parts; a later part is replayed alone. --expect takes a whole
    output hash or its first 16 digits: those cover the values, the rest covers the reason texts. With --as-live each
    stage gets the inputs of the live run in the same order; exit code 1 when the hash differs from that of the run.
    The configuration in a recording is data: it may use the stages and links of grd only, and writes to --out only.

    Example: grd replay recordings/experiment_3.mcap --out out/mine
    """
    if not hashed and (as_live or expect is not None):
        raise LinkError("--no-hash: --as-live and --expect compare the output hash, leave one of them out")
    if len(recordings) > 1 or scheduler is not None:
        if as_live or expect is not None or view:
            raise LinkError("--as-live, --expect and --view are for one recording: leave them out")
        requests = [_request(recording, config, overlay, sets) for recording in recordings]
        _replay_all(recordings, requests, out_dir or Path("out"), scheduler or jobs, single_process, hashed)
        return
    recording = recordings[0]
    if as_live:
        if config or overlay or sets:
            raise LinkError(
                "--as-live takes the recording's own configuration: leave out --config, --overlay and --set"
            )
        output_hash = _rerun(recording, out_dir, view, trust)
    else:
        request = _request(recording, config, overlay, sets)
        result = _run(recording, request, out_dir, view, single_process, hashed)
        output_hash = result.output_hash
    if expect is not None and output_hash is not None and not hash_matches(expect, output_hash):
        err.print(f"the output hash is {output_hash}, expected {expect}", markup=False, style="red")
        raise typer.Exit(EXIT_FAILED)


def _request(recording: Path, config: Path | None, overlays: list[Path] | None, sets: list[str] | None) -> RunRequest:
    """The request for a recording; `config` None: the configuration that fits it."""
    changes = tuple(overlays or ()), tuple(sets or ())
    return fitting_request(recording, *changes) if config is None else RunRequest(config, *changes)


def _replay_all(
    recordings: list[Path],
    requests: list[RunRequest],
    out_dir: Path,
    workers: Workers,
    single_process: bool,
    hashed: bool,
) -> None:
    with progress_bar(f"replay {len(recordings)} recordings") as step:
        outcomes = replay_all(
            recordings, requests, out_dir, workers, step, single_process=single_process, hashed=hashed
        )
    for outcome in outcomes:
        (err if outcome.failure else out).print(str(outcome), markup=False, style="red" if outcome.failure else "")
    if any(outcome.failure for outcome in outcomes):
        raise typer.Exit(EXIT_FAILED)


def _run_live(
    request: RunRequest,
    folder: Path,
    for_s: float | None,
    warm: bool,
    hashed: bool,
    place: tuple[Path, str] | None,
    view: bool,
) -> None:
    """Run live; `place`: the file of hosts and the name of this one."""
    err.print(f"loading {request.config}", markup=False)
    graph = live_graph(request)
    if parts := sorted(folder.glob("*.mcap")):
        raise LinkError(
            f"{folder} has the recording of an interrupted run already ({parts[0].name}): "
            "name another --out, or move it"
        )
    if place is not None:
        graph = host_graph(graph, *place, to_run=True)
    for text in (*graph.left_out_texts(), *shipped_values(graph)):
        warn(text)
    if warm:
        with progress_bar("loading compiled code (some minutes when it must be compiled)", at_once=True) as step:
            not_warm = warm_up(warm_up_graph(graph, request), step)
        if not_warm:
            warn(not_warm)
    with LiveView() as view_of_run:
        result = run_live(folder, request, graph, view_of_run.show, for_s, (view_of_run.latest,), hashed=hashed)
    print_result(result)
    if view:
        _open_viewer(result.out_dir)
    report = result.report
    if isinstance(report, LiveReport) and report.switched_off:
        err.print(f"'{report.switched_off[0]}' was switched off after repeated errors", markup=False, style="red")
        raise typer.Exit(EXIT_FAILED)
    if isinstance(report, LiveReport) and (texts := nothing_found(graph, result, report, request.config)):
        for text in texts:
            err.print(text, markup=False, style="red")
        raise typer.Exit(EXIT_FAILED)


def _run(
    recording: Path,
    request: RunRequest,
    out_dir: Path | None,
    view: bool,
    single_process: bool = False,
    hashed: bool = True,
) -> RunResult:
    folder = _new_folder(out_dir, f"{recording.stem}-{request.config.stem}")
    with progress_bar(f"replay {recording.name}") as step:
        result = replay_into(folder, recording, request, step, single_process=single_process, hashed=hashed)
    print_result(result)
    if view:
        _open_viewer(result.out_dir)
    return result


def _run_against(config: Path, recording: Path, out_dir: Path | None) -> RunResult:
    """Run another configuration on the recording that it names, or else on this one."""
    own = recording_named(config, (), ())
    folder = None if out_dir is None else out_dir.with_name(f"{out_dir.name}-{config.stem}")
    return _run(own or recording, RunRequest(config), folder, False)


def _rerun(recording: Path, out_dir: Path | None, view: bool, trusted: bool) -> str | None:
    folder = _new_folder(out_dir, f"{recording.stem}-as-live")
    with progress_bar(f"replay {recording.name} as live") as step:
        rerun = rerun_into(folder, recording, step, trusted=trusted)
    print_result(rerun.result)
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


def _open_viewer(out_dir: Path) -> None:
    from links.viewer import show

    files = sorted(out_dir.glob("*.rrd"))
    if not files:
        err.print("nothing to view: the configuration has no viewer (links.viewer.Viewer)")
        return
    show(files[0])
