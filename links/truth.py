"""Truth of a simulated recording, for judging a run after it is done. Nothing of it reaches a stage.

Source: ours; recording format in recordings/README.md (/truth/*).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flow.link import LinkError, Record
from links.evaluation.associate import interpolate
from links.evaluation.tum import FULL_POSE, NO_DRONE
from links.results import TRUTH_FILE, TRUTH_HITS_FILE, stamp_s, tum_line
from stages.geometry import rotation_from_quaternion_xyzw
from stages.messages import DroneFix

TOPIC_VEHICLE, TOPIC_DRONE, TOPIC_HITS = "/truth/vehicle", "/truth/drone", "/truth/hits"
MAX_GAP_NS = 50_000_000  # truth further apart than this is not interpolated over
Quaternion = tuple[float, float, float, float]  # x, y, z, w
CHI2_95_3 = 7.814728  # 95 % quantile of chi-square with 3 degrees of freedom


@dataclass
class TruthLog:
    """Sets truth records aside while a recording streams by."""

    vehicle: dict[int, Any] = field(default_factory=dict)
    drone: dict[int, Any] = field(default_factory=dict)
    hits_ns: list[int] | None = None  # pulses that the drone returned; None: the recording does not say

    def aside(self, records: Iterable[Record]) -> Iterator[Record]:
        """Pass on all records but those of truth, which are kept here."""
        for record in records:
            if record.topic == TOPIC_VEHICLE:
                self.vehicle[record.stamp_ns] = _pose(record)
            elif record.topic == TOPIC_DRONE:
                self.drone[record.stamp_ns] = _pose(record)
            elif record.topic == TOPIC_HITS:
                self.hits_ns = self.hits_ns or []
                self.hits_ns += _pulses(record)
            else:
                yield record

    def drone_in_vehicle(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Stamps (n,) [ns] and the drone's position in the vehicle frame (n, 3) [m], where both poses are known."""
        stamps = self._stamps()
        xyz = np.empty((len(stamps), 3))
        for row, stamp in enumerate(stamps):
            t_vehicle, q_vehicle = self.vehicle[stamp]
            R_world_vehicle = rotation_from_quaternion_xyzw(q_vehicle)
            xyz[row] = R_world_vehicle.T @ (np.asarray(self.drone[stamp][0]) - np.asarray(t_vehicle))
        return np.array(stamps, dtype=np.int64), xyz

    def write(self, folder: Path) -> None:
        """Write T_vehicle_drone and the drone's hits beside a run's results; nothing when the recording holds no truth.

        A recording that knows where the vehicle is and has no drone gives a file that says so.
        """
        if not self.vehicle and not self.drone:
            return
        stamps_ns, xyz = self.drone_in_vehicle()
        lines = [f"# T_vehicle_drone, {FULL_POSE}, truth\n" if self.drone else f"# {NO_DRONE} in this recording\n"]
        for stamp, position in zip(stamps_ns.tolist(), xyz, strict=True):
            q = _relative(self.vehicle[stamp][1], self.drone[stamp][1])
            lines.append(tum_line(stamp, position, q))
        (folder / TRUTH_FILE).write_text("".join(lines), encoding="utf-8")
        if self.hits_ns is not None:
            hits = "".join(f"{stamp_s(stamp)}\n" for stamp in sorted(self.hits_ns))
            (folder / TRUTH_HITS_FILE).write_text(f"stamp_s\n{hits}", encoding="utf-8")

    def _stamps(self) -> list[int]:
        return sorted(self.vehicle.keys() & self.drone.keys())


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


def fix_errors(fixes: list[DroneFix], stamps_ns: NDArray[np.int64], xyz_vehicle_m: NDArray[np.float64]) -> FixErrors:
    """Compare each fix with truth interpolated linearly to the fix's own stamp."""
    at_ns = np.array([fix.stamp_ns for fix in fixes], dtype=np.int64)
    known, true_m, _ = interpolate(at_ns, stamps_ns, xyz_vehicle_m, None, MAX_GAP_NS)
    judged = [fix for fix, is_known in zip(fixes, known, strict=True) if is_known]
    error_m = np.array([fix.xyz_vehicle_m for fix in judged]).reshape(-1, 3) - true_m[known]
    nees = [float(e @ np.linalg.solve(fix.covariance_m2, e)) for e, fix in zip(error_m, judged, strict=True)]
    return FixErrors(at_ns[known], error_m, np.array(nees), len(fixes) - len(judged))
