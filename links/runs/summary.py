"""`summary.json` of a run: its configuration, counts, states, computing times and errors against the truth.

Source: ours.
"""

from __future__ import annotations

import resource
from dataclasses import asdict
from typing import Any

import numpy as np

from flow.config.secrets import without_secrets
from flow.live.report import LiveReport
from links import __version__
from links.runs.fused_poses import FusedPoses, rms
from links.runs.request import RunRequest, RunResult
from links.runs.results import stamp_s
from links.runs.truth import FixErrors
from links.runs.usage import Usage


def summary(run: RunResult, request: RunRequest) -> dict[str, Any]:
    """The values of `summary.json`, in the order of the file."""
    report, results = run.report, run.results
    values: dict[str, Any] = {
        "grd": __version__,
        "recording": run.recording.name,
        **({"parts": run.parts} if run.parts is not None and run.parts > 1 else {}),
        "config": request.config.name,
        "overlays": [path.name for path in request.overlays],
        "set": [without_secrets(text) for text in request.sets],
        "output_hash": run.output_hash,
        "records": report.records,
        "start_s": stamp_s(report.first_ns),
        "end_s": stamp_s(report.last_ns),
        "recorded_s": (report.last_ns - report.first_ns) / 1e9,
        "messages": report.messages,
        "sweeps": results.sweeps,
        "sweeps_with_drone": results.sweeps_with_drone,
        "search_results": [
            {"result": result.value, "sweeps": count, "example": example}
            for result, count, example in results.search_results
        ],
        "fixes": len(results.fixes),
        "poses": {
            "states": results.pose_states,
            "resets": results.resets,
            "gate": {"yaw": results.settings.yaw, "rejected": results.gate_rejections},
        },
        "states": [
            {"stamp_s": stamp_s(t.stamp_ns), "track_id": t.track_id, "state": t.state, "reason": t.reason}
            for t in results.transitions
        ],
        "warnings": run.warnings,
        "counters": {name: dict(counters) for name, counters in report.counters.items()},
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
    if isinstance(report, LiveReport):
        values["live"] = _live_values(report, run.usage) | ({} if run.usage is None else {"usage": run.usage.columns})
    if run.errors is not None:
        values["truth_errors"] = _truth_errors(run.errors)
    if run.poses is not None and run.poses.has_truth:
        values["pose_errors"] = _pose_errors(run.poses)
    return values


def _live_values(report: LiveReport, usage: Usage | None) -> dict[str, Any]:
    """Values of a live run only: resources, lag and drops of each edge, states of the links, failures."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    subprocesses_s = 0.0 if usage is None else usage.subprocesses_cpu_s
    edges = {name: {key: _rounded(value) for key, value in asdict(edge).items()} for name, edge in report.edges.items()}
    return {
        "cpu_s": round(used.ru_utime + used.ru_stime + subprocesses_s, 2),
        "max_rss_mb": round(used.ru_maxrss / 1024, 1),  # of this process only; kB on Linux
        "dropped": report.dropped,
        "missed_deadlines": report.missed,
        "edges": edges,
        "links": {name: asdict(link) | {"state": link.state.value} for name, link in report.links.items()},
        "restarts": report.restarts,
        "failures": report.failures,
        "switched_off": report.switched_off,
        "tap_drops": report.tap_drops,
        "events": [
            {
                "first_s": stamp_s(event.first_ns),
                "last_s": stamp_s(event.last_ns),
                "count": event.count,
                "text": f"{event.node}: {event.text}",
            }
            for event in report.events
        ],
    }


def _rounded(value: Any) -> Any:
    return round(value, 3) if isinstance(value, float) else value


def _truth_errors(errors: FixErrors) -> dict[str, Any]:
    if not len(errors.stamps_ns):
        return {"fixes": 0, "fixes_without_truth": errors.without_truth}
    return {
        "fixes": len(errors.stamps_ns),
        "fixes_without_truth": errors.without_truth,
        "rmse_xyz_m": [round(float(v), 4) for v in errors.rmse_xyz_m],
        "rmse_3d_m": round(errors.rmse_m, 4),
        "mean_nees_of_3": round(float(errors.nees.mean()), 3),
        "inside_95_percent_ellipsoid": round(errors.inside_95, 4),
    }


def _pose_errors(poses: FusedPoses) -> dict[str, Any]:
    """Errors of all fused poses with truth; of the rotation where it is known."""
    angle_deg = np.degrees(poses.angle_rad[np.isfinite(poses.angle_rad)])
    return {
        "poses": int(np.isfinite(poses.distance_m).sum()),
        "rmse_xyz_m": [round(float(v), 4) for v in poses.rmse_xyz_m],
        "max_m": round(float(np.nanmax(poses.distance_m)), 4),
        "rotations": len(angle_deg),
        "rmse_deg": round(rms(angle_deg), 4) if len(angle_deg) else None,
        "max_deg": round(float(angle_deg.max()), 4) if len(angle_deg) else None,
        "inside_95_percent_ellipsoid": round(poses.inside_95, 4),
    }
