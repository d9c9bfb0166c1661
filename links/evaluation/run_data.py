"""What there is to judge: a run's folder, or a TUM file, with the truth that belongs to it.

Source: DESIGN, Outputs of a run; file names in links/runs/results.py.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flow.link import LinkError
from links.evaluation.output import Output, read_output
from links.evaluation.rotations import Rotations, read_rotations
from links.evaluation.said import Said, read_said
from links.evaluation.true_drone import TrueDrone, read_true_drones, read_true_vehicle
from links.evaluation.tum import Trajectory, read_number, read_stamp_ns, read_table, read_tum
from links.runs.results import (
    CANDIDATES_FILE,
    COVARIANCE_FILE,
    DETECTIONS_FILE,
    FIX_FILE,
    POSE_COVARIANCE_FILE,
    POSE_FILE,
    ROTATION_FILE,
    SUMMARY_FILE,
)
from stages.geometry.frames import Array64


@dataclass(frozen=True, slots=True)
class Sweep:
    """One searched sweep and the candidates that were accepted in it, best first."""

    start_ns: int
    end_ns: int
    accepted_xyz_m: Array64  # (k, 3)


@dataclass(frozen=True, slots=True)
class RunData:
    """A run as read. What is None was not recorded; `missing` says why, by what it is needed for."""

    name: str  # as the user gave it
    recording: str  # what it is a run of: runs of the same recording are compared with each other
    outputs: tuple[Output, ...]  # the first is the run's answer
    truth: Trajectory | None  # of the drone that is judged
    no_drone: bool  # known: there was no drone at all
    start_ns: int | None  # of the recording
    end_ns: int | None
    sweeps: tuple[Sweep, ...] | None
    drone_hits_ns: NDArray[np.int64] | None  # truth: when the drone returned a pulse
    states: tuple[tuple[int, str, int], ...]  # (since, state, track)
    compute_ms: dict[str, dict[str, float]]
    missing: dict[str, str]
    config: str = ""  # what it was made with; "": not known
    hidden_ns: NDArray[np.int64] | None = None  # (m, 2) truth: since when and until when the drone was hidden
    drones: tuple[TrueDrone, ...] = ()  # all that truth knows of, the one that is judged among them
    drone: int = 1  # number of the one that is judged
    rotations: Rotations | None = None  # of both cameras; None: no stage told any
    vehicle: Trajectory | None = None  # truth: T_world_vehicle
    said: Said | None = None  # what may be a drone, with a probability; None: no stage tells that

    @property
    def other_paths(self) -> list[Trajectory]:
        """Truth of the drones that are not judged."""
        return [d.path for number, d in enumerate(self.drones, start=1) if d.path is not None and number != self.drone]


def read_run(path: Path, truth_file: Path | None = None, no_drone: bool = False) -> RunData:
    """Read a run's folder or a TUM file. Errors are LinkError."""
    if path.is_dir():
        run = _read_folder(path, truth_file, no_drone)
    elif path.suffix.lower() in {".mcap", ".rrd", ".html", ".json", ".yaml"}:
        raise LinkError(
            f"{path}: a run's folder or a TUM file is wanted, not a {path.suffix} file (replay a recording first)"
        )
    else:
        poses = read_tum(path)
        truth = read_tum(truth_file) if truth_file else None
        nothing = f"{path.name} is a lone TUM file, not a run's folder"
        missing: dict[str, str] = dict.fromkeys(
            ("covariance", "recording", "detections", "compute", "hits", "visible"), nothing
        )
        if truth is None:
            missing["truth"] = "no truth was given (--truth FILE.tum)"
        output = Output("file", poses, why_no_covariance=nothing)
        run = RunData(str(path), path.stem, (output,), truth, no_drone, None, None, None, None, (), {}, missing)
    if run.truth is not None and not no_drone:
        _demand_overlap(run, run.truth)
    return run


def _read_folder(folder: Path, truth_file: Path | None, no_drone: bool) -> RunData:
    summary = _read_summary(folder / SUMMARY_FILE)
    missing: dict[str, str] = {}
    outputs: list[Output] = []
    if (folder / POSE_FILE).exists():
        outputs.append(read_output("pose", folder / POSE_FILE, folder / POSE_COVARIANCE_FILE, 6))
    if (folder / FIX_FILE).exists():
        outputs.append(read_output("fix", folder / FIX_FILE, folder / COVARIANCE_FILE, 3))
    if not outputs:
        raise LinkError(f"{folder}: neither {POSE_FILE} nor {FIX_FILE}: is it the --out folder of a run?")
    drones, said_empty = read_true_drones(folder, truth_file)
    missing |= drones[0].missing
    start_ns, end_ns = (
        read_stamp_ns(str(summary[key]), f"{folder / SUMMARY_FILE}: {key}") if key in summary else None
        for key in ("start_s", "end_s")
    )
    if start_ns is None or end_ns is None:
        missing["recording"] = f"{SUMMARY_FILE} does not say when the recording began and ended (an older grd wrote it)"
    sweeps = None
    if (folder / DETECTIONS_FILE).exists():
        sweeps = _read_sweeps(folder / DETECTIONS_FILE)
    else:
        missing["detections"] = f"the run has no {DETECTIONS_FILE} (an older grd wrote it)"
    states = summary.get("states", [])
    compute = summary.get("compute_ms", {})
    recording = Path(str(summary.get("recording", folder.name))).stem
    return RunData(
        name=str(folder),
        recording=recording,
        outputs=tuple(outputs),
        truth=drones[0].path,
        no_drone=no_drone or said_empty,
        start_ns=start_ns,
        end_ns=end_ns,
        sweeps=sweeps,
        drone_hits_ns=drones[0].hits_ns,
        states=tuple(
            (read_stamp_ns(str(s["stamp_s"]), f"{folder}: states"), str(s["state"]), int(s.get("track_id", 1)))
            for s in states
        ),
        compute_ms={stage: values for stage, values in compute.items() if values.get("calls")},
        missing=missing,
        config=_configuration(folder, recording, summary),
        hidden_ns=drones[0].hidden_ns,
        drones=drones,
        rotations=read_rotations(folder / ROTATION_FILE) if (folder / ROTATION_FILE).exists() else None,
        vehicle=read_true_vehicle(folder),
        said=read_said(folder / CANDIDATES_FILE) if (folder / CANDIDATES_FILE).exists() else None,
    )


def _read_summary(path: Path) -> dict[str, Any]:
    if not path.exists():
        raise LinkError(f"{path.parent}: no {path.name}: is it the --out folder of a run, and did the run end?")
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise LinkError(f"{path}: not JSON: {error}") from None
    if not isinstance(summary, dict):
        raise LinkError(f"{path}: not the summary of a run")
    return summary


def _configuration(folder: Path, recording: str, summary: dict[str, Any]) -> str:
    """What the run was made with. `<recording>-NAME` is the user's own name for it; else the summary says.

    A folder named by `grd replay` itself (`<recording>-replay-2`) tells less than its summary: `replay a.b=2`.
    """
    stem = Path(str(summary.get("config", ""))).stem
    own = folder.resolve().name.removeprefix(f"{recording}-")
    if own != folder.resolve().name and not re.fullmatch(rf"{re.escape(stem)}(-\d+)?", own):
        return own
    overlays = [Path(str(name)).stem for name in summary.get("overlays", [])]
    sets = [str(text) for text in summary.get("set", []) if not str(text).startswith("viewer.")]
    return " ".join(["+".join([stem, *overlays]), *sets])


def _read_sweeps(path: Path) -> tuple[Sweep, ...]:
    found: dict[tuple[int, int], list[list[float]]] = {}
    for where, row in read_table(path, ("start_s", "end_s", "x_m", "y_m", "z_m")):
        span = read_stamp_ns(row["start_s"], where), read_stamp_ns(row["end_s"], where)
        accepted = found.setdefault(span, [])
        if row["x_m"]:
            accepted.append([read_number(row[key], where) for key in ("x_m", "y_m", "z_m")])
    return tuple(Sweep(a, b, np.array(xyz, dtype=np.float64).reshape(-1, 3)) for (a, b), xyz in found.items())


def _demand_overlap(run: RunData, truth: Trajectory) -> None:
    """LinkError when no output lies within truth's span: two clocks, or the wrong file."""
    for output in run.outputs:
        stamps = output.poses.stamps_ns
        if len(stamps) and (stamps[-1] < truth.stamps_ns[0] or stamps[0] > truth.stamps_ns[-1]):
            raise LinkError(
                f"{output.poses.path} spans {_span(stamps)}, truth {truth.path} spans {_span(truth.stamps_ns)}: they "
                "do not overlap; both must be on the recording's clock, in seconds"
            )
    if run.start_ns is None or run.end_ns is None:
        return
    if run.end_ns < truth.stamps_ns[0] or run.start_ns > truth.stamps_ns[-1]:
        span = _span(np.array([run.start_ns, run.end_ns]))
        raise LinkError(f"{run.name}: the recording spans {span}, truth {_span(truth.stamps_ns)}: no overlap")


def _span(stamps_ns: NDArray[np.int64]) -> str:
    return f"{stamps_ns[0] / 1e9:.3f} .. {stamps_ns[-1] / 1e9:.3f} s"
