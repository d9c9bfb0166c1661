"""Truth of a simulated recording, for the evaluation of a run, and the label of each candidate. It reaches no stage.

`candidates.csv` gets a column `is_drone` when the run has ended: 1 or 0, empty at times without truth.

Source: ours; recording format in recordings/README.md (/truth/*).
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flow.link import LinkError, Record
from links.evaluation.association import EvaluationLimits, drone_labels, follow, interpolate
from links.evaluation.text_files import FULL_POSE, NO_DRONE, read_stamp_ns
from links.recording import RecordingReader
from links.recording.format import MAX_TIME_NS
from links.runs.results import (
    CANDIDATES_FILE,
    TRUTH_FILE,
    TRUTH_RETURNS_FILE,
    TRUTH_VEHICLE_FILE,
    TRUTH_VISIBLE_FILE,
    drone_file,
    stamp_s,
    tum_line,
)
from stages.geometry.frames import rotation_from_quaternion_xyzw
from stages.messages import DroneFix

TOPIC_VEHICLE = "/truth/vehicle"
TRUTH_RECORDING = "truth.mcap"  # next to a live recording of the simulated rig; no run reads it
DRONE_TOPIC = re.compile(r"/truth/(drone|hits|visible)(?:_([1-9]\d*))?")  # /truth/hits_2: drone 2
MAX_GAP_NS = 50_000_000  # the truth is not interpolated across a larger gap
Quaternion = tuple[float, float, float, float]  # x, y, z, w
INVALID = (ValueError, TypeError, KeyError, OverflowError, RecursionError)  # of a record that is no truth
MAX_M = 1e7
NORM_TOLERANCE = 1e-3  # of a quaternion
LABEL, USED = "is_drone", ("stamp_s", "x_m", "y_m", "z_m")  # of the candidate log
CHI2_95_3 = 7.814728  # 95 % quantile of chi-square with 3 degrees of freedom


@dataclass
class TrueDrone:
    """Truth of one drone."""

    pose: dict[int, Any] = field(default_factory=dict)  # T_world_drone by stamp [ns]
    return_ns: list[int] | None = None  # stamps of the pulses that it returned; None: not recorded
    visible: dict[int, bool] | None = None  # from this stamp on: whether the LiDAR has a line of sight to it


@dataclass
class TruthLog:
    """Collects the truth records of a recording."""

    vehicle: dict[int, Any] = field(default_factory=dict)
    drones: dict[int, TrueDrone] = field(default_factory=dict)  # by number, from 1
    invalid: Counter[str] = field(default_factory=Counter)  # records that are left out, by topic

    def without_truth(self, records: Iterable[Record]) -> Iterator[Record]:
        """Yield all records except those of truth, which are stored."""
        for record in records:
            match = DRONE_TOPIC.fullmatch(record.topic)
            if match is None and record.topic != TOPIC_VEHICLE:
                yield record
                continue
            try:
                self._store(match, record)
            except INVALID:
                self.invalid[record.topic] += 1

    def _store(self, match: re.Match[str] | None, record: Record) -> None:
        """Store a record of the vehicle, or of the drone in its topic. Raises one of INVALID."""
        if match is None:
            self.vehicle[record.stamp_ns] = true_pose(record.data)
            return
        drone = self.drones.setdefault(int(match[2] or 1), TrueDrone())
        if match[1] == "drone":
            drone.pose[record.stamp_ns] = true_pose(record.data)
        elif match[1] == "hits":
            pulses = _pulses(record.data)
            drone.return_ns = drone.return_ns or []
            drone.return_ns += pulses
        else:
            visible = _visible(record.data)
            drone.visible = drone.visible or {}
            drone.visible[record.stamp_ns] = visible

    @property
    def no_drone(self) -> bool:
        """Whether the truth states that there is no drone: poses of the vehicle, none of a drone, and none invalid."""
        any_drone = any(drone.pose for drone in self.drones.values()) or any(map(DRONE_TOPIC.fullmatch, self.invalid))
        return bool(self.vehicle) and not any_drone

    def warnings(self) -> list[str]:
        """Topics with invalid records, and how many were left out."""
        return [f"{count} records on {topic} are invalid: left out" for topic, count in self.invalid.items()]

    def add_all(self, records: Iterable[Record]) -> None:
        """Store the truth records among `records`."""
        for _ in self.without_truth(records):
            pass

    def drone_in_vehicle(self, number: int = 1) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Stamps (n,) [ns] and positions (n, 3) [m] of a drone in the vehicle frame, where both poses are known."""
        poses = self.drones[number].pose if number in self.drones else {}
        stamps = sorted(self.vehicle.keys() & poses.keys())
        xyz = np.empty((len(stamps), 3))
        for row, stamp in enumerate(stamps):
            t_vehicle, q_vehicle = self.vehicle[stamp]
            R_world_vehicle = rotation_from_quaternion_xyzw(q_vehicle)
            xyz[row] = R_world_vehicle.T @ (np.asarray(poses[stamp][0]) - np.asarray(t_vehicle))
        return np.array(stamps, dtype=np.int64), xyz

    def rotation_in_vehicle(self, number: int = 1) -> NDArray[np.float64]:
        """Rotations (n, 4) of a drone in the vehicle frame, x, y, z, w, at the stamps of `drone_in_vehicle`."""
        poses = self.drones[number].pose if number in self.drones else {}
        stamps = sorted(self.vehicle.keys() & poses.keys())
        return np.array([_relative(self.vehicle[stamp][1], poses[stamp][1]) for stamp in stamps]).reshape(-1, 4)

    def fix_errors_of(self, fixes: Sequence[DroneFix]) -> FixErrors | None:
        """Errors of the fixes against the drone that their track follows; None when the truth has no drone."""
        numbers = [number for number, drone in sorted(self.drones.items()) if drone.pose]
        paths = [self.drone_in_vehicle(number) for number in numbers]
        if len(paths) < 2:
            return fix_errors(fixes, *paths[0]) if paths else None
        stamps_ns = np.array([fix.stamp_ns for fix in fixes], dtype=np.int64)
        xyz_m = np.array([fix.xyz_vehicle_m for fix in fixes]).reshape(-1, 3)
        tracks = np.array([fix.track_id for fix in fixes], dtype=np.int64)
        followed = follow(stamps_ns, xyz_m, tracks, paths, MAX_GAP_NS).drone
        parts = [
            fix_errors([fix for fix, which in zip(fixes, followed, strict=True) if which == index], *path)
            for index, path in enumerate(paths)
        ]
        stamps = np.concatenate([part.stamps_ns for part in parts])
        order = np.argsort(stamps, kind="stable")
        errors, nees = (np.concatenate([getattr(part, what) for part in parts]) for what in ("error_m", "nees"))
        return FixErrors(stamps[order], errors[order], nees[order], sum(part.without_truth for part in parts))

    def write(self, folder: Path) -> None:
        """Write the truth of the vehicle and of each drone into the folder of a run; no file when there is no truth.

        When there are vehicle poses and no drone, the file states that, unless its records were invalid.
        """
        if any(drone.pose for drone in self.drones.values()):
            for number, drone in self.drones.items():
                if not drone.pose:
                    continue
                self._write_drone(folder, number, drone)
            lines = [tum_line(stamp, np.asarray(t), q) for stamp, (t, q) in sorted(self.vehicle.items())]
            header = f"# T_world_vehicle, {FULL_POSE}, truth\n"
            (folder / TRUTH_VEHICLE_FILE).write_text(header + "".join(lines), encoding="utf-8")
        elif self.no_drone:
            (folder / TRUTH_FILE).write_text(f"# {NO_DRONE} in this recording\n", encoding="utf-8")

    def _write_drone(self, folder: Path, number: int, drone: TrueDrone) -> None:
        lines = [f"# T_vehicle_drone, {FULL_POSE}, truth\n"]
        poses = zip(*self.drone_in_vehicle(number), self.rotation_in_vehicle(number), strict=True)
        lines += [tum_line(int(stamp), position, tuple(q.tolist())) for stamp, position, q in poses]
        (folder / drone_file(TRUTH_FILE, number)).write_text("".join(lines), encoding="utf-8")
        if drone.return_ns is not None:
            returns = "".join(f"{stamp_s(stamp)}\n" for stamp in sorted(drone.return_ns))
            (folder / drone_file(TRUTH_RETURNS_FILE, number)).write_text(f"stamp_s\n{returns}", encoding="utf-8")
        if drone.visible is not None:
            rows = "".join(f"{stamp_s(stamp)},{int(visible)}\n" for stamp, visible in sorted(drone.visible.items()))
            (folder / drone_file(TRUTH_VISIBLE_FILE, number)).write_text(f"stamp_s,visible\n{rows}", encoding="utf-8")


def _relative(a: Quaternion, b: Quaternion) -> Quaternion:
    """a^-1 b of unit quaternions (x, y, z, w)."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx - ax * bw - ay * bz + az * by,
        aw * by + ax * bz - ay * bw - az * bx,
        aw * bz - ax * by + ay * bx - az * bw,
        aw * bw + ax * bx + ay * by + az * bz,
    )


def _pulses(data: bytes) -> list[int]:
    stamps = [int(stamp) for stamp in json.loads(data)["pulse_stamp_ns"]]
    if not all(0 <= stamp <= MAX_TIME_NS for stamp in stamps):
        raise ValueError("a stamp is out of range")
    return stamps


def _visible(data: bytes) -> bool:
    visible = json.loads(data)["visible"]
    if not isinstance(visible, bool):
        raise TypeError(f"visible is {visible!r}")
    return visible


def true_pose(data: bytes) -> tuple[tuple[float, float, float], Quaternion]:
    """Position [m] and rotation of a record of truth. Raises one of INVALID."""
    fields = json.loads(data)
    x, y, z = (float(v) for v in fields["xyz_m"])
    qx, qy, qz, qw = (float(v) for v in fields["quaternion_xyzw"])
    if not all(abs(v) < MAX_M for v in (x, y, z)):  # NaN compares false
        raise ValueError("the position is not finite")
    if not abs(math.hypot(qx, qy, qz, qw) - 1) < NORM_TOLERANCE:
        raise ValueError("the quaternion is no rotation")
    return (x, y, z), (qx, qy, qz, qw)


def read_truth_file(recording: Path) -> TruthLog:
    """The truth that a simulated rig wrote next to a live recording; empty when there is no such file."""
    truth, file = TruthLog(), recording.parent / TRUTH_RECORDING
    if file.is_file() and file != recording:
        with RecordingReader(file) as reader:
            truth.add_all(reader.records())
    return truth


@dataclass(frozen=True, slots=True)
class FixErrors:
    """Errors of fixes against the truth, for fixes at times with truth."""

    stamps_ns: NDArray[np.int64]
    error_m: NDArray[np.float64]  # (n, 3) fix - truth, vehicle axes
    nees: NDArray[np.float64]  # (n,) error^T covariance^-1 error; 3 on average when the covariance is consistent
    without_truth: int  # number of fixes outside the truth or in a gap of it

    @property
    def rmse_xyz_m(self) -> NDArray[np.float64]:
        """Root mean square per axis (3,)."""
        return np.sqrt(np.mean(self.error_m**2, axis=0))

    @property
    def rmse_m(self) -> float:
        """3D root mean square."""
        return float(np.sqrt(np.mean(np.sum(self.error_m**2, axis=1))))

    @property
    def inside_95(self) -> float:
        """Share of fixes whose 95 % ellipsoid contains the truth."""
        return float(np.mean(self.nees <= CHI2_95_3))


def fix_errors(
    fixes: Sequence[DroneFix], stamps_ns: NDArray[np.int64], xyz_vehicle_m: NDArray[np.float64]
) -> FixErrors:
    """Errors of fixes against the truth, interpolated linearly to the stamp of each fix."""
    at_ns = np.array([fix.stamp_ns for fix in fixes], dtype=np.int64)
    known, true_m = interpolate(at_ns, stamps_ns, xyz_vehicle_m, MAX_GAP_NS)
    evaluated = [fix for fix, is_known in zip(fixes, known, strict=True) if is_known]
    error_m = np.array([fix.xyz_vehicle_m for fix in evaluated]).reshape(-1, 3) - true_m[known]
    nees = [float(e @ np.linalg.solve(fix.covariance_m2, e)) for e, fix in zip(error_m, evaluated, strict=True)]
    return FixErrors(at_ns[known], error_m, np.array(nees), len(fixes) - len(evaluated))


def label_candidates(folder: Path, truth: TruthLog) -> str:
    """Add the column `is_drone` to the candidate log of a run with truth. Returns why it cannot be added, or ''."""
    file = folder / CANDIDATES_FILE
    paths = [truth.drone_in_vehicle(number) for number, drone in sorted(truth.drones.items()) if drone.pose]
    if not file.exists() or not (paths or truth.no_drone):
        return ""
    labelled = file.with_suffix(".labelled")
    try:
        rows = np.fromiter(_used(file), np.dtype([("stamp_ns", np.int64), ("xyz_m", np.float64, 3)]))
        known, is_drone = drone_labels(rows["stamp_ns"], rows["xyz_m"], paths, EvaluationLimits())
        labels = [LABEL, *(str(int(drone)) if sure else "" for sure, drone in zip(known, is_drone, strict=True))]
        with file.open(encoding="utf-8", newline="") as lines, labelled.open("w", encoding="utf-8", newline="") as out:
            out.writelines(line.rstrip("\r\n") + f",{label}\r\n" for line, label in zip(lines, labels, strict=True))
        labelled.replace(file)
    except (OSError, ValueError, LinkError) as error:  # a live run may have lost lines to a full disk
        labelled.unlink(missing_ok=True)
        return f"{CANDIDATES_FILE} has no column {LABEL}: {error}. To get it, replay the recording"
    return ""


def _used(file: Path) -> Iterator[tuple[int, tuple[float, float, float]]]:
    """Stamp [ns] and position [m], vehicle frame, of each row."""
    with file.open(encoding="utf-8", newline="") as stream:
        for number, row in enumerate(csv.DictReader(stream), start=2):
            if any(row.get(name) is None for name in USED):
                raise LinkError(f"line {number} is cut off")
            stamp_s, x, y, z = (row[name] for name in USED)
            yield read_stamp_ns(stamp_s, f"line {number}"), (float(x), float(y), float(z))
