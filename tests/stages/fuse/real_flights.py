"""Flights of real drones as inputs of the fusion, with the interface of `ImuFlight`.

PixhawkFlight  the IMU and the attitude that a real autopilot logged, through the stages that read them in
               configs/estimate.yaml; LiDAR positions are made from the path of GPS, or of GPS and the other IMU
TrackFlight    the track of a real drone by total station or RTK, flown by the airframe and IMU of the simulator

The vehicle stands at the origin of `map`, whose yaw against north is drawn from the seed.

Source: ../shared/data (read there, never copied): pixhawk_log.py; ETH, drone-tracking-datasets (CC BY-NC-SA 4.0).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from flow.message import Message
from stages.geometry.frames import rotation_z
from stages.messages import (
    DroneAttitude,
    DroneFix,
    DroneImu,
    DroneLocalPosition,
    DroneMotion,
    TrackingState,
    TrackState,
    VehicleMotion,
)
from stages.odometry.drone import IndependentTelemetry, InertialMotion
from tests.stages.fuse.imu_flights import FIRST_FIX_S, gauss_markov, ns
from tests.stages.fuse.pixhawk_log import PixhawkLog, pixhawk_log, reference

LATE_S = 0.03  # of telemetry
TELEMETRY_PORTS = {DroneImu: "imu", DroneAttitude: "attitude", DroneLocalPosition: "position"}
MOTION_PORTS = {
    "DroneImu": "imu",
    "DroneTilt": "tilt",
    "DroneAttitude": "attitude",
    "DroneLocalPosition": "position",
}
OTHER = {"IMU": "IMU2", "IMU2": "IMU"}


@dataclass
class RealFlight:
    """What both have in common: the clock, the parked vehicle and LiDAR positions."""

    start_s: float  # in the log or track
    seed: int = 0
    until_s: float = 60.0
    fix_hz: float = 10.0
    fix_sigma_m: float = 0.07
    fix_outliers: float = 0.01
    gaps_s: tuple[tuple[float, float], ...] = ()  # without LiDAR positions

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng([self.seed, round(10 * self.start_s), 2801])
        self.R_map_odom = rotation_z(self.rng.uniform(0, 2 * np.pi))
        self.first_fix_s = FIRST_FIX_S

    def truth(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """R_map_drone, position and velocity in map."""
        raise NotImplementedError

    def telemetry(self) -> Iterator[tuple[float, Message]]:
        """(arrival [s], message) of the autopilot."""
        raise NotImplementedError

    def vehicle(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """R_map_vehicle and position: parked at the origin."""
        return np.eye(3), np.zeros(3)

    def events(self) -> list[tuple[int, str, Message]]:
        """(arrival [ns], port, message) in order of arrival."""
        made = [*self._motion(), *self._vehicle(), *self._fixes()]
        return sorted(((ns(at), port, message) for at, port, message in made), key=lambda e: e[0])

    def _motion(self) -> Iterator[tuple[float, str, Message]]:
        """The telemetry through IndependentTelemetry and InertialMotion."""
        first, second = IndependentTelemetry(), InertialMotion()
        for at_s, message in sorted(self.telemetry(), key=lambda e: e[0]):
            for passed in _outputs(first, message, TELEMETRY_PORTS[type(message)]):
                _outputs(second, passed, MOTION_PORTS[type(passed).__name__])
            if isinstance(message, DroneImu):
                for motion in _outputs(second, message, "imu"):
                    assert isinstance(motion, DroneMotion)
                    yield at_s, "drone_motion", motion

    def _vehicle(self) -> Iterator[tuple[float, str, Message]]:
        for t in np.arange(0, self.until_s, 0.05):
            R, x = self.vehicle(t)
            yield t + 0.01, "motion", VehicleMotion(stamp_ns=ns(t), xyz_map_m=x, R_map_vehicle=R, covariance=None)

    def _fixes(self) -> Iterator[tuple[float, str, Message]]:
        """With the errors of `ImuFlight`'s."""
        rng, sigma = self.rng, self.fix_sigma_m
        times = np.arange(FIRST_FIX_S, self.until_s, 1 / self.fix_hz)
        times = times + rng.uniform(-0.02, 0.02, len(times))
        e = gauss_markov(rng, np.sqrt(0.75) * sigma, 0.12, 1 / self.fix_hz, len(times))
        e = e + np.sqrt(0.25) * sigma * rng.standard_normal(3)
        for k, t in enumerate(times):
            false = rng.normal(0, 2.0, 3) if rng.random() < self.fix_outliers else 0.0
            if any(a <= t < b for a, b in self.gaps_s):
                continue
            fix = DroneFix(
                stamp_ns=ns(t),
                xyz_vehicle_m=self.truth(t)[1] + e[k] + false,
                covariance_m2=sigma**2 / 0.65 * np.eye(3),
                hits=4,
            )
            state = TrackState(stamp_ns=ns(t), state=TrackingState.TRACKING, reason="made", hits=4, frame_s=0.1)
            yield t + 0.07, "fix", fix
            yield t + 0.07, "track", state


def _outputs(stage: Any, message: Message, port: str) -> list[Message]:
    made = getattr(stage, f"on_{port}")(message)
    if made is None or isinstance(made, Message):
        return [] if made is None else [made]
    return list(made)


@dataclass
class PixhawkFlight(RealFlight):
    """A part of the log. Truth is the batch with the IMU that is not used: its gyros and accelerometers are others."""

    imu: str = "IMU"
    by_gps: bool = True  # the path is that of GPS alone, else of GPS and the other IMU
    independent: bool = False  # the autopilot's position and yaw are independent of poses of grd

    def __post_init__(self) -> None:
        super().__post_init__()
        self.log: PixhawkLog = pixhawk_log()
        self._truth = reference(OTHER[self.imu])
        self._path = self._truth.gps_path if self.by_gps else self._truth.path
        self._velocity = self._path.derivative()

    def truth(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """R_map_drone, position and velocity in map."""
        at, turn = self.start_s + t, self.R_map_odom
        i = int(np.argmin(np.abs(self._truth.time_s[self._near(at)] - at))) + self._near(at).start
        return turn @ self._truth.R_odom_drone[i], turn @ self._path(at), turn @ self._velocity(at)

    def _near(self, at: float) -> slice:
        i = int(np.searchsorted(self._truth.time_s, at))
        return slice(max(i - 1, 0), i + 1)

    def attitude_yaw_rad(self, t: float) -> float:
        """Yaw of the drone in map by the autopilot's attitude, its compass included."""
        times, R = self.log.attitude
        R_map_drone = self.R_map_odom @ R[int(np.argmin(np.abs(times - self.start_s - t)))]
        return float(np.arctan2(R_map_drone[1, 0] - R_map_drone[0, 1], R_map_drone[0, 0] + R_map_drone[1, 1]))

    def telemetry(self) -> Iterator[tuple[float, Message]]:
        """(arrival [s], message): IMU and attitude; while independent also the position."""
        for stamp, rate, force in zip(*self.log.imu[self.imu], strict=True):
            t = stamp - self.start_s
            if 0 <= t < self.until_s + 0.3:
                force = np.round(force / 9.80665e-3) * 9.80665e-3  # RAW_IMU: whole mg and mrad/s
                yield t + LATE_S, DroneImu(stamp_ns=ns(t), acceleration_drone_mps2=force, angular_velocity_drone_radps=rate.round(3))
        times, rotations = self.log.attitude
        stamps, rates, _ = self.log.imu[self.imu]
        for stamp, R in zip(times, rotations, strict=True):
            t = stamp - self.start_s
            if 0 <= t < self.until_s + 0.3:
                rate = rates[int(np.argmin(np.abs(stamps - stamp)))]
                attitude = DroneAttitude(stamp_ns=ns(t), R_odom_drone=R, angular_velocity_drone_radps=rate, independent=self.independent)
                yield t + LATE_S, attitude
        for stamp, xyz, v in zip(*self.log.position, strict=True) if self.independent else ():
            t = stamp - self.start_s
            if 0 <= t < self.until_s + 0.3:
                yield t + LATE_S, DroneLocalPosition(stamp_ns=ns(t), xyz_odom_m=xyz, velocity_odom_mps=v, independent=True)
