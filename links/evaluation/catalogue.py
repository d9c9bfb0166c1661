"""Every number of an evaluation: its name, unit, which way is better, and a value that can say why it is none.

Source: DESIGN, evaluate; ours: a number that a run failed to earn counts as the worst there is, one that could not be
measured is left out of a median and counted beside it. No number is ever filled in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

Better = Literal["low", "high", "one", "none"]
BANDS_M: tuple[tuple[float, float], ...] = ((0, 10), (10, 20), (20, 30), (30, 50), (50, math.inf))


@dataclass(frozen=True, slots=True)
class Metric:
    """What is measured. `better`: low, high, one (it has an honest value), none (a false output counts as output)."""

    key: str
    name: str
    unit: str
    better: Better
    group: str


@dataclass(frozen=True, slots=True)
class Value:
    """One measured number, or why there is none. `failed`: the run had the chance and gave nothing: worst of all."""

    value: float | None
    samples: int | None = None
    low: float | None = None  # 95 % interval, or the bounds in which an honest estimator would lie
    high: float | None = None
    note: str = ""
    failed: bool = False
    applies: bool = True  # False: there was nothing to measure, as a range the drone never was at

    def __post_init__(self) -> None:
        if self.value is not None and not math.isfinite(self.value):
            raise ValueError(f"a metric must be a finite number or say why it is none, not {self.value}")

    def ranked(self, better: Better) -> float | None:
        """For medians: the value; the worst there is for a failure; None when it could not be measured."""
        if self.failed:
            return -math.inf if better == "high" else math.inf
        return self.value


def not_evaluated(reason: str) -> Value:
    """It could not be measured; the run is not to blame."""
    return Value(None, note=reason)


def not_applicable(reason: str) -> Value:
    """There was nothing to measure; nobody misses it."""
    return Value(None, note=reason, applies=False)


def failure(reason: str) -> Value:
    """The run gave nothing where it should have."""
    return Value(None, note=reason, failed=True)


def band_name(low_m: float, high_m: float) -> str:
    """`10-20 m`, `50+ m`."""
    return f"{low_m:g}+ m" if math.isinf(high_m) else f"{low_m:g}-{high_m:g} m"


def band_key(what: str, low_m: float) -> str:
    """`range_10_rmse_m`: the band by its lower edge."""
    return f"range_{low_m:g}_{what}"


CAMERAS = "rotation by both cameras"
AS_GIVEN, MODULO = (
    "given",
    "modulo",
)  # errors of the branch given; of the nearest, a quarter turn about the vertical off
HEADLINE = "time"  # the group that a run which gives less can only lose in


def _catalogue() -> dict[str, Metric]:
    rows: list[Metric] = []

    def add(group: str, *metrics: tuple[str, str, str, Better]) -> None:
        rows.extend(Metric(key, name, unit, better, group) for key, name, unit, better in metrics)

    add(
        HEADLINE,
        ("right_share", "time right (output within 1 m)", "%", "high"),
        ("fresh_share", "time with an output", "%", "none"),
        ("held_rmse_m", "3D RMSE, last output held", "m", "low"),
        ("held_p95_m", "3D 95 %, last output held", "m", "low"),
        ("held_max_m", "3D max, last output held", "m", "low"),
        ("before_first_s", "time before any output", "s", "none"),
        ("first_right_s", "time to first right output", "s", "low"),
        ("first_output_s", "time to first output", "s", "none"),
        ("longest_not_right_s", "longest time not right", "s", "low"),
        ("longest_gap_s", "longest gap between outputs", "s", "none"),
        ("rate_hz", "output rate", "Hz", "none"),
    )
    add(
        "error of the outputs",
        ("rmse_x_m", "RMSE x", "m", "low"),
        ("rmse_y_m", "RMSE y", "m", "low"),
        ("rmse_z_m", "RMSE z", "m", "low"),
        ("rmse_m", "3D RMSE", "m", "low"),
        ("median_m", "3D median", "m", "low"),
        ("p95_m", "3D 95 %", "m", "low"),
        ("max_m", "3D max", "m", "low"),
        ("evo_ape_rmse_m", "evo APE, RMSE", "m", "low"),
        ("evo_rpe_rmse_m", "evo RPE to next output, RMSE", "m", "low"),
        ("evo_rpe_max_m", "evo RPE to next output, max", "m", "low"),
    )
    for low, high in BANDS_M:
        add(
            "by true range",
            (band_key("rmse_m", low), f"{band_name(low, high)}: 3D RMSE", "m", "low"),
            (band_key("right_share", low), f"{band_name(low, high)}: time right", "%", "high"),
        )
    add(
        "keeping it",
        ("lost_count", "times lost though in sight", "", "low"),
        ("reacquired_s", "worst time to find it again", "s", "low"),
        ("longest_hit_gap_s", "longest gap of returns, while kept", "s", "low"),
        ("longest_hit_gap_whole_s", "longest gap of returns, all time", "s", "low"),
        ("identity_swaps", "tracks gone over to another drone", "", "low"),
    )
    add(
        "false and missed",
        ("false_outputs", "false outputs", "", "low"),
        ("false_per_min", "false outputs", "/min", "low"),
        ("sure_false_outputs", "false by 3+ of their own sigmas", "", "low"),
        ("beyond_1m_share", "outputs off by more than 1 m", "%", "low"),
        ("found_share", "found, of the time searched", "%", "high"),
        ("found_when_seen_share", "found, of the time of sweeps with 4+ returns", "%", "high"),
        ("missed_sweeps", "sweeps missed, 4+ returns", "", "low"),
        ("hit_share", "time of sweeps with a return of the drone", "%", "none"),
        ("seen_share", "time of sweeps with 4+ returns", "%", "none"),
        ("false_detections_per_min", "false detections", "/min", "low"),
        ("false_alarms_per_h", "false alarms, no drone", "/h", "low"),
        ("invented_drones", "drones invented, no drone", "", "low"),
    )
    add(
        "for the autopilot",
        ("good_share", "time with a pose good enough", "%", "high"),
        ("good_rmse_m", "its 3D RMSE", "m", "low"),
        ("good_max_m", "its largest error", "m", "low"),
        ("good_max_deg", "its largest error of rotation", "deg", "low"),
        ("good_false", "such poses off by more than 1 m", "", "low"),
    )
    add(
        "rotation",
        ("rmse_roll_deg", "RMSE roll", "deg", "low"),
        ("rmse_pitch_deg", "RMSE pitch", "deg", "low"),
        ("rmse_yaw_deg", "RMSE yaw", "deg", "low"),
        ("rmse_angle_deg", "RMSE of the whole angle", "deg", "low"),
        ("branch_wrong_s", "yaw branch wrong, told as known", "s", "low"),
    )
    add(
        CAMERAS,
        ("rotation_pictures", "pictures of the drone", "", "none"),
        ("rotation_accepted_share", "pictures with a rotation", "%", "high"),
    )
    for which, told in ((AS_GIVEN, "as given"), (MODULO, "modulo quarter turns")):
        add(
            CAMERAS,
            (f"rotation_{which}_rmse_deg", f"{told}: RMSE", "deg", "low"),
            (f"rotation_{which}_median_deg", f"{told}: median", "deg", "low"),
            (f"rotation_{which}_p95_deg", f"{told}: 95 %", "deg", "low"),
            (f"rotation_{which}_rmse_roll_deg", f"{told}: RMSE roll", "deg", "low"),
            (f"rotation_{which}_rmse_pitch_deg", f"{told}: RMSE pitch", "deg", "low"),
            (f"rotation_{which}_rmse_yaw_deg", f"{told}: RMSE yaw", "deg", "low"),
        )
    add(
        CAMERAS,
        ("rotation_inside_95_share", "modulo, in the 95 % bound (honest: 95)", "%", "one"),
        ("rotation_nees_of_1", "modulo, mean NEES / 3 (honest: 1)", "", "one"),
        ("rotation_resolved", "RESOLVED rotations", "", "none"),
        ("rotation_wrong_resolved", "wrong RESOLVED (> 45 deg off)", "", "low"),
        ("rotation_resolved_s", "time to the first RESOLVED", "s", "low"),
        ("rotation_resolved_m", "way to it, relative to the vehicle", "m", "low"),
        ("rotation_resolved_ground_m", "way to it, over ground", "m", "low"),
        ("rotation_switches", "changes of branch", "", "low"),
    )
    add(
        "honesty of the covariance",
        ("nees_mean", "mean NEES, position (honest: 3)", "", "one"),
        ("inside_95_share", "in the 95 % ellipsoid (honest: 95)", "%", "one"),
        ("nees6_mean", "mean NEES, pose (honest: 6)", "", "one"),
    )
    return {metric.key: metric for metric in rows}


CATALOGUE = _catalogue()


def compute_metric(stage: str, what: str) -> Metric:
    """The row of a stage's compute time."""
    names = {"p50": "p50 of a call", "p99": "p99 of a call", "load": "share of one core"}
    unit = "%" if what == "load" else "ms"
    return Metric(f"compute_{stage}_{what}", f"{stage}: {names[what]}", unit, "none", "compute time")


def metric_of(key: str) -> Metric:
    """The metric of a key, compute times included."""
    if key in CATALOGUE:
        return CATALOGUE[key]
    stage, what = key.removeprefix("compute_").rsplit("_", 1)
    return compute_metric(stage, what)
