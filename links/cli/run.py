"""`grd run` and `grd replay`: a graph over a recording, into a folder with everything people look at afterwards.

Source: DESIGN, Command line and Outputs of a run.
"""

from __future__ import annotations

import json
import time
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer
import yaml
from rich.table import Table
from rich.text import Text

from flow.draw import mermaid
from flow.graph import Graph, load_graph, recording_named
from flow.link import LinkError, Run, Tap
from flow.problem import Place
from flow.replay import RunReport, replay
from flow.taps import Digest
from flow.tree import Section
from links.cli.console import err, in_words, out, progress_bar, warn
from links.recording import RecordingReader
from links.results import FIX_FILE, SUMMARY_FILE, Results, stamp_s
from links.truth import FixErrors, TruthLog

CONFIG_FILE = "config.yaml"
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
    config: Annotated[Path, typer.Argument(help="Configuration; its `replay:` names the recording.")],
    out_dir: Out = None,
    overlay: Overlay = None,
    sets: Sets = None,
    view: View = False,
) -> None:
    """Run what CONFIG says.

    Example: grd run configs/quickstart.yaml --set track.radius_m=0.8
    """
    recording = recording_named(config, overlay or (), sets or ())
    if recording is None:
        raise LinkError(
            f"{config} names no recording ('replay: FILE.mcap'), so it would run live; live runs are not built yet."
            f" Replay a recording with it: grd replay FILE.mcap --config {config}"
        )
    _run(recording, config, out_dir, overlay or [], sets or [], view)


@in_words
def replay_recording(
    recording: Annotated[Path, typer.Argument(help="A .mcap recording (`grd import` makes one of a .pcap or .tlog).")],
    config: Annotated[
        Path | None, typer.Option("--config", help="Configuration [default: configs/replay.yaml].")
    ] = None,
    out_dir: Out = None,
    overlay: Overlay = None,
    sets: Sets = None,
    view: View = False,
) -> None:
    """Replay RECORDING: deterministic, as fast as possible.

    Example: grd replay recordings/street_sweep.mcap --out out/mine
    """
    _run(recording, config or DEFAULT_REPLAY_CONFIG, out_dir, overlay or [], sets or [], view)


@dataclass(frozen=True, slots=True)
class Finished:
    """A run that is done, for telling about it."""

    recording: Path
    out_dir: Path
    report: RunReport
    results: Results
    errors: FixErrors | None
    digest: str
    wall_s: float
    warnings: list[str]
    graph: Graph


def _run(
    recording: Path, config: Path, out_dir: Path | None, overlays: list[Path], sets: list[str], view: bool
) -> None:
    begin = time.monotonic()
    with RecordingReader(recording) as reader:
        graph = load_graph(config, overlays, sets, _own_rig(recording, reader.rig_yaml))
        folder = _new_folder(out_dir, f"{recording.stem}-{config.stem}")
        finished = _replay(graph, reader, recording, folder, begin)
    _write_summary(finished, config, overlays, sets)
    _tell(finished)
    if view:
        _open_viewer(finished.out_dir)


def _own_rig(recording: Path, rig_yaml: str | None) -> dict[str, Section] | None:
    if rig_yaml is None:
        return None
    place = Place(f"{recording} (rig.yaml)", 0)
    try:
        return {"rig": (yaml.safe_load(rig_yaml), place)}
    except yaml.YAMLError as error:
        raise LinkError(f"{place} is not YAML: {str(error).splitlines()[0]}") from None


def _new_folder(wanted: Path | None, name: str) -> Path:
    """The folder for the results; an earlier run is never overwritten."""
    if wanted is not None:
        if (wanted / SUMMARY_FILE).exists():
            raise LinkError(f"{wanted} holds a run already: name another --out, or remove it first.")
        folder = wanted
    else:
        folder = Path("out", name)
        number = 1
        while folder.exists():
            number += 1
            folder = Path("out", f"{name}-{number}")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _replay(graph: Graph, reader: RecordingReader, recording: Path, folder: Path, begin: float) -> Finished:
    truth, digest, results = TruthLog(), Digest(), Results()
    extra = [spec.build() for spec in graph.nodes.values() if issubclass(spec.cls, Tap)]
    taps: list[Tap] = [digest, results, *(tap for tap in extra if isinstance(tap, Tap))]
    about = Run(folder, f"{recording.stem}", mermaid(graph), graph.settings_yaml())
    (folder / CONFIG_FILE).write_text(about.settings_yaml, encoding="utf-8")
    with ExitStack() as stack, progress_bar(f"replay {recording.name}") as step:
        for tap in taps:
            tap.open(about)
            stack.callback(tap.close)
        report = replay(graph, truth.aside(reader.records(progress=step)), taps)
        warnings = [*reader.warnings, *_remarks(graph, report)]
        for text in (*warnings, f"output hash {digest.hexdigest()}"):
            results.note(text)
    truth.write(folder)
    errors = truth.errors_of(results.fixes)
    wall_s = time.monotonic() - begin
    return Finished(recording, folder, report, results, errors, digest.hexdigest(), wall_s, warnings, graph)


def _remarks(graph: Graph, report: RunReport) -> list[str]:
    """What the run did not use, so that a silent port is not taken for a quiet sensor."""
    remarks = [f"{count} records on {topic} are wired to nothing" for topic, count in report.unwired_topics.items()]
    silent = [spec.name for spec in graph.nodes.values() if spec.kind == "links" and report.nodes[spec.name].calls == 0]
    sources = {edge.producer for edge in graph.edges}
    remarks += [f"the recording holds nothing for '{name}'" for name in silent if name in sources]
    return remarks


def _write_summary(run: Finished, config: Path, overlays: list[Path], sets: list[str]) -> None:
    report, results = run.report, run.results
    summary: dict[str, Any] = {
        "grd": version("grd"),
        "recording": run.recording.name,
        "config": config.name,
        "overlays": [path.name for path in overlays],
        "set": sets,
        "output_hash": run.digest,
        "records": report.records,
        "start_s": stamp_s(report.first_ns),
        "end_s": stamp_s(report.last_ns),
        "recorded_s": (report.last_ns - report.first_ns) / 1e9,
        "messages": report.messages,
        "sweeps": results.sweeps,
        "sweeps_with_drone": results.sweeps_with_drone,
        "verdicts": [{"sweeps": count, "example": verdict} for verdict, count in results.verdicts],
        "fixes": len(results.fixes),
        "states": [
            {"stamp_s": stamp_s(t.stamp_ns), "track_id": t.track_id, "state": t.state, "reason": t.reason}
            for t in results.transitions
        ],
        "warnings": run.warnings,
        "wall_s": round(run.wall_s, 3),
        "compute_ms": {
            name: {
                "calls": node.calls,
                "p50": round(node.compute.percentile_ns(50) / 1e6, 4),
                "p99": round(node.compute.percentile_ns(99) / 1e6, 4),
                "max": round(node.compute.max_ns / 1e6, 4),
                "total": round(node.compute.total_ns / 1e6, 1),
            }
            for name, node in report.nodes.items()
        },
    }
    if run.errors is not None:
        summary["against_truth"] = _judged(run.errors)
    (run.out_dir / SUMMARY_FILE).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


def _judged(errors: FixErrors) -> dict[str, Any]:
    if not len(errors.stamps_ns):
        return {"fixes": 0, "fixes_without_truth": errors.not_covered}
    return {
        "fixes": len(errors.stamps_ns),
        "fixes_without_truth": errors.not_covered,
        "rmse_xyz_m": [round(float(v), 4) for v in errors.rmse_xyz_m],
        "rmse_3d_m": round(errors.rmse_m, 4),
        "mean_nees_of_3": round(float(errors.nees.mean()), 3),
        "inside_95_percent_ellipsoid": round(errors.inside_95, 4),
    }


def _tell(run: Finished) -> None:
    """The positions, the answer in a sentence, and where to look."""
    for text in run.warnings:
        warn(text)
    results, report = run.results, run.report
    if results.fixes:
        out.print(_table(run))
    recorded_s = (report.last_ns - report.first_ns) / 1e9
    out.print(
        f"{report.records} records, {recorded_s:.1f} s recorded, {run.wall_s:.1f} s to run; "
        f"drone accepted in {results.sweeps_with_drone} of {results.sweeps} sweeps, {len(results.fixes)} fixes"
    )
    if not results.sweeps:
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
    out.print(f"output hash {run.digest}")
    out.print(f"positions   {run.out_dir / FIX_FILE}")
    out.print(f"summary     {run.out_dir / SUMMARY_FILE}")
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
