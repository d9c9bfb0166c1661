"""Truth of a simulated recording, for judging a run after it is done. Nothing of it reaches a stage.

Source: ours; recording format in recordings/README.md (/truth/*).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flow.link import LinkError, Record
from links.evaluation.association import follow, interpolate
from links.evaluation.text_files import FULL_POSE, NO_DRONE
from links.runs.results import (
    TRUTH_FILE,
    TRUTH_HITS_FILE,
    TRUTH_VEHICLE_FILE,
    TRUTH_VISIBLE_FILE,
    of_drone,
    stamp_s,
    tum_line,
)
from stages.geometry.frames import rotation_from_quaternion_xyzw
from stages.messages import DroneFix

TOPIC_VEHICLE = "/truth/vehicle"
TRUTH_RECORDING = "truth.mcap"  # beside a live recording of the simulated rig: the truth, which no run takes in
OF_A_DRONE = re.compile(r"/truth/(drone|hits|visible)(?:_([1-9]\d*))?")  # /truth/hits_2 is of drone 2
MAX_GAP_NS = 50_000_000  # truth further apart than this is not interpolated over
Quaternion = tuple[float, float, float, float]  # x, y, z, w
CHI2_95_3 = 7.814728  # 95 % quantile of chi-square with 3 degrees of freedom


@dataclass
class TrueDrone:
    """What a recording's truth says of one drone."""

    pose: dict[int, Any] = field(default_factory=dict)  # T_world_drone by stamp [ns]
    hits_ns: list[int] | None = None  # pulses that it returned; None: the recording does not say
    visible: dict[int, bool] | None = None  # whether the LiDAR has a line of sight to it, since when


@dataclass
class TruthLog:
    """Sets truth records aside while a recording streams by."""

    vehicle: dict[int, Any] = field(default_factory=dict)
    drones: dict[int, TrueDrone] = field(default_factory=dict)  # by number, from 1

    def aside(self, records: Iterable[Record]) -> Iterator[Record]:
        """Pass on all records but those of truth, which are kept here."""
        for record in records:
            of_a_drone = OF_A_DRONE.fullmatch(record.topic)
            if record.topic == TOPIC_VEHICLE:
                self.vehicle[record.stamp_ns] = _pose(record)
            elif of_a_drone:
                drone = self.drones.setdefault(int(of_a_drone[2] or 1), TrueDrone())
                _keep(drone, of_a_drone[1], record)
            else:
                yield record

    def take(self, records: Iterable[Record]) -> None:
        """Keep what of these records is truth."""
        for _ in self.aside(records):
            pass

    def drone_in_vehicle(self, number: int = 1) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Stamps (n,) [ns] and a drone's position in the vehicle frame (n, 3) [m], where both poses are known."""
        poses = self.drones[number].pose if number in self.drones else {}
        stamps = sorted(self.vehicle.keys() & poses.keys())
        xyz = np.empty((len(stamps), 3))
        for row, stamp in enumerate(stamps):
            t_vehicle, q_vehicle = self.vehicle[stamp]
            R_world_vehicle = rotation_from_quaternion_xyzw(q_vehicle)
            xyz[row] = R_world_vehicle.T @ (np.asarray(poses[stamp][0]) - np.asarray(t_vehicle))
        return np.array(stamps, dtype=np.int64), xyz

    def errors_of(self, fixes: Sequence[DroneFix]) -> FixErrors | None:
        """Each fix against the drone that its track follows; None when there was none."""
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
        return FixErrors(stamps[order], errors[order], nees[order], sum(part.not_covered for part in parts))

    def write(self, folder: Path) -> None:
        """Write what is known of the vehicle and each drone beside a run's results; nothing when that is nothing.

        A recording that knows where the vehicle is and has no drone gives a file that says so.
        """
        if any(drone.pose for drone in self.drones.values()):
            for number, drone in self.drones.items():
                self._write_drone(folder, number, drone)
            lines = [tum_line(stamp, np.asarray(t), q) for stamp, (t, q) in sorted(self.vehicle.items())]
            header = f"# T_world_vehicle, {FULL_POSE}, truth\n"
            (folder / TRUTH_VEHICLE_FILE).write_text(header + "".join(lines), encoding="utf-8")
        elif self.vehicle:
            (folder / TRUTH_FILE).write_text(f"# {NO_DRONE} in this recording\n", encoding="utf-8")

    def _write_drone(self, folder: Path, number: int, drone: TrueDrone) -> None:
        lines = [f"# T_vehicle_drone, {FULL_POSE}, truth\n"]
        for stamp, position in zip(*self.drone_in_vehicle(number), strict=True):
            stamp_ns = int(stamp)
            q = _relative(self.vehicle[stamp_ns][1], drone.pose[stamp_ns][1])
            lines.append(tum_line(stamp_ns, position, q))
        (folder / of_drone(TRUTH_FILE, number)).write_text("".join(lines), encoding="utf-8")
        if drone.hits_ns is not None:
            hits = "".join(f"{stamp_s(stamp)}\n" for stamp in sorted(drone.hits_ns))
            (folder / of_drone(TRUTH_HITS_FILE, number)).write_text(f"stamp_s\n{hits}", encoding="utf-8")
        if drone.visible is not None:
            rows = "".join(f"{stamp_s(stamp)},{int(seen)}\n" for stamp, seen in sorted(drone.visible.items()))
            (folder / of_drone(TRUTH_VISIBLE_FILE, number)).write_text(f"stamp_s,visible\n{rows}", encoding="utf-8")


def _keep(drone: TrueDrone, what: str, record: Record) -> None:
    if what == "drone":
        drone.pose[record.stamp_ns] = _pose(record)
    elif what == "hits":
        drone.hits_ns = drone.hits_ns or []
        drone.hits_ns += _pulses(record)
    else:
        drone.visible = drone.visible or {}
        drone.visible[record.stamp_ns] = _visible(record)


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


def _pulses(record: Record) -> list[int]:
    try:
        return [int(stamp) for stamp in json.loads(record.data)["pulse_stamp_ns"]]
    except (ValueError, TypeError, KeyError) as error:
        raise LinkError(f"{record.topic} at {record.stamp_ns} ns holds no pulses ({error!r})") from None


def _visible(record: Record) -> bool:
    try:
        visible = json.loads(record.data)["visible"]
    except (ValueError, TypeError, KeyError) as error:
        raise LinkError(f"{record.topic} at {record.stamp_ns} ns does not say what is visible ({error!r})") from None
    if not isinstance(visible, bool):
        raise LinkError(f"{record.topic} at {record.stamp_ns} ns: visible is {visible!r}, neither true nor false")
    return visible


def _pose(record: Record) -> tuple[tuple[float, float, float], Quaternion]:
    try:
        fields = json.loads(record.data)
        x, y, z = (float(v) for v in fields["xyz_m"])
        qx, qy, qz, qw = (float(v) for v in fields["quaternion_xyzw"])
    except (ValueError, TypeError, KeyError) as error:
        raise LinkError(
            f"{record.topic} at {record.stamp_ns} ns holds no pose ({error!r}): was it recorded by grd?"
        ) from None
    return (x, y, z), (qx, qy, qz, qw)


@dataclass(frozen=True, slots=True)
class FixErrors:
    """Errors of fixes against truth, for the fixes that truth covers."""

    stamps_ns: NDArray[np.int64]
    error_m: NDArray[np.float64]  # (n, 3) fix - truth, vehicle axes
    nees: NDArray[np.float64]  # (n,) error^T covariance^-1 error; 3 on average when the covariance is honest
    not_covered: int  # fixes outside truth or in a gap of it

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
        """Share of fixes whose 95 % ellipsoid holds the truth."""
        return float(np.mean(self.nees <= CHI2_95_3))


def fix_errors(
    fixes: Sequence[DroneFix], stamps_ns: NDArray[np.int64], xyz_vehicle_m: NDArray[np.float64]
) -> FixErrors:
    """Compare each fix with truth interpolated linearly to the fix's own stamp."""
    at_ns = np.array([fix.stamp_ns for fix in fixes], dtype=np.int64)
    known, true_m = interpolate(at_ns, stamps_ns, xyz_vehicle_m, MAX_GAP_NS)
    judged = [fix for fix, is_known in zip(fixes, known, strict=True) if is_known]
    error_m = np.array([fix.xyz_vehicle_m for fix in judged]).reshape(-1, 3) - true_m[known]
    nees = [float(e @ np.linalg.solve(fix.covariance_m2, e)) for e, fix in zip(error_m, judged, strict=True)]
    return FixErrors(at_ns[known], error_m, np.array(nees), len(fixes) - len(judged))
