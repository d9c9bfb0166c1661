"""Flights of a quadrotor with its IMU, LiDAR positions, rotations by cameras and autopilot, with errors of known statistics.

Own physics at 200 Hz: a controller follows a path; the thrust tilts the body with a lag; wind with gusts acts by drag.
The accelerometer measures thrust and drag, the gyroscope the change of attitude. Errors that last are Gauss-Markov.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from flow.message import Message
from stages.geometry.frames import rotation_z
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import (
    AutopilotMotion,
    BranchState,
    DroneFix,
    DroneMotion,
    RelativeRotation,
    TrackingState,
    TrackState,
    VehicleMotion,
    VisualMotion,
)

S = 1_000_000_000
START_NS = 1_700_000_000 * S
FINE_S = 0.005
G = 9.80665
LIFT = np.array([0.0, 0.0, G])
DRAG = 0.25  # [1/s] of the velocity through the air
FIRST_FIX_S = 0.4
KINDS = ("hover", "orbit", "square", "manoeuvre", "fast")


def ns(t) -> int:
    return START_NS + round(float(t) * S)


def gauss_markov(rng, sigma, time_s, step_s, count, width=3):
    """(count, width), stationary, one row each step."""
    rho = math.exp(-step_s / time_s) if time_s > 0 else 0.0
    white = rng.standard_normal((count, width)) * sigma
    out = np.empty((count, width))
    out[0] = white[0]
    for i in range(1, count):
        out[i] = rho * out[i - 1] + math.sqrt(1 - rho**2) * white[i]
    return out


@dataclass
class ImuFlight:
    """How it flies and how wrong each source is."""

    kind: str = "manoeuvre"
    seed: int = 0
    until_s: float = 30.0
    wind_mps: float = 3.0
    vehicle_mps: float = 0.0
    range_m: float = 20.0
    turn_radps: float = 0.0  # about the vertical, besides the wobble of 0.3 rad
    # sources
    imu_hz: float = 50.0  # 0: no IMU
    vibration_mps2: float = 0.3  # of a sample, aliased
    noise_factor: float = 1.0  # stated noise of the IMU over the true one
    fix_hz: float = 8.0
    fix_sigma_m: float = 0.07
    fix_outliers: float = 0.01
    gaps_s: tuple[tuple[float, float], ...] = ()  # without LiDAR positions
    rotations: bool = False
    images: bool = False
    odometry: bool = False
    compass_deg: float = 0.0
    stamp_s: float = 0.005  # error of the IMU's stamps, constant in a flight
    _made: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng([self.seed, KINDS.index(self.kind), 2800])
        self._fly()

    # truth

    def _goal(self, t: np.ndarray) -> np.ndarray:
        """(n, 3) path that the controller follows."""
        rng = self.rng
        at = np.zeros((len(t), 3))
        if self.kind == "orbit":
            a = 2.0 / 15.0 * t * rng.choice([-1, 1]) + rng.uniform(0, 6.28)
            at[:, 0], at[:, 1] = 15.0 * np.cos(a), 15.0 * np.sin(a)
        elif self.kind == "square":
            s = (t / 6.0) % 4.0  # a side of 8 m takes 5 s with least jerk, then a stop of 1 s
            side, u = s.astype(int), np.clip((s % 1.0) * 6.0 / 5.0, 0, 1)
            share = u**3 * (10 - 15 * u + 6 * u**2)
            corner = np.array([[0, 0], [8, 0], [8, 8], [0, 8], [0, 0]], dtype=float)
            at[:, :2] = corner[side] + (corner[side + 1] - corner[side]) * share[:, None]
            at[:, :2] = at[:, :2] @ rotation_z(rng.uniform(0, 6.28))[:2, :2].T
        elif self.kind in ("manoeuvre", "fast"):  # horizontal acceleration of about 1 or 2.5 m/s^2, one sigma
            want = 1.0 if self.kind == "manoeuvre" else 2.5
            for axis in (0, 1):
                for period in rng.uniform(3.5, 9.0, 3):
                    w = 2 * math.pi / period
                    at[:, axis] += want / math.sqrt(3.0) / w**2 * np.sin(w * t + rng.uniform(0, 6.28))
            at[:, 2] = 0.8 * np.sin(2 * math.pi * t / 11.0 + rng.uniform(0, 6.28))
        return at + np.array([*rng.normal(0, 4.0, 2), self.range_m])

    def _fly(self) -> None:
        rng, n = self.rng, int(self.until_s / FINE_S) + 400
        t = np.arange(n) * FINE_S
        goal = self._goal(t)
        goal_v = np.gradient(goal, FINE_S, axis=0)
        wind = self.wind_mps * np.array([*rng.normal(0, 0.7, 2), 0.0])
        gusts = 0.35 * self.wind_mps * np.repeat(gauss_markov(rng, 1.0, 2.0, 10 * FINE_S, n // 10 + 1), 10, axis=0)[:n]
        gusts[:, 2] *= 0.3
        p, v, trim = goal[0].copy(), goal_v[0].copy(), np.zeros(3)
        turning, thrust = np.array([0.0, 0.0, G]), np.array([0.0, 0.0, G])
        P, V, T, D = (np.zeros((n, 3)) for _ in range(4))
        for i in range(n):
            drag = DRAG * (wind + gusts[i] - v)
            P[i], V[i], T[i], D[i] = p, v, thrust, drag
            off = goal[i] - p
            trim += 0.3 * off * FINE_S
            want = 1.5 * off + 2.2 * (goal_v[i] - v) + trim
            level = math.hypot(want[0], want[1])
            want[:2] *= min(1.0, 5.0 / max(level, 1e-9))
            turning = turning + FINE_S / 0.08 * (want + LIFT - turning)
            thrust = thrust + FINE_S / 0.08 * (turning - thrust)  # attitude follows in two steps
            a = thrust + drag - [0, 0, G]
            p, v = p + FINE_S * v + 0.5 * FINE_S**2 * a, v + FINE_S * a
        yaw = (
            self.turn_radps * t
            + rng.uniform(0, 6.28)
            + 0.3 * np.sin(2 * math.pi * t / rng.uniform(8, 20)) * (self.kind != "hover")
        )
        z = T / np.linalg.norm(T, axis=1)[:, None]
        x = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(n)])
        y = np.cross(z, x)
        y /= np.linalg.norm(y, axis=1)[:, None]
        R = np.stack([np.cross(y, z), y, z], axis=2)
        rate = np.array([log_rotation(R[i].T @ R[i + 1]) / FINE_S for i in range(n - 1)])
        force = np.einsum("nji,nj->ni", R, T + D)
        self._made = {"t": t, "p": P, "v": V, "R": R, "force": force, "rate": np.vstack([rate, rate[-1:]])}

    @property
    def first_fix_s(self) -> float:
        """Time of the first LiDAR position, without its jitter."""
        return FIRST_FIX_S

    def truth(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """R_map_drone, position and velocity in map."""
        m, i = self._made, t / FINE_S
        k, share = int(i), i - int(i)
        R = m["R"][k] @ exp_rotation(share * log_rotation(m["R"][k].T @ m["R"][k + 1]))
        return R, *(m[name][k] + share * (m[name][k + 1] - m[name][k]) for name in ("p", "v"))

    def vehicle(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """R_map_vehicle and position: parked, or on a winding road."""
        s = self.vehicle_mps * t
        a = 0.4 * math.sin(s / 25.0)
        return rotation_z(a), np.array([s, 4.0 * math.sin(s / 30.0), 0.0])

    # measurements

    def events(self) -> list[tuple[int, str, Message]]:
        """(arrival [ns], port, message) in order of arrival."""
        made = [*self._vehicle(), *self._imu(), *self._fixes(), *self._rotations(), *self._images()]
        out = [(ns(at), k, port, message) for k, (at, port, message) in enumerate(made)]
        return [(at, port, message) for at, _, port, message in sorted(out, key=lambda e: e[:2])]

    def _vehicle(self) -> Iterator[tuple[float, str, Message]]:
        for t in np.arange(0, self.until_s, 0.05):
            R, x = self.vehicle(t)
            yield t + 0.01, "motion", VehicleMotion(stamp_ns=ns(t), xyz_map_m=x, R_map_vehicle=R, covariance=None)

    def _imu(self) -> Iterator[tuple[float, str, Message]]:
        if not self.imu_hz:
            return
        rng, T = np.random.default_rng([self.seed, 1]), 1.0 / self.imu_hz
        times = np.arange(0.05, self.until_s + 0.3, T)
        sigma_f, sigma_w = math.hypot(self.vibration_mps2, 0.02), 0.004 + 0.01 * self.vibration_mps2
        accel, gyro = rng.normal(0, 0.12, 3), rng.normal(0, 0.005, 3)
        accel = accel + np.cumsum(0.003 * math.sqrt(T) * rng.standard_normal((len(times), 3)), axis=0)
        gyro = gyro + np.cumsum(1e-4 * math.sqrt(T) * rng.standard_normal((len(times), 3)), axis=0)
        self._made["bias"] = np.hstack([accel, gyro])  # one row a sample of the IMU
        tilt = gauss_markov(rng, math.radians(2.0) / math.sqrt(2), 15.0, T, len(times), 2)
        off_s = rng.normal(0, self.stamp_s)
        odometry = self._odometry(times, rng) if self.odometry else [None] * len(times)
        before: tuple[float, np.ndarray, np.ndarray] | None = None
        for k, t in enumerate(times):
            i = int(t / FINE_S)
            f = self._made["force"][i] + accel[k] + rng.normal(0, sigma_f, 3)
            w = self._made["rate"][max(i - 1, 0)] + gyro[k] + rng.normal(0, sigma_w, 3)
            if before is not None:
                R = self._made["R"][i]
                up = exp_rotation(np.array([*tilt[k], 0.0])) @ R[2]
                yield (
                    t + 0.03,
                    "drone_motion",
                    DroneMotion(
                        stamp_ns=ns(t + off_s),
                        start_ns=ns(before[0] + off_s),
                        segment=0,
                        specific_force_drone_mps2=0.5 * (f + before[1]),
                        angular_velocity_drone_radps=0.5 * (w + before[2]),
                        specific_force_noise=np.full(3, self.noise_factor * sigma_f * math.sqrt(T)),
                        angular_velocity_noise=np.full(3, self.noise_factor * sigma_w * math.sqrt(T)),
                        up_drone=up,
                        autopilot=odometry[k],
                    ),
                )
            before = float(t), f, w

    def _odometry(self, times: np.ndarray, rng: np.random.Generator) -> list[AutopilotMotion]:
        """By GPS and compass: the compass turns the attitude, not the velocity."""
        T = float(times[1] - times[0])
        drift = gauss_markov(rng, 0.08, 10.0, T, len(times))
        north = rotation_z(rng.uniform(0, 6.28))
        wrong = rotation_z(math.radians(self.compass_deg + rng.normal(0, 3.0)))
        at, out = np.zeros(3), []
        for k, t in enumerate(times):
            R, _, v = self.truth(t)
            v_odom = north @ (v + drift[k])
            at = at + T * v_odom
            out.append(
                AutopilotMotion(xyz_odom_m=at, R_odom_drone=north @ wrong @ R, velocity_odom_mps=v_odom, odom_segment=0)
            )
        return out

    def _fixes(self) -> Iterator[tuple[float, str, Message]]:
        rng = np.random.default_rng([self.seed, 2])
        times = np.arange(FIRST_FIX_S, self.until_s, 1 / self.fix_hz)
        times = times + rng.uniform(-0.02, 0.02, len(times))
        e = gauss_markov(rng, math.sqrt(0.75) * self.fix_sigma_m, 0.12, 1 / self.fix_hz, len(times))
        bias = math.sqrt(0.25) * self.fix_sigma_m * rng.standard_normal(3)  # vehicle axes
        for k, t in enumerate(times):
            if any(a <= t < b for a, b in self.gaps_s):
                continue
            R, x = self.vehicle(t)
            xyz = R.T @ (self.truth(t)[1] - x) + e[k] + bias
            if rng.random() < self.fix_outliers:
                xyz = xyz + rng.normal(0, 2.0, 3)
            yield (
                t + 0.07,
                "fix",
                DroneFix(
                    stamp_ns=ns(t),
                    xyz_vehicle_m=xyz,
                    covariance_m2=self.fix_sigma_m**2 / 0.65 * np.eye(3),  # trackers state more than the true error
                    hits=4,
                ),
            )
            yield (
                t + 0.07,
                "track",
                TrackState(
                    stamp_ns=ns(t), state=TrackingState.TRACKING, reason="made", hits=4, frame_s=0.1, track_id=1
                ),
            )

    def _rotations(self) -> Iterator[tuple[float, str, Message]]:
        rng = np.random.default_rng([self.seed, 3])
        times = np.arange(0.6, self.until_s, 0.2) if self.rotations else np.array([])
        sigma = math.radians(0.5)
        e = gauss_markov(rng, sigma, 1.0, 0.2, max(len(times), 1)) + math.radians(0.2) * rng.standard_normal(3)
        branch = int(rng.integers(4))
        for k, t in enumerate(times):
            R = self.vehicle(t)[0].T @ rotation_z(branch * math.pi / 2) @ self.truth(t)[0] @ exp_rotation(e[k])
            if rng.random() < 0.02:
                R = R @ exp_rotation(rng.normal(0, 0.5, 3))
            covariance, branches = (sigma**2 + math.radians(0.2) ** 2) * np.eye(3), np.full(4, 0.24)
            made = RelativeRotation.one(ns(t), R, covariance, branches, BranchState.OPEN, 0, "made")
            yield t + 0.1, "rotation", made

    def _images(self) -> Iterator[tuple[float, str, Message]]:
        rng = np.random.default_rng([self.seed, 4])
        for t in np.arange(0.4, self.until_s, 0.1) if self.images else ():
            (a, x, _), (b, y, _) = self.truth(t - 0.1), self.truth(t)
            moved = a.T @ (y - x)
            far = float(np.linalg.norm(moved)) > 0.05
            direction = exp_rotation(rng.normal(0, 0.05, 3)) @ moved / max(float(np.linalg.norm(moved)), 1e-9)
            if rng.random() < 0.1:
                direction = rng.normal(0, 1, 3)
                direction /= np.linalg.norm(direction)
            yield (
                t + 0.06,
                "visual_motion",
                VisualMotion(
                    stamp_ns=ns(t),
                    from_ns=ns(t - 0.1),
                    R_from_to=a.T @ b @ exp_rotation(rng.normal(0, 6e-4, 3)),
                    covariance_rad2=(6e-4) ** 2 * np.eye(3),
                    direction_from=direction if far else None,
                    direction_sigma_rad=0.05 if far else None,
                    matches=80,
                    reason="made",
                ),
            )


def seconds(stamp_ns: int) -> float:
    """Time since the start of a flight."""
    return (stamp_ns - START_NS) / S
