"""The vehicle's own odometry as a source: one JSON object per pose, T_map_vehicle; live by UDP (`links.udp`).

    {"xyz_m": [x, y, z], "quaternion_xyzw": [x, y, z, w], "covariance": [36 numbers] or null, "age_s": 0.004}

They are those of the odometry's reference point (`rig.odometry`) in a frame whose z axis is vertical. A vehicle that is
tilted by more than MAX_TILT_DEG shows a quaternion in another order, or other axes: the pose is rejected.

A recording without it is no error: the source has no records, and the run reports that once.

Source: recording format in recordings/README.md (/vehicle/odometry).
"""

from __future__ import annotations

import json
import math
from collections import Counter
from contextlib import AbstractContextManager
from typing import Any, ClassVar

import numpy as np

from flow.counters import Counters
from flow.link import PolledRecords, Record, Source
from links.udp import UdpSettings, listen_udp
from stages.geometry.frames import Array64, rotation_from_quaternion_xyzw
from stages.geometry.rig import RigOdometry
from stages.geometry.se3 import composed_covariance
from stages.messages import VehicleMotion

MAX_BYTES = 4_000
MAX_M = 1e7
NORM_TOLERANCE = 1e-3  # of a quaternion
MAX_TILT_DEG = 45.0  # the steepest road has 20 deg
TILTED = f"the vehicle is tilted by more than {MAX_TILT_DEG:g} deg"  # counter
FLIP_YZ = np.array([1.0, -1.0, -1.0])  # between forward-left-up and forward-right-down
CORRELATION_TOLERANCE = 1e-4  # effect of rounding a covariance to six digits


class VehicleOdometrySettings(UdpSettings):
    """Settings of `VehicleOdometry`."""

    what: ClassVar[str] = "the vehicle's odometry"

    topic: str = "/vehicle/odometry"
    reference: RigOdometry | None = None  # what its poses are poses of; None: of frame vehicle


class VehicleOdometry(Source[VehicleOdometrySettings]):
    """The vehicle's motion. A record without a valid pose is counted in `rejected` and skipped."""

    silent_after_s: ClassVar[float | None] = 2.0
    polled: ClassVar[bool] = True

    def __init__(self, settings: VehicleOdometrySettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._rejected: int = 0
        self._tilted: int = 0
        self._udp: Counter[str] = Counter()

    @property
    def rejected(self) -> int:
        """Number of records without a valid pose."""
        return self._rejected + self._tilted

    @property
    def counters(self) -> Counters:
        """Totals since the start: rejected, from other senders."""
        return Counters(self._udp, {"no valid pose": self._rejected, TILTED: self._tilted})

    def listen(self) -> AbstractContextManager[PolledRecords]:
        """Receive poses: `with odometry.listen() as records`. LinkError without `port`, or when it cannot be opened."""
        return listen_udp(self.settings, self._udp)

    def decode(self, record: Record) -> VehicleMotion | None:
        """The pose in `{"xyz_m": [...], "quaternion_xyzw": [...], "covariance": [36] or null}`; None: invalid."""
        try:
            motion = parse_pose(record.stamp_ns, record.data)
        except ValueError:
            self._rejected += 1
            return None
        if self.settings.reference is not None:
            motion = of_vehicle(motion, self.settings.reference)
        if motion.R_map_vehicle[2, 2] < math.cos(math.radians(MAX_TILT_DEG)):
            self._tilted += 1
            return None
        return motion


def of_vehicle(reference: VehicleMotion, settings: RigOdometry) -> VehicleMotion:
    """The vehicle's pose for one of the odometry's reference point: T_map_reference T_reference_vehicle.

    With axes frd the frame of the odometry has z down; `map` is that frame turned about its x axis.
    """
    xyz_m, R, P = reference.xyz_map_m, reference.R_map_vehicle, reference.covariance
    if settings.axes == "frd":
        xyz_m, R = FLIP_YZ * xyz_m, FLIP_YZ[:, None] * R * FLIP_YZ
        P = None if P is None else np.tile(FLIP_YZ, 2)[:, None] * P * np.tile(FLIP_YZ, 2)
    T = settings.T_vehicle_reference.matrix()
    R_back = np.ascontiguousarray(T[:3, :3].T)
    t_back_m = -R_back @ T[:3, 3]
    return VehicleMotion(
        stamp_ns=reference.stamp_ns,
        xyz_map_m=xyz_m + R @ t_back_m,
        R_map_vehicle=R @ R_back,
        covariance=None if P is None else composed_covariance(P, R_back, t_back_m, np.zeros((6, 6))),
    )


def parse_pose(stamp_ns: int, data: bytes) -> VehicleMotion:
    """Parse one pose. Raises ValueError for missing or non-finite fields, an invalid rotation or covariance."""
    if len(data) > MAX_BYTES:
        raise ValueError(f"a pose of {len(data)} bytes")
    try:
        fields: Any = json.loads(data)
        xyz_m = np.asarray(fields["xyz_m"], dtype=np.float64)
        qx, qy, qz, qw = (float(v) for v in fields["quaternion_xyzw"])
        rows = fields.get("covariance")
        covariance = None if rows is None else checked_covariance(np.asarray(rows, dtype=np.float64))
    except (TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"no pose: {error!r}") from None
    if xyz_m.shape != (3,) or not (np.abs(xyz_m) < MAX_M).all():  # NaN compares false
        raise ValueError(f"a pose at {xyz_m.tolist()}")
    if not abs(math.hypot(qx, qy, qz, qw) - 1) < NORM_TOLERANCE:
        raise ValueError(f"no rotation: {[qx, qy, qz, qw]}")
    return VehicleMotion(
        stamp_ns=stamp_ns,
        xyz_map_m=xyz_m,
        R_map_vehicle=rotation_from_quaternion_xyzw((qx, qy, qz, qw)),
        covariance=covariance,
    )


def checked_covariance(rows: Array64) -> Array64:
    """(6, 6) of 36 numbers by rows. Raises ValueError if it is not symmetric or has a negative eigenvalue."""
    if rows.shape != (36,) or not np.isfinite(rows).all():
        raise ValueError("a covariance without 36 finite numbers")
    covariance = rows.reshape(6, 6)
    sigmas = np.array([math.sqrt(variance) if variance > 0 else 1.0 for variance in rows[::7].tolist()])
    correlation = covariance / (sigmas[:, None] * sigmas)
    if np.abs(correlation - correlation.T).max() > CORRELATION_TOLERANCE:
        raise ValueError("a covariance that is not symmetric")
    if np.linalg.eigvalsh(correlation)[0] < -CORRELATION_TOLERANCE:
        raise ValueError("a covariance with a negative variance")
    return (covariance + covariance.T) / 2
