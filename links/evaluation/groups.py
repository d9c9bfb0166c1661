"""Many runs in few rows: by fields of the recording's name and by configuration.

`manhattan-20m-hover-parked-s1`: field 1 is the scene, 2 the range, 3 the motion, 4 the vehicle, 5 the seed.

Source: grd. Shares of time and counts are pooled over all runs of a group. A failed run counts as infinite in a median
and a 95 % point; a maximum is over the runs that did not fail.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import pandas as pd

from flow.link import LinkError
from links.evaluation.errors import brier_and_log_loss, inside_95, p95, poisson_upper, rms, wilson_interval
from links.evaluation.evaluation import Evaluation
from links.evaluation.metrics import CAMERAS
from links.evaluation.stage_metrics import (
    PROBABILITY_EDGES,
    SCORE_RANGES_M,
    candidate_outcomes,
    probability_outcomes,
)
from links.evaluation.tables import OBJECT, REACQUISITIONS, Table, by_config, number_text, runs_table

CONFIG, ALL = "config", "all"
Key = tuple[int, ...]  # fields of the recording's name that a table is grouped by; none: all runs are one group
Group = tuple[tuple[str, ...], str, pd.DataFrame]  # fields, configuration, runs (`runs_table`)
Statistic = Callable[[pd.DataFrame], float]  # of the runs of a group (`runs_table`); NaN where there is none
Columns = dict[str, tuple[int, Statistic]]  # by heading: decimals, statistic


def _mean(key: str) -> Statistic:
    return lambda runs: runs.loc[:, key].mean()


def _median(key: str) -> Statistic:
    return lambda runs: runs.loc[:, key].median()


def _largest(key: str) -> Statistic:
    return lambda runs: runs.loc[np.isfinite(runs[key]), key].max()


def _total(key: str) -> Statistic:
    return lambda runs: runs.loc[np.isfinite(runs[key]), key].sum(min_count=1)


def _percent(key: str, part: str = "s", whole: str = "of_s") -> Statistic:
    def statistic(runs: pd.DataFrame) -> float:
        count, of = float(runs.loc[:, f"{key}_{part}"].sum()), float(runs.loc[:, f"{key}_{whole}"].sum())
        return 100 * count / of if of else math.nan

    return statistic


def _per_h(key: str) -> Statistic:
    def statistic(runs: pd.DataFrame) -> float:
        counted = runs.loc[runs[key].notna() & runs.span_s.notna()]
        return counted[key].sum() / (counted.span_s.sum() / 3600) if len(counted) else math.nan

    return statistic


def _false_track_bound(runs: pd.DataFrame) -> float:
    """One-sided 95 % bound of the rate of false tracks [/h], a Poisson process over all runs."""
    counted = runs.loc[runs.false_tracks.notna() & runs.span_s.notna()]
    if not len(counted):
        return math.nan
    return poisson_upper(int(counted.false_tracks.sum())) / (counted.span_s.sum() / 3600)


def _reacquisition(statistic: Callable[[pd.Series], float]) -> Statistic:
    """A statistic of the times to reacquire of all occlusions."""

    def of_runs(runs: pd.DataFrame) -> float:
        times_s = pd.Series([t for times in runs[REACQUISITIONS] for t in times], dtype=float)
        return statistic(times_s) if len(times_s) else math.nan

    return of_runs


def _rotations(column: str, statistic: Callable[[np.ndarray], float]) -> Statistic:
    """A statistic of the rotations of all runs as one series: a run that accepts few weighs less."""

    def of_runs(runs: pd.DataFrame) -> float:
        values = [e.rotation_errors[column] for e in runs[OBJECT] if e.rotation_errors is not None]
        series = np.concatenate(values) if values else np.zeros(0)
        return statistic(series) if len(series) else math.nan

    return of_runs


def _degrees(statistic: Callable[[np.ndarray], float]) -> Callable[[np.ndarray], float]:
    return lambda angles_rad: statistic(np.degrees(angles_rad))


def quantile_95(ranks: pd.Series) -> float:
    """The smallest value that 95 % do not exceed; NaN without values."""
    values = ranks.dropna().to_numpy()
    return float(np.quantile(values, 0.95, method="inverted_cdf")) if len(values) else math.nan


FIRST_ACCURATE = "first accurate\nmedian [s]", "first accurate\n95 % [s]"  # a failed run is longer than its duration
COLUMNS: Columns = {
    "runs": (0, len),
    "track\naccuracy [%]": (1, _mean("track_accuracy")),
    "precision\n[%]": (1, _percent("precision", "count", "of")),
    "GOSPA\n[m]": (3, _mean("gospa_m")),
    "ever\naccurate": (0, lambda runs: (runs.track_accuracy > 0).sum()),
    "no\noutput": (0, lambda runs: (runs.outputs == 0).sum()),
    "mostly\nfalse": (0, lambda runs: (runs.false_outputs > 0.5 * runs.outputs).sum()),
    "any return\n[%]": (1, _percent("return_share")),
    "observable\n[%]": (1, _percent("observable_share")),
    "detection\nrate [%]": (1, _percent("detection_rate")),
    "of observable\n[%]": (1, _percent("observable_detection_rate")),
    FIRST_ACCURATE[0]: (1, _median("first_accurate_s")),
    FIRST_ACCURATE[1]: (1, lambda runs: quantile_95(runs.first_accurate_s)),
    "return gap\nmedian [s]": (2, _median("longest_return_gap_s")),
    "return gap\nmax [s]": (2, _largest("longest_return_gap_s")),
    "reacquired": (0, _reacquisition(lambda times_s: np.isfinite(times_s).sum())),
    "of\nocclusions": (0, _reacquisition(len)),
    "reacquired\nmedian [s]": (2, _reacquisition(pd.Series.median)),
    "reacquired\nmax [s]": (2, _reacquisition(lambda times_s: times_s[np.isfinite(times_s)].max())),
    "track\nlosses": (0, _total("track_losses")),
    "3D RMSE\nmedian [m]": (3, lambda runs: runs.rmse_m[runs.track_accuracy > 0].median()),
    "in 95 %\n[%]": (1, _percent("inside_95_share", "count", "of")),
    "false\n[/h]": (0, _per_h("false_outputs")),
    "overconfident\n[/h]": (0, _per_h("overconfident_false_outputs")),
    "false tracks\n[/h]": (0, _per_h("false_tracks")),
    "below [/h]\n(95 %)": (0, _false_track_bound),
    "sent\n[%]": (1, _mean("sendable_share")),
    "sent:\nmax [m]": (2, _largest("sendable_max_m")),
    "sent:\nmax [deg]": (1, _largest("sendable_max_deg")),
}
NOTE = (
    "Track accuracy (recall): share of the time with a current output within 1 m. Precision: share of the current "
    "outputs that are. GOSPA: mean over time, p = 2, cut-off 1 m, so 0.71 m without an output. Ever accurate, no "
    "output, mostly false: number of runs. Any return, observable: share of the time searched in searches with 1 or "
    "more, with 4 or more returns of the drone. Detection rate: share of the time searched in searches whose best "
    "candidate is the drone; of observable: share of the time of observable searches, any candidate. First accurate: "
    "time to the first accurate output. Reacquired: after occlusions. Track losses: in sight. 3D RMSE: of runs with "
    "an accurate output. False: outputs farther than 1 m from the drone; overconfident: by more than three of their "
    "own sigmas, too; false tracks: of such outputs, with the bound of a Poisson process. Sent: poses that the "
    "autopilot gate accepts, share of the time and largest errors. Medians and 95 % points count a failed run as "
    "infinite ('never', or longer than the shortest failed run); maxima leave failed runs out. Each of several drones "
    "counts as a run."
)
ROTATION_COLUMNS: Columns = {
    "runs": (0, len),
    "images": (0, lambda runs: runs.rotation_accepted_share_of.sum()),
    "accepted\n[%]": (1, _percent("rotation_accepted_share", "count", "of")),
    "published\nRMSE [deg]": (2, _rotations("published_angle", _degrees(rms))),
    "mod 90\nRMSE [deg]": (2, _rotations("angle", _degrees(rms))),
    "mod 90\nmedian": (2, _rotations("angle", _degrees(np.median))),
    "mod 90\n95 %": (2, _rotations("angle", _degrees(p95))),
    "roll\nRMSE": (2, _rotations("roll", _degrees(rms))),
    "pitch\nRMSE": (2, _rotations("pitch", _degrees(rms))),
    "yaw\nRMSE": (2, _rotations("yaw", _degrees(rms))),
    "in 95 %\n[%]": (1, _rotations("nees", lambda nees: 100 * inside_95(nees, 3).mean())),
    "NEES\n/ 3": (2, _rotations("nees", lambda nees: nees.mean() / 3)),
    "RESOLVED": (0, lambda runs: runs.rotation_resolved.sum()),
    "wrong": (0, _total("rotation_wrong_resolved")),
    "runs\nRESOLVED": (0, lambda runs: np.isfinite(runs.rotation_resolved_s).sum()),
    "first\n[s]": (1, _median("rotation_resolved_s")),
    "first\n[m]": (2, _median("rotation_resolved_m")),
    "ground\n[m]": (2, _median("rotation_resolved_ground_m")),
    "switches": (0, lambda runs: runs.rotation_switches.sum()),
}
ROTATION_NOTE = (
    f"{CAMERAS}: over all rotations of a group. Published: error of the published yaw branch. Mod 90: error of the "
    "nearest of its four branches, turned by 90 deg about the vertical of the world, as are roll, pitch, yaw, the 95 "
    "% bound and NEES / 3 (ideal: 1). Wrong: RESOLVED and more than 45 deg off. Runs RESOLVED: runs whose first "
    "RESOLVED rotation is right. First, ground: time and the drone's path to it, relative to the vehicle and over "
    "ground, medians of runs."
)
RELIABILITY_NOTE = (
    "Candidates of the detector by their probability. A candidate counts once in each row, with the first observation "
    "after which its probability is in that row; it is a drone when it is within 1 m of one then. 95 %: confidence "
    "interval of the share."
)


SCORE_NOTE = (
    "Brier score and log loss [nats] of the detector's probabilities, over every classification of a candidate, by its "
    "range from the vehicle. With telemetry: those that were compared with the drone's telemetry."
)


def parse_by(text: str) -> Key:
    """`2`, `2,3`, `config`, `2,config` as numbers of fields. Configurations are side by side in any case."""
    fields: list[int] = []
    for part in map(str.strip, text.split(",")):
        if part.isdecimal() and int(part) > 0:
            fields.append(int(part))
        elif part != CONFIG:
            raise LinkError(f"--by {text}: expected the number of a field from 1 on, several as in 2,3, or '{CONFIG}'")
    return tuple(fields)


def grouped(runs: pd.DataFrame, key: Key) -> list[Group]:
    """Each combination of fields and configurations of a `runs_table`; all runs together last.

    Numbers are in their order, configurations as they were given. LinkError when a name has no such field.
    """
    cells: dict[tuple[str, ...], list[int]] = {}
    for row, recording in enumerate(runs.recording):
        fields = recording.split("-")
        if max(key, default=0) > len(fields):
            raise LinkError(f"--by {max(key)}: '{recording}' has {len(fields)} fields, joined by '-'")
        cells.setdefault(tuple(fields[number - 1] for number in key), []).append(row)
    rows = [(fields, cells[fields]) for fields in sorted(cells, key=lambda fields: [_natural(text) for text in fields])]
    if key:
        rows.append(((ALL, *[""] * (len(key) - 1)), list(range(len(runs)))))
    return [
        (fields, config, own)
        for fields, several in rows
        for config in dict.fromkeys(runs.config)
        if len(own := runs.iloc[[row for row in several if runs.config.iloc[row] == config]])
    ]


def _natural(text: str) -> list[tuple[int, int | str]]:
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", text) if part]


def group_numbers(groups: list[Group], columns: Columns = COLUMNS) -> pd.DataFrame:
    """The statistics of each group, one row for each."""
    runs = [own for *_, own in groups]
    return pd.DataFrame({head: [float(statistic(own)) for own in runs] for head, (_, statistic) in columns.items()})


def group_table(runs: pd.DataFrame, key: Key) -> Table:
    """Groups of a `runs_table` down, statistics across.

    The configuration is a column when there are several or nothing else is.
    """
    return _table("", grouped(runs, key), key, COLUMNS, NOTE)


def rotation_table(evaluations: Sequence[Evaluation], key: Key) -> Table | None:
    """The same for the rotation by both cameras; None when no run has one."""
    asked = [e for e in evaluations if e.values["rotation_images"].value is not None]
    if not asked:
        return None
    return _table(f"{CAMERAS}, ", grouped(runs_table(asked), key), key, ROTATION_COLUMNS, ROTATION_NOTE)


def _table(title: str, groups: list[Group], key: Key, columns: Columns, note: str) -> Table:
    configs = [config for _, config, _ in groups]
    frame = pd.DataFrame({f"field {number}": [fields[i] for fields, *_ in groups] for i, number in enumerate(key)})
    if not key or len(set(configs)) > 1:
        frame[CONFIG] = configs
    labels, empty = frame.shape[1], []
    failed_s = [own.span_s[np.isinf(own.first_accurate_s)].fillna(0.0).min() for *_, own in groups]
    numbers = group_numbers(groups, columns)
    for head, (decimals, _) in columns.items():
        never = [None if s is None or math.isnan(s) or head not in FIRST_ACCURATE else s for s in failed_s]
        if np.isnan(numbers[head].to_numpy()).all():
            empty.append(head.replace("\n", " "))
        else:
            frame[head] = [number_text(n, decimals, s) for n, s in zip(numbers[head], never, strict=True)]
    by = f"field {', '.join(map(str, key))} of the recording's name" if key else CONFIG
    return Table(f"{title}by {by}", frame, labels, note + (f" Without values: {', '.join(empty)}." if empty else ""))


def false_track_numbers(runs: pd.DataFrame) -> pd.DataFrame:
    """Runs without a drone of a `runs_table`, one row for each configuration; of unknown length: left out.

    The rate of false tracks has a one-sided 95 % bound of a Poisson process: tracks are independent, outputs are not.
    """
    rows: list[dict[str, object]] = []
    for config, several in runs[runs.span_s.notna()].groupby("config", sort=False):
        hours = float(several.span_s.sum()) / 3600
        tracks = int(several.false_tracks.sum())
        row = {
            CONFIG: config,
            "runs": len(several),
            "hours": hours,
            "outputs": int(several.outputs.sum()),
            "false\ndetections": int(several.detections.sum()),
        }
        row |= {"false\ntracks": tracks, "[/h]": tracks / hours, "below [/h]\n(95 %)": poisson_upper(tracks) / hours}
        rows.append(row)
    return pd.DataFrame(rows)


def false_track_table(runs: pd.DataFrame) -> Table:
    """Configurations of a `runs_table` down; the note names the recordings with false tracks."""
    frame = false_track_numbers(runs).map(lambda x: f"{x:.3g}" if isinstance(x, float) else str(x))
    false = runs[runs.false_tracks > 0].groupby(["config", "recording"], sort=False).false_tracks.sum()
    notes: list[str] = []
    for config, counts in false.groupby("config", sort=False):
        names = [f"{name} ({n:.0f})" if n > 1 else str(name) for (_, name), n in counts.items()]
        notes.append(f"{config or 'runs'}: false tracks in {', '.join(names)}")
    return Table("without a drone", frame, 1, "; ".join(notes))


def reliability(evaluations: list[Evaluation]) -> pd.DataFrame:
    """Reliability of the detector's probabilities: candidates and drones among them, by configuration and bin.

    Columns: config, low and high edge, candidates, mean probability, drones, share of drones and its 95 % interval.
    """
    rows: list[dict[str, object]] = []
    for config, several in by_config(evaluations).items():
        runs = {e.run.name: e for e in several}.values()  # several drones of a run have the same candidates
        outcomes = pd.concat([probability_outcomes(e) for e in runs])
        for k, (low, high) in enumerate(pairwise(PROBABILITY_EDGES)):
            here = outcomes[outcomes.bin == k]
            if n := len(here):
                drones = int(here.is_drone.sum())
                row = {"config": config, "low": low, "high": high, "candidates": n, "mean": here.probability.mean()}
                below, above = wilson_interval(drones, n)
                rows.append(row | {"drones": drones, "share": drones / n, "share_low": below, "share_high": above})
    return pd.DataFrame(rows)


def reliability_table(evaluations: list[Evaluation]) -> Table | None:
    """Configurations and probabilities down; None when no run has candidates with a probability."""
    rows = reliability(evaluations)
    if rows.empty:
        return None
    percent = (100 * rows[["mean", "share", "share_low", "share_high"]]).map("{:.1f}".format)
    frame = pd.DataFrame(
        {CONFIG: rows.config, "probability": rows.low.map("{:g} to ".format) + rows.high.map("{:g}".format)}
    )
    frame["candidates"] = rows.candidates.astype(str)
    frame["mean probability\n[%]"], frame["drones\n[%]"] = percent["mean"], percent["share"]
    frame["95 %\n[%]"] = percent["share_low"] + " to " + percent["share_high"]
    return Table("reliability of the detector's probabilities", frame, 2, RELIABILITY_NOTE)


def probability_scores(evaluations: list[Evaluation]) -> pd.DataFrame:
    """Brier score and log loss of the detector's probabilities by configuration, telemetry and range."""
    rows: list[dict[str, object]] = []
    for config, several in by_config(evaluations).items():
        runs = {e.run.name: e for e in several}.values()  # several drones of a run have the same candidates
        outcomes = pd.concat([candidate_outcomes(e) for e in runs])
        for telemetry in (True, False):
            for low, high in pairwise(SCORE_RANGES_M):
                in_band = (outcomes.range_m >= low) & (outcomes.range_m < high) & (outcomes.telemetry == telemetry)
                here = outcomes[in_band]
                if not len(here):
                    continue
                is_drone = here.is_drone.to_numpy(dtype=np.bool_)
                brier, log_loss = brier_and_log_loss(here.probability.to_numpy(dtype=np.float64), is_drone)
                row = {"config": config, "telemetry": telemetry, "low": low, "high": high, "rows": len(here)}
                rows.append(row | {"drones": int(is_drone.sum()), "brier": brier, "log_loss": log_loss})
    return pd.DataFrame(rows)


def probability_score_table(evaluations: list[Evaluation]) -> Table | None:
    """Configurations, telemetry and range down; None when no run has candidates with a probability."""
    rows = probability_scores(evaluations)
    if rows.empty:
        return None
    frame = pd.DataFrame({CONFIG: rows.config, "telemetry": np.where(rows.telemetry, "with", "without")})
    frame["range [m]"] = rows.low.map("{:g} to ".format) + rows.high.map("{:g}".format)
    frame["classifications"], frame["of drones"] = rows["rows"].astype(str), rows.drones.astype(str)
    frame["Brier"], frame["log loss"] = rows.brier.map("{:.4f}".format), rows.log_loss.map("{:.4f}".format)
    return Table("scores of the detector's probabilities", frame, 3, SCORE_NOTE)
