"""The catalogue of metrics, and `evaluate`, which computes all of them for one output of one run.

Source: DESIGN, evaluate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto

from links.evaluation import pose_metrics, stage_metrics, track_metrics
from links.evaluation.association import EvaluationInput, EvaluationLimits
from links.evaluation.errors import GRID_NS, held_errors, output_errors, time_span
from links.evaluation.evaluation import NO_SPAN, Evaluation, Value
from links.evaluation.pose_metrics import BANDS_M, band_key, band_name
from links.evaluation.run_data import RunData, RunTrajectory
from links.evaluation.stage_metrics import MODULO_90, PUBLISHED


class Better(Enum):
    """Which values of a metric are better."""

    LOW = auto()
    HIGH = auto()
    NEITHER = auto()  # it has an ideal value, or false outputs count in it, too


@dataclass(frozen=True, slots=True)
class Metric:
    """A metric of the catalogue."""

    key: str
    name: str
    unit: str
    better: Better
    group: str = ""

    @property
    def title(self) -> str:
        """`RMSE x [m]`."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


LOW, HIGH, NEITHER = Better.LOW, Better.HIGH, Better.NEITHER
CAMERAS = "rotation by both cameras"
Row = tuple[str, str, str, Better]  # key, name, unit
Compute = Callable[[Evaluation], Value | None]  # stores values of metrics; returns why the other ones are missing


def _angles(prefix: str, name: str) -> list[Row]:
    rows = ("rmse", "RMSE"), ("median", "median"), ("p95", "95 %")
    axes = ((f"rmse_{axis}", f"RMSE {axis}") for axis in ("roll", "pitch", "yaw"))
    return [(f"{prefix}_{key}_deg", f"{name}: {text}", "deg", LOW) for key, text in (*rows, *axes)]


SECTIONS: dict[str, dict[Compute, list[Row]]] = {
    "over all time": {
        pose_metrics.track_accuracy: [
            ("track_accuracy", "track accuracy, recall (time with an output within 1 m)", "%", HIGH),
            ("availability", "time with an output", "%", NEITHER),
            ("held_rmse_m", "3D RMSE, last output held", "m", LOW),
            ("held_p95_m", "3D 95 %, last output held", "m", LOW),
            ("held_max_m", "3D max, last output held", "m", LOW),
            ("before_first_s", "time before any output", "s", NEITHER),
            ("first_accurate_s", "time to the first accurate output", "s", LOW),
            ("longest_inaccurate_s", "longest time without an accurate output", "s", LOW),
        ],
        track_metrics.gospa: [
            ("precision", "precision (current outputs within 1 m)", "%", HIGH),
            ("gospa_m", "mean GOSPA, p = 2, cut-off 1 m", "m", LOW),
        ],
        pose_metrics.timing: [
            ("first_output_s", "time to the first output", "s", NEITHER),
            ("longest_gap_s", "longest gap between outputs", "s", NEITHER),
            ("rate_hz", "output rate", "Hz", NEITHER),
        ],
    },
    "position error of the outputs": {
        pose_metrics.position_error: [
            ("rmse_x_m", "RMSE x", "m", LOW),
            ("rmse_y_m", "RMSE y", "m", LOW),
            ("rmse_z_m", "RMSE z", "m", LOW),
            ("rmse_m", "3D RMSE", "m", LOW),
            ("median_m", "3D median", "m", LOW),
            ("p95_m", "3D 95 %", "m", LOW),
            ("max_m", "3D max", "m", LOW),
            ("evo_ape_rmse_m", "evo APE, RMSE", "m", LOW),
            ("evo_rpe_rmse_m", "evo RPE to the next output, RMSE", "m", LOW),
            ("evo_rpe_max_m", "evo RPE to the next output, max", "m", LOW),
        ],
    },
    "by true range": {
        pose_metrics.error_by_range: [
            row
            for low, high in BANDS_M
            for row in (
                (band_key("rmse_m", low), f"{band_name(low, high)}: 3D RMSE", "m", LOW),
                (band_key("track_accuracy", low), f"{band_name(low, high)}: track accuracy", "%", HIGH),
            )
        ],
    },
    "track continuity": {
        track_metrics.track_continuity: [
            ("track_losses", "track losses in sight", "", LOW),
            ("reacquisition_s", "longest time to reacquire after an occlusion", "s", LOW),
            ("longest_return_gap_s", "longest gap between returns, while tracked", "s", LOW),
            ("longest_return_gap_total_s", "longest gap between returns, all time", "s", LOW),
        ],
        track_metrics.identity_switches: [
            ("identity_switches", "identity switches to another drone", "", LOW),
        ],
    },
    "false outputs": {
        track_metrics.false_outputs: [
            ("false_outputs", "false outputs", "", LOW),
            ("false_per_min", "false outputs", "/min", LOW),
            ("overconfident_false_outputs", "overconfident false outputs (beyond 3 of their sigmas)", "", LOW),
            ("false_share", "outputs off by more than 1 m", "%", LOW),
        ],
        track_metrics.false_tracks: [
            ("false_tracks", "tracks of false outputs", "", LOW),
            ("false_tracks_per_h", "tracks of false outputs", "/h", LOW),
            ("false_tracks_below_per_h", "tracks of false outputs, 95 % upper bound", "/h", LOW),
        ],
    },
    "without a drone": {
        track_metrics.false_alarms: [
            ("false_alarms_per_h", "false alarms", "/h", LOW),
        ],
    },
    "searches": {
        stage_metrics.searches: [
            ("detection_rate", "detection rate (of the time searched)", "%", HIGH),
            ("observable_detection_rate", "detection rate in searches with 4+ returns", "%", HIGH),
            ("missed_searches", "missed searches with 4+ returns", "", LOW),
            ("return_share", "time of searches with a return of the drone", "%", NEITHER),
            ("observable_share", "time of searches with 4+ returns", "%", NEITHER),
            ("false_detections_per_min", "false detections", "/min", LOW),
        ],
    },
    "poses that the autopilot gate accepts": {
        track_metrics.autopilot_gate: [
            ("sendable_share", "time with an accepted pose", "%", HIGH),
            ("sendable_rmse_m", "3D RMSE of accepted poses", "m", LOW),
            ("sendable_max_m", "largest error of accepted poses", "m", LOW),
            ("sendable_max_deg", "largest rotation error of accepted poses", "deg", LOW),
            ("sendable_false", "accepted poses off by more than 1 m", "", LOW),
        ],
    },
    "rotation of the pose": {
        pose_metrics.pose_rotation: [
            ("rmse_roll_deg", "RMSE roll", "deg", LOW),
            ("rmse_pitch_deg", "RMSE pitch", "deg", LOW),
            ("rmse_yaw_deg", "RMSE yaw", "deg", LOW),
            ("rmse_angle_deg", "RMSE of the whole angle", "deg", LOW),
            ("wrong_yaw_branch_s", "time with a wrong yaw branch in valid outputs", "s", LOW),
        ],
    },
    CAMERAS: {
        stage_metrics.camera_rotation: [
            ("rotation_images", "images of the drone's camera", "", NEITHER),
            ("rotation_accepted_share", "images with a rotation", "%", HIGH),
            *_angles(PUBLISHED, "published branch"),
            *_angles(MODULO_90, "modulo 90 deg"),
            ("rotation_inside_95_share", "modulo 90 deg, in the 95 % bound (ideal: 95)", "%", NEITHER),
            ("rotation_nees_per_dof", "modulo 90 deg, mean NEES / 3 (ideal: 1)", "", NEITHER),
            ("rotation_resolved", "RESOLVED rotations", "", NEITHER),
            ("rotation_wrong_resolved", "wrong RESOLVED rotations (> 45 deg off)", "", LOW),
            ("rotation_resolved_s", "time to the first RESOLVED", "s", LOW),
            ("rotation_resolved_m", "path to it, relative to the vehicle", "m", LOW),
            ("rotation_resolved_ground_m", "path to it, over ground", "m", LOW),
            ("rotation_switches", "changes of the yaw branch", "", LOW),
        ],
    },
    "consistency of the covariance": {
        pose_metrics.covariance_consistency: [
            ("nees_mean", "mean NEES, position (ideal: 3)", "", NEITHER),
            ("inside_95_share", "in the 95 % ellipsoid (ideal: 95)", "%", NEITHER),
            ("pose_nees_mean", "mean NEES, pose (ideal: 6)", "", NEITHER),
        ],
    },
}
CATALOGUE = {
    row[0]: Metric(*row, group) for group, parts in SECTIONS.items() for rows in parts.values() for row in rows
}
COMPUTE_NAMES = {"p50": "p50 of a call", "p99": "p99 of a call", "load": "share of one core"}


def metric_of(key: str) -> Metric:
    """The metric of a key of the catalogue or of the compute time of a stage."""
    if key in CATALOGUE:
        return CATALOGUE[key]
    stage, what = key.removeprefix("compute_").rsplit("_", 1)
    return Metric(key, f"{stage}: {COMPUTE_NAMES[what]}", "%" if what == "load" else "ms", NEITHER, "compute time")


def rank(value: Value | None, better: Better) -> float:
    """The value of a metric; the worst there is for a failure; NaN for any other missing value."""
    if value is not None and value.failed:
        return -math.inf if better is HIGH else math.inf
    return math.nan if value is None or value.value is None else value.value


def evaluate(run: RunData, output: RunTrajectory, limits: EvaluationLimits | None = None) -> Evaluation:
    """Evaluate an output of a run: every metric has a value or a reason afterwards."""
    span_ns, source = time_span(run)
    e = Evaluation(run, output, limits or EvaluationLimits(), span_ns)
    if span_ns is None:
        e.remarks.append(NO_SPAN)
    else:
        e.remarks.append(f"evaluated over {(span_ns[1] - span_ns[0]) / 1e9:.2f} s, the span of {source}")
    if run.truth is not None and not run.no_drone and span_ns is not None:
        e.errors = output_errors(output, run.truth, e.limits)
        held = held_errors(output, run.truth, span_ns, e.limits)
        e.held, e.out_of_reach_ns = held.loc[held.in_reach], held.stamp_ns[~held.in_reach].to_numpy()
        _remark_on_coverage(e, len(e.errors), (span_ns[1] - span_ns[0]) // GRID_NS + 1 - len(held))
    for compute, rows in (item for parts in SECTIONS.values() for item in parts.items()):
        why = compute(e)
        absent = [key for key, *_ in rows if key not in e.values]
        assert why is not None or not absent, absent
        if why is not None:
            e.put_none(why, *absent)
    e.values = {key: e.values[key] for key in CATALOGUE}
    _add_compute_time(e)
    return e


def _remark_on_coverage(e: Evaluation, with_truth: int, unknown: int) -> None:
    """Remarks on the outputs and the times that truth or the reach leave out."""
    n = len(e.output.poses)
    if with_truth < n:
        e.remarks.append(
            f"{n - with_truth} of {n} outputs have no truth within {e.limits.max_gap_s:g} s on both sides; they are in "
            "no error"
        )
    far_s = len(e.out_of_reach_ns) * GRID_NS / 1e9
    if far_s:
        e.remarks.append(f"for {far_s:.1f} s the drone was beyond {e.limits.reach_m:g} m; no output is expected then")
    if unknown > 1:
        e.remarks.append(f"for {unknown * GRID_NS / 1e9:.2f} s there is no truth; nothing is evaluated then")


def _add_compute_time(e: Evaluation) -> None:
    for stage, times in e.run.compute_ms.items():
        for what in ("p50", "p99"):
            e.put(f"compute_{stage}_{what}", float(times[what]), int(times["calls"]))
        if e.span_ns is not None and e.span_ns[1] > e.span_ns[0] and "total" in times:
            span_ms = (e.span_ns[1] - e.span_ns[0]) / 1e6
            e.put(f"compute_{stage}_load", 100 * float(times["total"]) / span_ms)
    if not e.run.compute_ms:
        e.remarks.append(f"compute time per stage not evaluated: {e.run.why_missing(EvaluationInput.COMPUTE)}")
