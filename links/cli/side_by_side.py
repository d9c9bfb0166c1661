"""Two runs next to each other: what `grd run CONFIG --against OTHER` prints at its end.

Source: ours.
"""

from __future__ import annotations

import numpy as np
from rich.table import Table
from rich.text import Text

from links.runs.fused_poses import rms
from links.runs.request import RunResult

NEAR_M = 1.0  # a position farther from the drone is false, as in `grd evaluate`


def side_by_side(runs: list[tuple[str, RunResult]]) -> Table:
    """A row per figure, a column per run with its name; `-` where a run has no truth for a figure."""
    columns = [_figures(run) for _, run in runs]
    table = Table(title="side by side", title_justify="left")
    table.add_column("")
    for name, _ in runs:
        table.add_column(Text(name), justify="right")
    for key in dict.fromkeys(key for column in columns for key in column):
        table.add_row(Text(key), *(column.get(key, "-") for column in columns))
    return table


def _figures(run: RunResult) -> dict[str, str]:
    fixes, poses, start_ns = run.errors, run.poses, run.report.first_ns
    figures = {
        "recording": run.recording.stem,
        "recorded [s]": f"{(run.report.last_ns - start_ns) / 1e9:.1f}",
        "LiDAR positions": str(len(run.results.fixes)),
    }
    if fixes is not None:
        distance_m = np.linalg.norm(fixes.error_m, axis=1)
        near = distance_m <= NEAR_M
        first_s = (fixes.stamps_ns[near][0] - start_ns) / 1e9 if near.any() else np.nan
        figures |= {
            f"of these within {NEAR_M:g} m of the drone": str(int(near.sum())),
            "the first of these after [s]": _shown(first_s, "never", 1),
            "their 3D RMSE [m]": _shown(rms(distance_m[near])),
        }
    full = poses is not None and poses.full.any()
    first_full_s = (poses.stamps_ns[poses.full][0] - start_ns) / 1e9 if poses is not None and full else np.nan
    none = "-" if run.counted_full else "never"  # the files were cut off
    figures["whole pose (FULL) after [s]"] = _shown(first_full_s, none, 1)
    figures["its 3D RMSE [m]"] = _shown(rms(poses.distance_m[poses.full]) if poses is not None else np.nan)
    angle_deg = np.degrees(rms(poses.angle_rad[poses.full])) if poses is not None else np.nan
    figures["its rotation RMSE [deg]"] = _shown(angle_deg, digits=2)
    return figures


def _shown(value: float, none: str = "-", digits: int = 3) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else none
