"""Inputs of the fusion in a recorded flight, taken from a replay once, so that they can be fused repeatedly.

`judge` compares the poses with the truth.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from flow.graph import Graph
from flow.link import Tap
from flow.replay import Replay
from flow.stage import input_ports
from links.recording import RecordingReader
from links.runs.request import RunRequest
from links.runs.truth import TruthLog
from stages.fuse import Fuse
from stages.geometry.frames import rotation_from_quaternion_xyzw, rotation_z
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import DroneFix, PoseEstimate, PoseState, RelativePose, RelativeRotation
from tests.stages.fuse.fuse_inputs import Event, Fault, poses_of, rotation
from tests.stages.fuse.imu_flights import gauss_markov

CHI2_95_3 = 7.814728


@dataclass
class RecordedFlight:
    """A flight: inputs of the fusion, in order, and the true pose of the drone in the vehicle frame."""

    name: str
    events: list[Event]
    truth_ns: np.ndarray
    truth_xyz_m: np.ndarray
    truth_R: np.ndarray

    def truth(self, stamp_ns: int) -> tuple[np.ndarray, np.ndarray] | None:
        """R_vehicle_drone and position at a time; None where there is no truth."""
        i = int(np.searchsorted(self.truth_ns, stamp_ns))
        if i == 0 or i >= len(self.truth_ns):
            return None
        a, b = self.truth_ns[i - 1], self.truth_ns[i]
        share = (stamp_ns - a) / (b - a)
        turn = log_rotation(self.truth_R[i - 1].T @ self.truth_R[i])
        return self.truth_R[i - 1] @ exp_rotation(share * turn), (
            (1 - share) * self.truth_xyz_m[i - 1] + share * self.truth_xyz_m[i]
        )

    def fuse(self, stage: Fuse | None = None, fault: Fault | None = None) -> list[RelativePose]:
        """Poses of the fusion of these inputs, with a fault."""
        return poses_of(stage or Fuse(), fault(self.events) if fault else self.events)


def recorded_inputs(recording: Path, config: Path, fuse: str = "fuse") -> RecordedFlight:
    """Replay a recording and keep the inputs of its fusion."""
    truth = TruthLog()
    with RecordingReader(recording) as reader:
        graph = RunRequest(config, sets=("viewer.file=null",)).graph(reader.rig_yaml, str(recording))
        tap = InputTap(graph, fuse)
        runner = Replay(graph, (tap,))
        for record in truth.without_truth(reader.records()):
            runner.feed(record)
        runner.finish()
    return flown(recording.stem, tap, truth)


def flown(name: str, tap: InputTap, truth: TruthLog) -> RecordedFlight:
    """The flight of the recorded inputs, with the truth."""
    poses = truth.drones[1].pose
    stamps = sorted(truth.vehicle.keys() & poses.keys())
    R, xyz = [], []
    for stamp in stamps:
        (t_vehicle, q_vehicle), (t_drone, q_drone) = truth.vehicle[stamp], poses[stamp]
        R_world_vehicle = rotation_from_quaternion_xyzw(q_vehicle)
        R.append(R_world_vehicle.T @ rotation_from_quaternion_xyzw(q_drone))
        xyz.append(R_world_vehicle.T @ (np.asarray(t_drone) - np.asarray(t_vehicle)))
    return RecordedFlight(name, tap.all(), np.array(stamps), np.array(xyz), np.array(R))


class InputTap(Tap):
    """Keeps the inputs of one stage, in the order of the replay."""

    def __init__(self, graph: Graph, consumer: str) -> None:
        super().__init__()
        order = list(input_ports(graph.nodes[consumer].cls))
        edges = [e for e in graph.edges if e.consumer == consumer]
        self._ports = {f"{e.producer}.{e.output}": (order.index(e.port), e.port) for e in edges}
        self._events: list[tuple[int, int, int, Event]] = []

    def see(self, output, message, arrival_ns) -> None:
        if output in self._ports:
            index, port = self._ports[output]
            self._events.append((arrival_ns, index, len(self._events), (arrival_ns, port, message)))

    def all(self) -> list[Event]:
        return [event for *_, event in sorted(self._events, key=lambda e: e[:3])]


def with_rotations(flown: RecordedFlight, after_s: float = 2.0, seed: int = 3) -> RecordedFlight:
    """The same flight with rotations of one branch of four, five times a second, as accurate as `align`'s in Manhattan."""
    rng = np.random.default_rng(seed)
    first = flown.events[0][0]
    times = np.arange(after_s, (flown.truth_ns[-1] - first) * 1e-9 - 0.1, 0.2)
    off = gauss_markov(rng, math.radians(0.3), 1.0, 0.2, len(times))
    branch = rotation_z(0.5 * math.pi * int(rng.integers(4)))
    more: list[Event] = []
    for t, e in zip(times, off, strict=True):
        stamp_ns = first + round(t * 1e9)
        true = flown.truth(stamp_ns)
        if true is None:
            continue
        message = rotation(0.0, branch @ true[0] @ exp_rotation(e), math.radians(0.3))
        more.append((stamp_ns + 80_000_000, "rotation", replace(message, stamp_ns=stamp_ns)))
    events = [e for e in flown.events if not isinstance(e[2], RelativeRotation)] + more
    return replace(flown, events=sorted(events, key=lambda e: e[0]))


# comparison with the truth


@dataclass
class Row:
    """Result of a flight, or of several together; errors of each pose with a position."""

    error_m: list[float] = field(default_factory=list)
    nees3: list[float] = field(default_factory=list)
    angle_deg: list[float] = field(default_factory=list)  # of those with a rotation
    states: Counter[PoseState] = field(default_factory=Counter)
    longest_gap_s: float = 0.0
    wrong_quarter_full: int = 0  # poses with a rotation more than 45 deg off
    state_of: list[PoseState] = field(default_factory=list)  # of each error
    age_s: list[float] = field(default_factory=list)  # since the newest LiDAR position, of each error
    range_m: list[float] = field(default_factory=list)
    fix_error_m: list[float] = field(default_factory=list)

    def inside(self, rows: np.ndarray | None = None) -> float:
        nees = np.array(self.nees3) if rows is None else np.array(self.nees3)[rows]
        return 100 * float((nees <= CHI2_95_3).mean()) if len(nees) else math.nan


def add_errors(row: Row, pose: RelativePose, R: np.ndarray, xyz_m: np.ndarray) -> None:
    """Add the error of a pose with a position, and its NEES; its axes are the drone's where the rotation is known."""
    estimate = pose.estimate
    e = estimate.xyz_vehicle_m - xyz_m
    row.error_m.append(float(np.linalg.norm(e)))
    if isinstance(estimate, PoseEstimate):
        e = estimate.R_vehicle_drone.T @ e
        row.nees3.append(float(e @ np.linalg.solve(estimate.covariance[3:, 3:], e)))
        turn = log_rotation(estimate.R_vehicle_drone.T @ R)
        row.angle_deg.append(math.degrees(float(np.linalg.norm(turn))))
    else:
        row.nees3.append(float(e @ np.linalg.solve(estimate.covariance_vehicle_m2, e)))


def judge(flown: RecordedFlight, poses: list[RelativePose], into: Row | None = None) -> Row:
    """Poses against the truth; the gap is between two outputs, from the first to the end of the inputs."""
    row = into or Row()
    stamps = [p.stamp_ns for p in poses] + [max(e[2].stamp_ns for e in flown.events)]
    row.longest_gap_s = max(row.longest_gap_s, float(np.diff(stamps).max()) * 1e-9)
    for pose in poses:
        row.states[pose.state] += 1
        true = flown.truth(pose.stamp_ns)
        if pose.estimate is None or true is None:
            continue
        R, xyz = true
        add_errors(row, pose, R, xyz)
        row.state_of.append(pose.state)
        row.age_s.append((pose.stamp_ns - (pose.measured_ns or pose.stamp_ns)) * 1e-9)
        row.range_m.append(float(np.linalg.norm(xyz)))
        if pose.R_vehicle_drone is not None:
            row.wrong_quarter_full += row.angle_deg[-1] > 45.0
    return row


def fixes_of(flown: RecordedFlight) -> list[DroneFix]:
    return [m for _, _, m in flown.events if isinstance(m, DroneFix)]
