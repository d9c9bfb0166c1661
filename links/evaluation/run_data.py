"""Everything an evaluation reads: the folder of a run, or a TUM file, with the truth that belongs to it.

Source: DESIGN, Outputs of a run; links/runs/results.py and links/runs/truth.py write the files.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from flow.link import LinkError
from links.evaluation.association import DroneTruth, EvaluationInput, EvaluationLimits, follow, read_true_drones
from links.evaluation.text_files import Flags, Rows, Stamps, TextTable, Trajectory, read_stamp_ns, read_tum
from links.runs import results
from stages.geometry.frames import Array64, rotations_from_xyzw
from stages.messages import BranchState

T = TypeVar("T")
XYZ = ("x_m", "y_m", "z_m")
TELEMETRY_COLUMN = "over_static_nats"  # of the candidate log: filled where a candidate was compared with telemetry
NOT_A_RUN = {".mcap", ".rrd", ".html", ".json", ".yaml"}  # files that are given by mistake


class OutputKind(StrEnum):
    """Which trajectory of a run an output is."""

    POSE = "pose"  # fused
    FIX = "fix"  # of the LiDAR
    FILE = "file"  # a TUM file without a run


@dataclass(frozen=True, slots=True)
class RunTrajectory:
    """A trajectory of a run with the covariance and the marks of each pose."""

    kind: OutputKind
    poses: Trajectory
    covariance: Array64 | None = None  # (n, 3, 3) [m2] vehicle axes, or (n, 6, 6) rotation first, tangent at the drone
    why_no_covariance: str = ""
    sendable: Flags | None = None  # (n,) the autopilot gate accepts it; None: the run does not mark that
    returns: NDArray[np.int64] | None = None  # (n,) returns used
    track: NDArray[np.int64] | None = None  # (n,) track number; None: the run has one track only
    switches: int | None = None  # changes of its tracks to another drone; None: there was one drone
    has_rotation: Flags | None = None  # (n,) the rotation is known; None: the run does not mark that

    def take(self, rows: Rows) -> RunTrajectory:
        """The poses of some rows, in that order."""
        names = ("covariance", "sendable", "returns", "track", "has_rotation")
        arrays = {name: None if (a := getattr(self, name)) is None else a[rows] for name in names}
        return replace(self, poses=self.poses.take(rows), **arrays)


@dataclass(frozen=True, slots=True)
class Search:
    """A search of the detector and the candidates that it accepted, best first."""

    start_ns: int
    end_ns: int
    accepted_xyz_m: Array64  # (k, 3)


@dataclass(frozen=True, slots=True)
class RotationLog:
    """Rotations estimated from both cameras, one row for each image of the drone's camera."""

    stamps_ns: Stamps  # (n,)
    accepted: Flags  # (n,) False: no rotation
    R_vehicle_drone: Array64  # (n, 3, 3) of the published yaw branch; identity where there is none
    covariance_rad2: Array64  # (n, 3, 3) of phi in R exp(phi), drone axes; zero where there is none
    resolved: Flags  # (n,) the yaw branch is declared RESOLVED
    decides: bool  # the stage decides the branch; False: it leaves it to the heading (state OPEN)
    switches: NDArray[np.int64]  # (n,) changes of the yaw branch so far

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True, slots=True)
class RunData:
    """A run as read from its files. `drone` selects the drone that it is evaluated against."""

    name: str  # as the user gave it
    recording: str  # runs of one recording are compared with each other
    outputs: tuple[RunTrajectory, ...]  # the first is the primary output
    no_drone: bool  # truth, or the user, states that there was no drone
    drones: tuple[DroneTruth, ...]  # at least one
    drone: int = 1  # number of the selected drone
    start_ns: int | None = None  # of the recording
    end_ns: int | None = None
    searches: tuple[Search, ...] | None = None
    states: tuple[tuple[int, str, int], ...] = ()  # (since, TrackingState's name, track)
    compute_ms: dict[str, dict[str, float]] = field(default_factory=dict)
    missing: dict[EvaluationInput, str] = field(default_factory=dict)
    config: str = ""  # name of the configuration; empty when it is not known
    vehicle: Trajectory | None = None  # truth, T_world_vehicle
    rotations: RotationLog | None = None
    candidates: pd.DataFrame | None = (
        None  # of the detector: stamp_ns, candidate, probability, telemetry, x_m, y_m, z_m
    )

    @property
    def target(self) -> DroneTruth:
        """The selected drone."""
        return self.drones[self.drone - 1]

    @property
    def truth(self) -> Trajectory | None:
        """T_vehicle_drone of the selected drone."""
        return self.target.path

    def why_missing(self, source: EvaluationInput) -> str:
        """Why an input is missing; empty when it is not."""
        return (self.missing | self.target.missing).get(source, "")


def read_run(path: Path, truth_file: Path | None = None, no_drone: bool = False) -> RunData:
    """Read the folder of a run or a TUM file. `truth_file` replaces the truth of drone 1. Errors are LinkError."""
    if path.is_dir():
        run = _read_folder(path, truth_file, no_drone)
    elif path.suffix.lower() in NOT_A_RUN:
        raise LinkError(
            f"{path}: expected the folder of a run or a TUM file, not a {path.suffix} file (replay a recording first)"
        )
    else:
        run = _read_file(path, truth_file, no_drone)
    if run.truth is not None and not no_drone:
        _check_overlap(run, run.truth)
    return run


def per_drone(run: RunData, limits: EvaluationLimits) -> list[RunData]:
    """The run once for each drone with truth, with the tracks of each output that follow that drone."""
    known = [(number, d.path) for number, d in enumerate(run.drones, start=1) if d.path is not None]
    if len(known) < 2:
        return [run]
    paths = [(path.stamps_ns, path.xyz_m) for _, path in known]
    parts: list[list[RunTrajectory]] = [[] for _ in known]
    for output in run.outputs:
        poses = output.poses
        tracks = np.ones(len(poses), dtype=np.int64) if output.track is None else output.track
        found = follow(poses.stamps_ns, poses.xyz_m, tracks, paths, limits.max_gap_ns)
        for index, part in enumerate(parts):
            own = found.drone == index
            switches = sum(found.switches[track] for track in np.unique(tracks[own]).tolist())
            part.append(replace(output.take(own), switches=switches))
    return [
        replace(run, outputs=tuple(outputs), drone=number) for (number, _), outputs in zip(known, parts, strict=True)
    ]


def _read_file(path: Path, truth_file: Path | None, no_drone: bool) -> RunData:
    why = f"{path.name} is a TUM file without a run"
    missing = dict.fromkeys(EvaluationInput, why) | {EvaluationInput.TRUTH: "no truth was given (--truth FILE.tum)"}
    output = RunTrajectory(OutputKind.FILE, read_tum(path), why_no_covariance=why)
    truth = None if truth_file is None else read_tum(truth_file)
    return RunData(str(path), path.stem, (output,), no_drone, (DroneTruth(truth),), missing=missing)


def _read_folder(folder: Path, truth_file: Path | None, no_drone: bool) -> RunData:
    summary = _read_summary(folder / results.SUMMARY_FILE)
    outputs: list[RunTrajectory] = []
    if (folder / results.POSE_FILE).exists():
        outputs.append(read_output(OutputKind.POSE, folder))
    if (folder / results.FIX_FILE).exists():
        outputs.append(read_output(OutputKind.FIX, folder))
    if not outputs:
        raise LinkError(
            f"{folder}: neither {results.POSE_FILE} nor {results.FIX_FILE}: is it the --out folder of a run?"
        )
    drones, empty_sky = read_true_drones(folder, truth_file)
    start_ns, end_ns = (
        read_stamp_ns(str(summary[key]), f"{folder / results.SUMMARY_FILE}: {key}") if key in summary else None
        for key in ("start_s", "end_s")
    )
    vehicle = _if_exists(folder / results.TRUTH_VEHICLE_FILE, lambda path: read_tum(path, may_be_empty=True))
    recording = Path(str(summary.get("recording", folder.name))).stem
    compute = {stage: values for stage, values in summary.get("compute_ms", {}).items() if values.get("calls")}
    return RunData(
        name=str(folder),
        recording=recording,
        outputs=tuple(outputs),
        no_drone=no_drone or empty_sky,
        drones=drones,
        start_ns=start_ns,
        end_ns=end_ns,
        searches=_if_exists(folder / results.DETECTIONS_FILE, _read_searches),
        states=tuple(
            (read_stamp_ns(str(s["stamp_s"]), f"{folder}: states"), str(s["state"]), int(s.get("track_id", 1)))
            for s in summary.get("states", [])
        ),
        compute_ms=compute,
        missing={
            EvaluationInput.SEARCHES: f"the run has no {results.DETECTIONS_FILE}",
            EvaluationInput.COMPUTE: f"{results.SUMMARY_FILE} holds none",
        },
        config=_configuration(folder, recording, summary),
        vehicle=vehicle if vehicle is not None and len(vehicle) else None,
        rotations=_if_exists(folder / results.ROTATION_FILE, read_rotations),
        candidates=_if_exists(folder / results.CANDIDATES_FILE, _read_candidates),
    )


def _if_exists(file: Path, read: Callable[[Path], T]) -> T | None:
    return read(file) if file.exists() else None


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
    """Name of the run's configuration: NAME of a folder `<recording>-NAME`, otherwise what the summary holds.

    A folder that `grd replay` named itself (`<recording>-replay-2`) has less detail than the summary (`replay a.b=2`).
    """
    stem = Path(str(summary.get("config", ""))).stem
    suffix = folder.resolve().name.removeprefix(f"{recording}-")
    if suffix != folder.resolve().name and not re.fullmatch(rf"{re.escape(stem)}(-\d+)?", suffix):
        return suffix
    overlays = [Path(str(name)).stem for name in summary.get("overlays", [])]
    sets = [str(text) for text in summary.get("set", []) if not str(text).startswith("viewer.")]
    return " ".join(["+".join([stem, *overlays]), *sets])


def read_output(kind: OutputKind, folder: Path) -> RunTrajectory:
    """Poses with their covariances and marks, in order of time. Fixes of several tracks may share a stamp."""
    if kind is OutputKind.POSE:
        poses_file, covariance_file, upper = results.POSE_FILE, results.POSE_COVARIANCE_FILE, results.POSE_UPPER
    else:
        poses_file, covariance_file = results.FIX_FILE, results.COVARIANCE_FILE
        upper = tuple(f"c{name}_m2" for name in results.UPPER)
    if not (folder / covariance_file).exists():
        poses = read_tum(folder / poses_file, may_be_empty=True)
        return RunTrajectory(kind, poses, why_no_covariance=f"the run has no {covariance_file}")
    table = TextTable(folder / covariance_file, ("stamp_s", *upper))
    track = table.whole_numbers("track_id") if "track_id" in table else None
    one_track = track is None or len(np.unique(track)) < 2
    poses = read_tum(folder / poses_file, may_be_empty=True, in_order=one_track)
    covariance = table.symmetric(upper)
    row_of = {key: row for row, key in enumerate(_occurrences(table.stamps_ns("stamp_s")))}
    rows = np.array([row_of.get(key, -1) for key in _occurrences(poses.stamps_ns)], dtype=np.int64)
    order = np.argsort(poses.stamps_ns, kind="stable")
    poses, rows = poses.take(order), rows[order]
    if absent := int(np.count_nonzero(rows < 0)):
        why = f"{absent} of {len(rows)} lines of {poses_file} have none in {covariance_file}"
        return RunTrajectory(kind, poses, why_no_covariance=why)
    return RunTrajectory(
        kind,
        poses,
        covariance[rows],
        sendable=table.equals("accepted", "1")[rows] if "accepted" in table else None,
        returns=table.whole_numbers("returns")[rows] if "returns" in table else None,
        track=None if track is None else track[rows],
        has_rotation=table.equals("rotation", "1")[rows] if "rotation" in table else None,
    )


def _occurrences(stamps_ns: Iterable[int]) -> list[tuple[int, int]]:
    """Each stamp with the number of times it came before: tracks share stamps, and two files have them in one order."""
    seen: Counter[int] = Counter()
    keys: list[tuple[int, int]] = []
    for stamp in stamps_ns:
        keys.append((int(stamp), seen[stamp]))
        seen[stamp] += 1
    return keys


def _read_searches(path: Path) -> tuple[Search, ...]:
    """The searches of a run: rows of one span are candidates of one search; one without a position has none."""
    table = TextTable(path, ("start_s", "end_s", *XYZ))
    accepted = table.filled("x_m")
    xyz_m = table.numbers(XYZ, accepted)
    spans = np.column_stack([table.stamps_ns("start_s"), table.stamps_ns("end_s")]).tolist()
    rows_of: dict[tuple[int, int], list[int]] = {}
    for row, (start, end) in enumerate(spans):
        rows_of.setdefault((start, end), []).extend([row] if accepted[row] else [])
    return tuple(Search(*span, xyz_m[np.array(rows, dtype=np.int64)]) for span, rows in rows_of.items())


def _read_candidates(path: Path) -> pd.DataFrame:
    table = TextTable(path, ("stamp_s", "candidate", "detector_instance", "probability", *XYZ))
    names = (
        pd.Series(table.text("detector_instance"), dtype=object)
        + " "
        + pd.Series(table.text("candidate"), dtype=object)
    )
    rows = pd.DataFrame(table.numbers(("probability", *XYZ)), columns=["probability", *XYZ])
    rows["telemetry"] = table.filled(TELEMETRY_COLUMN) if TELEMETRY_COLUMN in table else False
    return rows.assign(stamp_ns=table.stamps_ns("stamp_s"), candidate=pd.factorize(names)[0])


def read_rotations(path: Path) -> RotationLog:
    """Read the rotations by both cameras. LinkError names the first wrong line."""
    upper = results.ROTATION_UPPER
    table = TextTable(path, ("stamp_s", "accepted", *results.QUATERNION, *upper, "state", "switches"))
    accepted = table.equals("accepted", "1")
    resolved = table.equals("state", BranchState.RESOLVED.name, list(BranchState.__members__))
    decides = not table.equals("state", BranchState.OPEN.name, list(BranchState.__members__)).any()
    quaternion = table.numbers(results.QUATERNION, accepted)
    quaternion[~accepted] = [0.0, 0.0, 0.0, 1.0]
    if not np.linalg.norm(quaternion, axis=1).all():
        raise LinkError(f"{path}: a quaternion is 0 0 0 0, which is not a rotation")
    R, covariance = rotations_from_xyzw(quaternion), table.symmetric(upper, accepted & table.filled(upper[0]))
    stamps_ns, switches = table.stamps_ns("stamp_s"), table.whole_numbers("switches")
    return RotationLog(stamps_ns, accepted, R, covariance, resolved, decides, switches)


def _check_overlap(run: RunData, truth: Trajectory) -> None:
    """LinkError when an output or the recording lies outside truth's span: two clocks, or the wrong file."""
    recording = [] if run.start_ns is None or run.end_ns is None else [("the recording", [run.start_ns, run.end_ns])]
    outputs = [(str(output.poses.path), output.poses.stamps_ns) for output in run.outputs]
    for name, stamps_ns in [*outputs, *recording]:
        if len(stamps_ns) and (stamps_ns[-1] < truth.stamps_ns[0] or stamps_ns[0] > truth.stamps_ns[-1]):
            raise LinkError(
                f"{run.name}: {name} spans {_span(stamps_ns)}, truth {truth.path} spans {_span(truth.stamps_ns)}: they "
                "do not overlap; both must be on the recording's clock, in seconds"
            )


def _span(stamps_ns: Any) -> str:
    return f"{stamps_ns[0] / 1e9:.3f} .. {stamps_ns[-1] / 1e9:.3f} s"
