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
import scipy.io
from scipy.interpolate import CubicSpline

from flow.message import Message
from links.simulated.autopilot.flight_stack.quadrotor import Quadrotor
from links.simulated.autopilot.flight_stack.settings import FlightStackSettings
from stages.geometry.frames import rotation_from_quaternion_xyzw, rotation_z
from stages.kernels.geometry.so3 import exp_rotation
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
from tests.stages.fuse.real.pixhawk_log import LOG, PixhawkLog, pixhawk_log, reference

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

    def telemetry(self) -> Iterator[tuple[float, Message]]:
        """(arrival [s], message): IMU and attitude; while independent also the position."""
        for stamp, rate, force in zip(*self.log.imu[self.imu], strict=True):
            t = stamp - self.start_s
            if 0 <= t < self.until_s + 0.3:
                force = np.round(force / 9.80665e-3) * 9.80665e-3  # RAW_IMU: whole mg and mrad/s
                yield (
                    t + LATE_S,
                    DroneImu(stamp_ns=ns(t), acceleration_drone_mps2=force, angular_velocity_drone_radps=rate.round(3)),
                )
        times, rotations = self.log.attitude
        stamps, rates, _ = self.log.imu[self.imu]
        for stamp, R in zip(times, rotations, strict=True):
            t = stamp - self.start_s
            if 0 <= t < self.until_s + 0.3:
                rate = rates[int(np.argmin(np.abs(stamps - stamp)))]
                attitude = DroneAttitude(
                    stamp_ns=ns(t), R_odom_drone=R, angular_velocity_drone_radps=rate, independent=self.independent
                )
                yield t + LATE_S, attitude
        for stamp, xyz, v in zip(*self.log.position, strict=True) if self.independent else ():
            t = stamp - self.start_s
            if 0 <= t < self.until_s + 0.3:
                yield (
                    t + LATE_S,
                    DroneLocalPosition(stamp_ns=ns(t), xyz_odom_m=xyz, velocity_odom_mps=v, independent=True),
                )


TRACKS = LOG.parents[1] / "drone_traj"
RTK_HZ = 5.0  # the RTK files have no times: at 10 Hz the drone would accelerate by 26 m/s^2
FOLLOWED_PER_S, DAMPED_PER_S = 1.5, 2.5  # gains of the controller that follows the track


def tracks() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Time [s] and position (n, 3) [m] of each track while it flies, at its real times."""
    polar = TRACKS / "eth_tps_20210104"
    stamp = scipy.io.loadmat(polar / "meas_ts_20210104111312.mat")["meas_ts"][:, 0] * 86400.0
    xyz = scipy.io.loadmat(polar / "meas_cart_20210104111312.mat")["meas_cart"]
    flying = (stamp - stamp[0] > 75.0) & (stamp - stamp[0] < 335.0)
    out = {"total station": (stamp[flying] - stamp[0], xyz[flying])}
    for name in ("eth_ds1_rtk", "eth_ds3_rtk"):
        rtk = np.loadtxt(TRACKS / name / "trajectory" / "rtk.txt")
        out[name] = np.arange(len(rtk)) / RTK_HZ, rtk
    return out


@dataclass
class TrackFlight(RealFlight):
    """A part of a track, flown by the simulator's airframe in gusts of 0.5 m/s; IMU with bias and rotor vibration."""

    track: str = "total station"
    vibration_mps2: float = 0.3

    @staticmethod
    def span_s(track: str) -> tuple[float, float]:
        """First and last start of a window of 60 s."""
        times, xyz = tracks()[track]
        moves = np.flatnonzero(np.linalg.norm(xyz - xyz[0], axis=1) > 3.0)
        ends = np.flatnonzero(np.linalg.norm(xyz - xyz[-1], axis=1) > 3.0)
        return float(times[moves[0]]), float(times[ends[-1]] - 61.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        times, xyz = tracks()[self.track]
        bins = [times[(times >= t) & (times < t + 0.5)] for t in np.arange(times[0], times[-1], 0.5)]
        full = [b for b in bins if len(b)]  # medians over 0.5 s: outliers and noise of single points
        path = CubicSpline([b.mean() for b in full], [np.median(xyz[np.isin(times, b)], axis=0) for b in full])
        stack = FlightStackSettings.model_validate({"imu": {"vibration_mps2": self.vibration_mps2}})
        first, yaw = path(self.start_s), float(self.rng.uniform(0, 2 * np.pi))
        drone = Quadrotor(stack, first, yaw, float(first[2]) - 100.0, self.until_s + 1.0, self.seed)
        ticks, estimate, self._samples = round(100 * (self.until_s + 0.6)), np.zeros(16), []
        drone.state[3:6] = path(self.start_s, 1)
        for k in range(ticks):
            at = self.start_s + 0.01 * k
            estimate[:10] = drone.state[:10]
            wanted = path(at, 2) + FOLLOWED_PER_S**2 * (path(at) - drone.state[0:3])
            wanted = wanted + DAMPED_PER_S * (path(at, 1) - drone.state[3:6]) + np.array([0.0, 0.0, 9.80665])
            command = np.array([*wanted, yaw + 0.5 * np.sin(0.006 * k), 0.0, 1.0])
            self._samples.append(drone.fly(estimate, command).samples[-1])
        self._states = drone.motion.states

    def truth(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """R_map_drone, position and velocity in map; 400 Hz."""
        state, turn = self._states[round(400 * t)], self.R_map_odom
        R = rotation_from_quaternion_xyzw(tuple(state[6:10]))
        return turn @ R, turn @ state[0:3], turn @ state[3:6]

    def telemetry(self) -> Iterator[tuple[float, Message]]:
        """(arrival [s], message): IMU at 50 Hz, attitude at 10 Hz with a tilt error of 2 deg."""
        tilt = gauss_markov(self.rng, np.radians(2.0) / np.sqrt(2), 15.0, 0.1, 10 * round(self.until_s + 1), 2)
        for k in range(2, len(self._samples), 2):
            t, sample = 0.01 * k, self._samples[k - 1]  # the last of four steps, at the end of its tick
            force, rate = np.round(sample[3:] / 9.80665e-3) * 9.80665e-3, sample[:3].round(3)
            yield t + LATE_S, DroneImu(stamp_ns=ns(t), acceleration_drone_mps2=force, angular_velocity_drone_radps=rate)
            if k % 10 == 0:
                R = self.R_map_odom.T @ self.truth(t)[0] @ exp_rotation(np.array([*tilt[k // 10], 0.0]))
                yield t + LATE_S, DroneAttitude(stamp_ns=ns(t), R_odom_drone=R, angular_velocity_drone_radps=rate)
