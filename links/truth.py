"""Truth of a simulated recording, for judging a run after it is done. Nothing of it reaches a stage.

Source: ours; recording format in recordings/README.md (/truth/*).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flow.link import LinkError, Record
from stages.geometry import rotation_from_quaternion_xyzw
from stages.messages import DroneFix

TOPIC_VEHICLE, TOPIC_DRONE = "/truth/vehicle", "/truth/drone"
MAX_GAP_NS = 50_000_000  # truth further apart than this is not interpolated over
CHI2_95_3 = 7.814728  # 95 % quantile of chi-square with 3 degrees of freedom


@dataclass
class TruthLog:
    """Sets truth records aside while a recording streams by."""

    vehicle: dict[int, Any] = field(default_factory=dict)
    drone: dict[int, Any] = field(default_factory=dict)

    def aside(self, records: Iterable[Record]) -> Iterator[Record]:
        """Pass on all records but those of truth, which are kept here."""
        for record in records:
            if record.topic == TOPIC_VEHICLE:
                self.vehicle[record.stamp_ns] = _pose(record)
            elif record.topic == TOPIC_DRONE:
                self.drone[record.stamp_ns] = _pose(record)
            else:
                yield record

    def drone_in_vehicle(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Stamps (n,) [ns] and the drone's position in the vehicle frame (n, 3) [m], where both poses are known."""
        stamps = np.array(sorted(self.vehicle.keys() & self.drone.keys()), dtype=np.int64)
        xyz = np.empty((len(stamps), 3))
        for row, stamp in enumerate(stamps.tolist()):
            t_vehicle, q_vehicle = self.vehicle[stamp]
            R_world_vehicle = rotation_from_quaternion_xyzw(q_vehicle)
            xyz[row] = R_world_vehicle.T @ (np.asarray(self.drone[stamp][0]) - np.asarray(t_vehicle))
        return stamps, xyz


def _pose(record: Record) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
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
    kept: list[int] = []
    errors: list[NDArray[np.float64]] = []
    nees: list[float] = []
    for fix in fixes:
        after = int(np.searchsorted(stamps_ns, fix.stamp_ns))
        if after == 0 or after == len(stamps_ns):
            continue
        t0, t1 = int(stamps_ns[after - 1]), int(stamps_ns[after])
        if t1 - t0 > MAX_GAP_NS:
            continue
        w = (fix.stamp_ns - t0) / (t1 - t0)
        error = fix.xyz_vehicle_m - ((1 - w) * xyz_vehicle_m[after - 1] + w * xyz_vehicle_m[after])
        kept.append(fix.stamp_ns)
        errors.append(error)
        nees.append(float(error @ np.linalg.solve(fix.covariance_m2, error)))
    error_m = np.array(errors).reshape(-1, 3)
    return FixErrors(np.array(kept, dtype=np.int64), error_m, np.array(nees), len(fixes) - len(kept))
