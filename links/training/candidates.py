"""Candidate logs of runs as training data: features, whether the candidate was a drone, and groups to split by.

A row is one classification of one candidate. Successive rows of a candidate hardly differ: all of the first
FIRST_ROWS are used, later ones ever more sparsely. A candidate is a drone when its last observation is within
`false_m` of one in truth; rows at times without truth are left out.

Source: grd.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import ValidationError

from flow.config.yaml_text import YamlTextError, yaml_values
from flow.jobs import Workers, run_all
from flow.link import LinkError
from links.evaluation.association import EvaluationLimits, drone_labels, read_true_drones
from links.evaluation.text_files import Flags
from links.runs import results
from links.runs.run_folder import CONFIG_FILE
from stages.detect.trained.features import NAMES
from stages.geometry.frames import Array64
from stages.geometry.lidar_models import LidarModel
from stages.geometry.rig_lidar import RigLidar

FIRST_ROWS = 30
SPARSER = 1.15  # beyond, the ratio of the numbers of two rows used
SEED = re.compile(r"-s(\d+)(?:-.*)?$")
REQUIRED = ("range_m", "existence_nats", "scan_passes", "free_sectors")  # always available


@dataclass(frozen=True)
class CandidateRows:
    """Rows of the candidate logs of several runs."""

    X: Array64  # (n, features), NaN: not available
    is_drone: Flags  # (n,)
    logged: Array64  # (n,) probability that the run itself gave
    candidate: NDArray[np.int64]  # (n,) number over all runs
    seed: NDArray[np.int64]  # (n,) of the recording
    recording: NDArray[np.int64]  # (n,) number; the same for all runs of a recording
    stamp_ns: NDArray[np.int64]  # (n,)

    def take(self, rows: Flags) -> CandidateRows:
        """The selected rows."""
        return CandidateRows(**{name: values[rows] for name, values in vars(self).items()})

    def feature(self, name: str) -> Array64:
        """One feature (n,)."""
        return self.X[:, NAMES.index(name)]

    @property
    def with_telemetry(self) -> Flags:
        """Rows that were compared with the drone's telemetry."""
        return ~np.isnan(self.feature("over_static_nats"))


def read_candidates(runs: Sequence[Path], thin: bool = True, workers: Workers = 1) -> CandidateRows:
    """The rows of all runs, read on workers.

    LinkError for a run without truth, without a seed in its name, with other features, or without a required one.
    """
    tasks = [ReadTask(folder, index, thin) for index, folder in enumerate(runs)]
    parts = run_all(read_one, tasks, workers, lambda shares: None)
    frame = pd.concat([part for part in parts if len(part)])
    if frame.empty:
        raise LinkError("no run has candidates")
    return CandidateRows(
        X=frame[list(NAMES)].to_numpy(dtype=np.float64),
        is_drone=frame.is_drone.to_numpy(dtype=np.bool_),
        logged=frame.probability.to_numpy(dtype=np.float64),
        candidate=frame.groupby(["run", "detector_instance", "candidate"]).ngroup().to_numpy(dtype=np.int64),
        seed=frame.seed.to_numpy(dtype=np.int64),
        recording=np.unique(frame.recording, return_inverse=True)[1].astype(np.int64),
        stamp_ns=frame.stamp_ns.to_numpy(dtype=np.int64),
    )


def lidar_model_of(runs: Sequence[Path]) -> LidarModel:
    """The LiDAR of the runs by their configuration; a run without one has a VLP-16. LinkError: they differ."""
    models: dict[LidarModel, Path] = {_lidar_model(folder): folder for folder in runs}
    if len(models) > 1:
        listed = ", ".join(f"{folder} ({model})" for model, folder in models.items())
        raise LinkError(f"the runs have different LiDARs, and a model is for one: {listed}")
    return next(iter(models))


def _lidar_model(folder: Path) -> LidarModel:
    file = folder / CONFIG_FILE
    if not file.exists():
        return RigLidar().model
    try:
        values = yaml_values(file.read_bytes())
        return RigLidar.model_validate((values.get("rig") or {}).get("lidar") or {}).model
    except (YamlTextError, ValidationError, AttributeError) as error:
        raise LinkError(f"{file}: {error}") from None


@dataclass(frozen=True)
class ReadTask:
    """A run whose candidates are read."""

    folder: Path
    index: int
    thin: bool


def read_one(task: ReadTask, report: Callable[[float], None]) -> pd.DataFrame:
    """The rows of one run."""
    folder, index, thin = task.folder, task.index, task.thin
    file = folder / results.CANDIDATES_FILE
    if not file.exists():
        if (folder / results.SUMMARY_FILE).exists():
            return pd.DataFrame()  # nothing was ever a candidate
        raise LinkError(f"{folder}: not the folder of a complete run")
    frame = pd.read_csv(file, dtype={"stamp_s": str})
    if absent := [name for name in NAMES if name not in frame.columns]:
        raise LinkError(f"{file}: no feature {', '.join(absent)}; replay the recording with this version of grd")
    for name in NAMES:
        values = np.asarray(pd.to_numeric(frame[name], errors="coerce"), dtype=np.float64)
        empty = np.asarray(frame[name].isna())
        wrong = np.isinf(values) | (np.isnan(values) & (~empty | (name in REQUIRED)))
        if wrong.any():
            row = int(wrong.argmax())
            text = "missing" if empty[row] else f"'{frame[name].iloc[row]}', not a finite number"
            raise LinkError(f"{file}:{row + 2}: {name} is {text}; replay the recording with this version of grd")
    frame["stamp_ns"] = [int(s) * 10**9 + int(f.ljust(9, "0")) for s, f in (t.split(".") for t in frame.stamp_s)]
    known, frame["is_drone"] = _labels(folder, frame)
    recording, seed = _recording(folder)
    frame = frame.assign(run=index, recording=recording, seed=seed).loc[known]
    if thin:
        number = frame.groupby(["detector_instance", "candidate"]).cumcount().to_numpy()
        step = np.floor(np.log(np.maximum(number, FIRST_ROWS) / FIRST_ROWS) / np.log(SPARSER))
        before = np.floor(np.log(np.maximum(number - 1, FIRST_ROWS) / FIRST_ROWS) / np.log(SPARSER))
        frame = frame.loc[(number < FIRST_ROWS) | (step != before)]
    return frame


def _recording(folder: Path) -> tuple[str, int]:
    """The recording and its seed, by the name of the run: rows of one must not be on both sides of a split."""
    found = SEED.search(folder.name)
    if found is None:
        raise LinkError(f"{folder}: the name of the run must contain the seed of its recording, as in park-s7-detector")
    return folder.name[: found.end(1)], int(found[1])


def _labels(folder: Path, frame: pd.DataFrame) -> tuple[Flags, Flags]:
    """Rows with truth, and those within `false_m` of a drone."""
    drones, empty_sky = read_true_drones(folder, None)
    if not empty_sky and drones[0].path is None:
        raise LinkError(f"{folder}: {next(iter(drones[0].missing.values()))}: nothing to train on")
    paths = [] if empty_sky else [(drone.path.stamps_ns, drone.path.xyz_m) for drone in drones if drone.path]
    return drone_labels(frame.stamp_ns.to_numpy(), frame[["x_m", "y_m", "z_m"]].to_numpy(), paths, EvaluationLimits())
