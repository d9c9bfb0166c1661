"""What a run leaves for people: fixes and poses as TUM trajectories and covariance tables, and a text log.

Source: DESIGN, Outputs of a run. TUM lines are `stamp_s tx ty tz qx qy qz qw` of T_vehicle_drone.
"""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flow.link import Run, Tap
from flow.message import Message
from flow.stage import Settings
from links.mavlink.poses.gate import PoseLimits
from links.mavlink.poses.position_gate import gate_reason
from links.mavlink.profiles import YawOutput
from links.runs.fix_log import FixLog
from links.runs.result_file import ResultFile
from stages.geometry.frames import quaternions_xyzw
from stages.messages import (
    CandidateEvidence,
    CandidateLog,
    CueFactor,
    CueState,
    DepthImage,
    Detections,
    DroneFix,
    PoseEstimate,
    PoseState,
    PositionEstimate,
    RelativePose,
    RelativeRotation,
    SearchResult,
    TrackState,
)

FIX_FILE, COVARIANCE_FILE, LOG_FILE = "fix_vehicle_drone.tum", "fix_covariance.csv", "run.log"
DETECTIONS_FILE, SUMMARY_FILE = "detections.csv", "summary.json"
TRUTH_FILE, TRUTH_RETURNS_FILE = "truth_vehicle_drone.tum", "truth_returns.csv"
TRUTH_VISIBLE_FILE, TRUTH_VEHICLE_FILE = "truth_visible.csv", "truth_world_vehicle.tum"
POSE_FILE, POSE_COVARIANCE_FILE = "pose_vehicle_drone.tum", "pose_covariance.csv"
ROTATION_FILE, CANDIDATES_FILE = "rotation_vehicle_drone.csv", "candidates.csv"
UPPER = tuple(a + b for a, b in zip("xxxyyz", "xyzyzz", strict=True))  # upper triangle of a 3x3 matrix, by rows
QUATERNION, ROTATION_UPPER = ("qx", "qy", "qz", "qw"), tuple(f"c{name}_rad2" for name in UPPER)  # empty: not known
BRANCHES = ("p_0", "p_90", "p_180", "p_270")  # probability of each yaw branch: the rotation, and turned by [deg]
POSITION_ONLY = (
    "# T_vehicle_drone, position only: the LiDAR does not measure orientation, '0 0 0 1' means not measured\n"
)
POSE_UPPER = tuple(f"c{a}{b}" for a in range(6) for b in range(a, 6))  # rotation [rad] before translation [m]
POSE_HEAD = "# T_vehicle_drone, fused; '0 0 0 1' where the rotation is unknown: the covariance table has rotation 0\n"
UNKNOWN_RAD2 = math.pi**2  # variance of an unknown rotation in the table, which has no infinity
UPPER_3, UPPER_6 = np.triu_indices(3), np.triu_indices(6)
WRITTEN = (
    DroneFix,
    DepthImage,
    Detections,
    CandidateLog,
    TrackState,
    RelativeRotation,
    RelativePose,
    CueState,
    CueFactor,
)


def drone_file(name: str, number: int) -> str:
    """`truth_returns.csv` for drone 1, `truth_returns_2.csv` for drone 2."""
    stem, suffix = name.rsplit(".", 1)
    return name if number == 1 else f"{stem}_{number}.{suffix}"


def stamp_s(stamp_ns: int) -> str:
    """Nanoseconds as decimal seconds, exactly."""
    return f"{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000:09d}"


def tum_line(stamp_ns: int, xyz_m: NDArray[np.float64], quaternion_xyzw: tuple[float, ...] = (0, 0, 0, 1)) -> str:
    """One line of a TUM file."""
    x, y, z = xyz_m.tolist()
    qx, qy, qz, qw = quaternion_xyzw
    return f"{stamp_s(stamp_ns)} {x:.6f} {y:.6f} {z:.6f} {qx:g} {qy:g} {qz:g} {qw:g}\n"


@dataclass(frozen=True, slots=True)
class Transition:
    """A change of a track's state."""

    stamp_ns: int
    state: str
    reason: str
    track_id: int = 1


class ResultsSettings(Settings):
    """Settings of `Results`."""

    limits: PoseLimits = PoseLimits()  # of the autopilot's gate: which poses it accepts
    yaw: YawOutput = "none"  # what is sent to the autopilot


class Results(Tap[ResultsSettings]):
    """Collects fixes, search results and state changes, and writes each when it arrives: an interrupted run keeps them.

    The files of rotations, fused poses and candidates exist only when a stage publishes those messages.
    """

    def __init__(self, settings: ResultsSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._left_out: Collection[str] = ()
        self._files: dict[str, ResultFile] = {}
        self._live: bool = False
        self._covariance: Any = None
        self._detections: Any = None
        self._candidates: Any = None
        self._rotations: Any = None
        self._poses: Any = None
        self._sweep_start_ns: dict[int, int] = {}  # of the newest depth image, by its stamp
        self._last_sweep_ns: int | None = None
        self._fixes = FixLog()
        self._searches: Counter[SearchResult] = Counter()
        self._examples: dict[SearchResult, str] = {}  # first summary of each
        self._transitions: list[Transition] = []
        self._state: dict[int, str] = {}  # of each track
        self._pose_state: PoseState | None = None
        self._pose_states: Counter[str] = Counter()
        self._pose_reason: str = ""
        self._rejected: Counter[str] = Counter()  # poses, by the gate's reason
        self._trusted: dict[str, bool] = {}  # cues, by source
        self._fused: dict[str, bool] = {}  # cues in the fusion: whether used, by source
        self._resets: int = 0
        self._branch: tuple[str, int] | None = None  # state and switches of the newest rotation

    def without(self, nodes: Collection[str]) -> Results:
        """The same, leaving out the messages of some nodes: those of another drone."""
        self._left_out = nodes
        return self

    @property
    def fixes(self) -> Sequence[DroneFix]:
        """All drone fixes, in order."""
        return self._fixes

    @property
    def sweeps_with_drone(self) -> int:
        """Sweeps in which the detector accepted a candidate."""
        return self._searches[SearchResult.DRONE]

    @property
    def sweeps(self) -> int:
        """Sweeps that the detector searched."""
        return sum(self._searches.values())

    @property
    def search_results(self) -> list[tuple[SearchResult, int, str]]:
        """Results of the searches with their counts and the detector's first summary of each, most frequent first."""
        return [(result, count, self._examples[result]) for result, count in self._searches.most_common()]

    @property
    def pose_states(self) -> dict[str, int]:
        """Number of poses in each state, most frequent first; empty without a fuse stage."""
        return dict(self._pose_states.most_common())

    @property
    def gate_rejections(self) -> dict[str, int]:
        """Number of poses that the autopilot's gate rejects at their own time, by reason, most frequent first."""
        return dict(self._rejected.most_common())

    @property
    def pose_reason(self) -> str:
        """Why the newest pose has its state."""
        return self._pose_reason

    @property
    def resets(self) -> int:
        """Number of jumps of the fused pose."""
        return self._resets

    @property
    def transitions(self) -> list[Transition]:
        """State changes of all tracks with their reasons, in order of arrival."""
        return self._transitions

    def open(self, run: Run) -> None:
        """Open the files of the run."""
        self._folder, self._live = run.out_dir, run.live
        for name in (FIX_FILE, COVARIANCE_FILE, DETECTIONS_FILE, LOG_FILE):
            self._files[name] = self._file(name)
        for name in (ROTATION_FILE, POSE_FILE, POSE_COVARIANCE_FILE, CANDIDATES_FILE):
            (run.out_dir / name).unlink(missing_ok=True)
        self._files[FIX_FILE].write(POSITION_ONLY)
        self._covariance = csv.writer(self._files[COVARIANCE_FILE])
        upper = [f"c{name}_m2" for name in UPPER]
        self._covariance.writerow(["stamp_s", *upper, "returns", "iterations", "track_id"])
        self._detections = csv.writer(self._files[DETECTIONS_FILE])
        self._detections.writerow(["start_s", "end_s", "x_m", "y_m", "z_m", "score"])

    def wants(self, message: type[Message]) -> bool:
        """Only messages that the files hold."""
        return message in WRITTEN

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Write a message to its file."""
        if self._left_out and output.partition(".")[0] in self._left_out:
            return
        if isinstance(message, DroneFix):
            self._fixes.append(message)
            self._files[FIX_FILE].write(tum_line(message.stamp_ns, message.xyz_vehicle_m))
            upper = message.covariance_m2[UPPER_3]
            iterations = "" if message.mean_shift is None else message.mean_shift.iterations
            counts = [message.hits, iterations, message.track_id]
            self._covariance.writerow([stamp_s(message.stamp_ns), *_digits(upper), *counts])
        elif isinstance(message, DepthImage):
            self._sweep_start_ns = {message.stamp_ns: message.start_ns}
        elif isinstance(message, Detections):
            self._write_detections(message)
            self._searches[message.result] += 1
            self._examples.setdefault(message.result, message.summary)
            self._log(message.stamp_ns, output, message.summary)
        elif isinstance(message, CandidateLog):
            self._write_candidates(message)
        elif isinstance(message, TrackState):
            self._note_state(output, message)
        elif isinstance(message, RelativeRotation):
            self._write_rotation(output, message)
        elif isinstance(message, RelativePose):
            self._write_pose(output, message)
        elif isinstance(message, CueState) and self._trusted.get(message.source) != message.trusted:
            self._trusted[message.source] = message.trusted
            self._log(message.stamp_ns, output, f"{message.source}: {message.reason}")
        elif isinstance(message, CueFactor):
            self._note_cue(output, message)

    def _note_cue(self, output: str, message: CueFactor) -> None:
        """Log when the fusion begins to use a cue, and when that contradicts."""
        if not (message.used or message.contradicts) or self._fused.get(message.source) == message.used:
            return
        self._fused[message.source] = message.used
        self._log(message.stamp_ns, output, f"{message.source}: {message.reason}")

    def _note_state(self, output: str, message: TrackState) -> None:
        """Store and log the state of a track when it changes."""
        state, number = message.state.name, message.track_id
        if self._state.get(number) == state:
            return
        self._state[number] = state
        self._transitions.append(Transition(message.stamp_ns, state, message.reason, number))
        who = f"track {number} " if number > 1 else ""
        self._log(message.stamp_ns, output, f"{who}{state}: {message.reason}")

    def _write_detections(self, message: Detections) -> None:
        """Write a line per accepted candidate, best first; a search without one is a line without a position.

        The start of a search is in its message, else it is that of its depth image, else the end of the search before.
        """
        evidence = message.evidence
        if isinstance(evidence, CandidateEvidence):
            start_ns, scores = evidence.start_ns, evidence.log_odds
        else:
            previous_ns = self._last_sweep_ns if self._last_sweep_ns is not None else message.stamp_ns
            start_ns, scores = self._sweep_start_ns.get(message.stamp_ns, previous_ns), evidence.e
        self._last_sweep_ns = message.stamp_ns
        span = [stamp_s(start_ns), stamp_s(message.stamp_ns)]
        accepted = zip(message.xyz_vehicle_m[message.accepted], scores[message.accepted], strict=True)
        lines = [[*span, *(f"{v:.4f}" for v in xyz), f"{score:.6g}"] for xyz, score in accepted]
        self._detections.writerows(lines or [[*span, "", "", "", ""]])

    def _write_candidates(self, message: CandidateLog) -> None:
        """Write a line per classified candidate: position, probability that it is a drone, and its features."""
        if self._candidates is None:
            self._files[CANDIDATES_FILE] = self._file(CANDIDATES_FILE)
            self._candidates = csv.writer(self._files[CANDIDATES_FILE])
            head = ["stamp_s", "candidate", "detector_instance", "probability", "x_m", "y_m", "z_m"]
            self._candidates.writerow([*head, *message.feature_names])
        for i, number in enumerate(message.candidate_id.tolist()):
            xyz = [f"{v:.3f}" for v in message.xyz_vehicle_m[i].tolist()]
            features = (len(message.feature_names) * ",%.5g" % tuple(message.features[i].tolist())).replace("nan", "")
            values = [
                number,
                message.detector_instance,
                f"{message.probability[i]:.6g}",
                *xyz,
                *features[1:].split(","),
            ]
            self._candidates.writerow([stamp_s(int(message.seen_ns[i])), *values])

    def _write_rotation(self, output: str, message: RelativeRotation) -> None:
        """Write a line per message, also without a rotation; log changes of the state and of the yaw branch."""
        if self._rotations is None:
            self._files[ROTATION_FILE] = self._file(ROTATION_FILE)
            self._rotations = csv.writer(self._files[ROTATION_FILE])
            head = ["stamp_s", "accepted", *QUATERNION, *ROTATION_UPPER, *BRANCHES, "state", "switches", "reason"]
            self._rotations.writerow(head)
        R, covariance_rad2 = message.R_vehicle_drone, message.covariance_rad2
        quaternion = [""] * 4 if R is None else _digits(quaternions_xyzw(R[None])[0])
        upper = [""] * 6 if covariance_rad2 is None else _digits(covariance_rad2[UPPER_3])
        values = [*_digits(message.branch_probability), message.state.name, message.switches, message.reason]
        self._rotations.writerow([stamp_s(message.stamp_ns), int(R is not None), *quaternion, *upper, *values])
        branch = message.state.name, message.switches
        if branch != self._branch:
            self._branch = branch
            self._log(message.stamp_ns, output, f"{message.state.name}: {message.reason}")

    def _write_pose(self, output: str, message: RelativePose) -> None:
        """Write a line per pose with a known position; log changes of the state.

        `rotation`: whether it is known; if not, the covariance of the position is in vehicle axes. `accepted`:
        whether the autopilot's gate accepts the pose at its own time.
        """
        self._pose_states[message.state.name] += 1
        rejected = gate_reason(message, message.stamp_ns, self.settings.limits, self.settings.yaw)
        if rejected is not None:
            self._rejected[rejected.value] += 1
        self._resets, self._pose_reason = message.resets, message.reason
        if message.state is not self._pose_state:
            self._pose_state = message.state
            self._log(message.stamp_ns, output, f"{message.state.name}: {message.reason}")
        if self._poses is None:
            for name in (POSE_FILE, POSE_COVARIANCE_FILE):
                self._files[name] = self._file(name)
            self._files[POSE_FILE].write(POSE_HEAD)
            self._poses = csv.writer(self._files[POSE_COVARIANCE_FILE])
            head = ["state", "accepted", "rotation", "resets", "nis", "measured_s", "track_id"]
            self._poses.writerow(["stamp_s", *POSE_UPPER, *head])
        estimate, R = message.estimate, message.R_vehicle_drone
        if estimate is None:
            return
        q = (0.0, 0.0, 0.0, 1.0) if R is None else tuple(quaternions_xyzw(R[None])[0].tolist())
        self._files[POSE_FILE].write(tum_line(message.stamp_ns, estimate.xyz_vehicle_m, q))
        upper = _covariance(estimate)[UPPER_6]
        measured = "" if message.measured_ns is None else stamp_s(message.measured_ns)
        nis = "" if math.isnan(message.nis) else f"{message.nis:.4g}"
        values = [
            message.state.name,
            int(rejected is None),
            int(R is not None),
            message.resets,
            nis,
            measured,
            message.track_id,
        ]
        self._poses.writerow([stamp_s(message.stamp_ns), *_digits(upper), *values])

    def _file(self, name: str) -> ResultFile:
        return ResultFile(self._folder / name, tolerant=self._live)

    @property
    def status(self) -> str | None:
        """Reports that results of a live run cannot be written; None: all are written."""
        error = next((file.status for file in tuple(self._files.values()) if file.status), None)
        return (
            None
            if error is None
            else f"{self._folder}: results are being lost ({error}): free disk space; the run continues"
        )

    def note(self, text: str) -> None:
        """Append a line without a time to the log: a warning of the recording, the output hash."""
        self._files[LOG_FILE].write(f"{text}\n")

    def _log(self, stamp_ns: int, output: str, text: str) -> None:
        self.note(f"{stamp_s(stamp_ns)} {output}: {text}")

    def close(self) -> None:
        """Close the files of the run."""
        for stream in self._files.values():
            stream.close()
        self._files.clear()


def _covariance(estimate: PositionEstimate | PoseEstimate) -> NDArray[np.float64]:
    """(6, 6) of T_vehicle_drone; UNKNOWN_RAD2 for a rotation that is not known."""
    if isinstance(estimate, PoseEstimate):
        return estimate.covariance
    covariance = np.diag([UNKNOWN_RAD2] * 3 + [0.0] * 3)
    covariance[3:, 3:] = estimate.covariance_vehicle_m2
    return covariance


def _digits(values: NDArray[np.float64]) -> list[str]:
    return [f"{value:.9g}" for value in values.tolist()]
