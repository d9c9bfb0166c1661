"""What `grd run` and `grd replay` print at the end of a run.

Source: ours.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.table import Table
from rich.text import Text

from flow.graph import Graph
from flow.live.report import LiveReport
from links.cli.console import out, show_table, warn
from links.clock import Clock
from links.runs.fused_poses import FusedPoses, rms
from links.runs.request import RunResult
from links.runs.results import FIX_FILE, POSE_FILE, SUMMARY_FILE, Results, stamp_s
from links.zenoh import Receiver, Sender
from stages.messages import PoseState

TABLE_ROWS = 12


def print_result(run: RunResult) -> None:
    """Print the fixes, a summary, and the paths of the output files."""
    results, report = run.results, run.report
    live = isinstance(report, LiveReport)
    for text in () if live else run.warnings:  # a live run has printed them already
        warn(text)
    if run.poses is not None:
        show_table(_pose_table(run, run.poses))
    elif results.fixes:
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
    for text in truth_texts(run):
        out.print(text, markup=False)
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
    if run.output_hash is not None:
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
        out.print(f"recording   {path}   (view: grd view {path})")


def truth_texts(run: RunResult) -> list[str]:
    """Errors of the LiDAR positions and of the fused poses, and how long each state lasted."""
    texts: list[str] = []
    if run.errors is not None and len(run.errors.stamps_ns):
        x, y, z = run.errors.rmse_xyz_m
        texts.append(
            f"LiDAR positions, errors against the truth: RMSE x/y/z {x:.3f} {y:.3f} {z:.3f} m, 3D "
            f"{run.errors.rmse_m:.3f} m; inside the 95 % ellipsoid {100 * run.errors.inside_95:.0f} %"
        )
    if run.results.pose_states:
        states = ", ".join(f"{count} {state}" for state, count in run.results.pose_states.items())
        texts.append(f"fused poses: {states}; {run.results.resets} jumps; {_first_full(run)}")
        texts.append(_gate(run.results))
    if run.poses is not None and run.poses.has_truth:
        x, y, z = run.poses.rmse_xyz_m
        distance_m = run.poses.distance_m
        text = (
            f"fused poses, errors against the truth: RMSE x/y/z {x:.3f} {y:.3f} {z:.3f} m, 3D "
            f"{rms(distance_m):.3f} m, largest {np.nanmax(distance_m):.2f} m; "
            f"inside the 95 % ellipsoid {100 * run.poses.inside_95:.0f} %"
        )
        angle_deg = np.degrees(run.poses.angle_rad)
        if np.isfinite(angle_deg).any():
            text += f"; rotation RMSE {rms(angle_deg):.2f} deg, largest {np.nanmax(angle_deg):.2f} deg"
        texts.append(text)
    return texts


def _gate(results: Results) -> str:
    """How many poses the autopilot's gate accepts, and why it rejects the others."""
    total, rejected = sum(results.pose_states.values()), results.gate_rejections
    reasons = ", ".join(f"{count} {reason}" for reason, count in rejected.items())
    text = f"autopilot's gate (yaw: {results.settings.yaw}): accepts {total - sum(rejected.values())} of {total} poses"
    return f"{text}; rejects {reasons}" if reasons else text


def _first_full(run: RunResult) -> str:
    """When the whole pose was known for the first time, or why it never was."""
    if run.poses is not None and run.poses.full.any():
        first_ns = int(run.poses.stamps_ns[run.poses.full][0])
        return f"FULL after {(first_ns - run.report.first_ns) / 1e9:.1f} s"
    if run.counted_full:
        return f"FULL, but {POSE_FILE} is cut off: the time and the errors are not known; was the disk full?"
    return f"never FULL, at the end: {run.results.pose_reason}"


def _pose_table(run: RunResult, poses: FusedPoses) -> Table:
    """A table of at most TABLE_ROWS fused poses, evenly spaced; with columns of errors when the truth is known."""
    rows = range(0, len(poses.state), max(1, -(-len(poses.state) // TABLE_ROWS)))
    title = f"drone in the vehicle frame (forward, left, up), {len(rows)} of {len(poses.state)} fused poses"
    table = Table(title=title, title_justify="left")
    table.add_column("state")
    heads = ["t [s]", "x [m]", "y [m]", "z [m]", "yaw [deg]", "sigma [m]", "sigma [deg]"]
    for head in [*heads, *(["error [m]", "error [deg]"] if poses.has_truth else [])]:
        table.add_column(Text(head), justify="right")
    degrees = np.degrees([poses.yaw_rad, poses.sigma_rad, poses.angle_rad])
    for row in rows:
        elapsed_s = (int(poses.stamps_ns[row]) - run.report.first_ns) / 1e9
        cells = [f"{elapsed_s:.2f}", *(f"{v:.2f}" for v in poses.xyz_m[row]), _number(degrees[0, row], 1)]
        cells += [f"{poses.sigma_m[row]:.2f}", _number(degrees[1, row], 2)]
        if poses.has_truth:
            cells += [_number(poses.distance_m[row], 2), _number(degrees[2, row], 2)]
        table.add_row(str(poses.state[row]), *cells)
    return table


def _number(value: float, digits: int) -> str:
    return "-" if np.isnan(value) else f"{value:.{digits}f}"


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


def nothing_found(graph: Graph, result: RunResult, report: LiveReport, config: Path) -> list[str]:
    """Why a live run was of no use, and what to do; empty when it found a drone, or searched for none."""
    sensors = [name for name in report.links if not issubclass(graph.nodes[name].cls, (Clock, Receiver, Sender))]
    silent = [name for name in sensors if not report.links[name].records]
    searched = not result.stage_outputs
    found = result.results.fixes or result.results.pose_states.keys() - {PoseState.LOST.name}
    if not (sensors and silent == sensors) and (not searched or found):
        return []
    head = "no sensor sent anything" if silent == sensors else "no drone was found: no position was measured"
    why = {name: report.statuses.get(name) or report.links[name].reason or "no record came" for name in silent}
    reasons = [f"  {name}: {text}" for name, text in why.items()]
    return [f"{head}; the sources without a record:" if silent else head, *reasons, f"check: grd preflight {config}"]
