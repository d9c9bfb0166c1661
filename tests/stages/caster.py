"""A small ray caster for the stages' tests: a VLP-16 on its servo, and balls, boxes, wires and drones.

Beams are lines without width, the air is clear, nothing is noisy. It is independent of links/simulated, so that an error
in one is not hidden by the same error in the other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Protocol

import numpy as np

from stages.geometry.frames import LidarMount
from stages.messages import LidarFirings, ServoState, SweptPulses
from tests.stages.made import ELEVATION_RAD, MS, ON_ITS_SIDE, PACKET_NS, START_NS, servo

PULSE_NS = np.repeat(np.arange(24) * 55_296, 16) + np.tile(np.arange(16) * 2_304, 24)  # in a packet
LASER = np.tile(np.arange(16), 24).astype(np.uint8)
TURN_NS = 100 * MS  # 600 rpm
SIDEWAYS = math.pi / 2  # a servo angle at which the fan of ON_ITS_SIDE holds the y and the z axis

Trajectory = Callable[[np.ndarray], np.ndarray]  # times (n,) [s] since the start -> positions (n, 3) [m], vehicle frame
Servo = Callable[[np.ndarray], np.ndarray]  # times (n,) [s] -> angles (n,) [rad]


class Thing(Protocol):
    """Any object that a beam can hit."""

    def range_m(self, origin_m: np.ndarray, direction: np.ndarray, t_s: np.ndarray) -> np.ndarray:
        """Range (n,) at which beams (n, 3) from origins (n, 3) meet it; inf where they do not."""
        ...


def still(x: float, y: float, z: float) -> Trajectory:
    return lambda t_s: np.broadcast_to([x, y, z], (len(t_s), 3))


def flying(start_m, velocity_mps) -> Trajectory:
    return lambda t_s: np.asarray(start_m) + np.outer(t_s, velocity_mps)


@dataclass(frozen=True)
class Ball:
    trajectory: Trajectory
    radius_m: float

    def range_m(self, origin_m, direction, t_s):
        centre = self.trajectory(t_s) - origin_m
        along = np.einsum("ij,ij->i", direction, centre)
        below = along**2 - (np.einsum("ij,ij->i", centre, centre) - self.radius_m**2)
        return np.where((below > 0) & (along > 0), along - np.sqrt(np.maximum(below, 0.0)), np.inf)


@dataclass(frozen=True)
class Box:
    """Sides along the axes, between two corners."""

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]

    def range_m(self, origin_m, direction, t_s):
        with np.errstate(divide="ignore"):
            to_low, to_high = (self.low_m - origin_m) / direction, (self.high_m - origin_m) / direction
        enter, leave = np.minimum(to_low, to_high).max(axis=1), np.maximum(to_low, to_high).min(axis=1)
        return np.where((enter <= leave) & (enter > 0), enter, np.inf)


@dataclass(frozen=True)
class Wire:
    """A round bar between two points: a wire, a pole, an arm."""

    from_m: tuple[float, float, float]
    to_m: tuple[float, float, float]
    radius_m: float

    def range_m(self, origin_m, direction, t_s):
        axis = np.subtract(self.to_m, self.from_m)
        length = float(np.linalg.norm(axis))
        axis = axis / length
        away = origin_m - self.from_m
        d = direction - np.outer(direction @ axis, axis)  # both across the bar
        o = away - np.outer(away @ axis, axis)
        a, b = np.einsum("ij,ij->i", d, d), np.einsum("ij,ij->i", d, o)
        below = b * b - a * (np.einsum("ij,ij->i", o, o) - self.radius_m**2)
        r = np.where(below > 0, (-b - np.sqrt(np.maximum(below, 0.0))) / np.maximum(a, 1e-12), np.inf)
        with np.errstate(invalid="ignore"):
            along = away @ axis + r * (direction @ axis)
        return np.where((r > 0) & (along >= 0) & (along <= length), r, np.inf)


@dataclass
class Drone:
    """Mostly air: a pulse that passes its centre at rho returns with 0.9 exp(-rho^2 / (2 (span / 5)^2)), somewhere in it."""

    trajectory: Trajectory
    span_m: float = 0.5
    seed: int = 0
    _rng: np.random.Generator = field(init=False)

    def __post_init__(self):
        self._rng = np.random.default_rng(self.seed)

    def range_m(self, origin_m, direction, t_s):
        centre = self.trajectory(t_s) - origin_m
        along = np.einsum("ij,ij->i", direction, centre)
        rho = np.linalg.norm(np.cross(direction, centre), axis=1)
        inside = (rho < 0.5 * self.span_m) & (along > 0)
        p = np.where(inside, 0.9 * np.exp(-0.5 * (rho / (0.2 * self.span_m)) ** 2), 0.0)
        hit = self._rng.random(len(p)) < p
        return np.where(hit, along + self._rng.normal(0.0, 0.05 * self.span_m, len(p)), np.inf)


@dataclass(frozen=True)
class During:
    """A thing that is present between two times only."""

    thing: Thing
    from_s: float
    to_s: float

    def range_m(self, origin_m, direction, t_s):
        there = (t_s >= self.from_s) & (t_s < self.to_s)
        return np.where(there, self.thing.range_m(origin_m, direction, t_s), np.inf)


def dithering(centre_rad: float = SIDEWAYS, half_rad: float = math.radians(2.2), rate_hz: float = 1.37) -> Servo:
    """A servo that swings about an angle, in no simple ratio to the rotor."""
    return lambda t_s: centre_rad + half_rad * np.sin(math.tau * rate_hz * np.asarray(t_s))


def sweeping(rate_radps: float = math.radians(120.0)) -> Servo:
    """A servo that turns on and on, from 0."""
    return lambda t_s: rate_radps * np.asarray(t_s)


def azimuth_rad(stamp_ns: np.ndarray) -> np.ndarray:
    return (stamp_ns - START_NS) % TURN_NS / TURN_NS * math.tau


def beams_lidar(stamp_ns: np.ndarray, laser: np.ndarray) -> np.ndarray:
    """Directions (n, 3) in the lidar frame."""
    azimuth, elevation = azimuth_rad(stamp_ns), ELEVATION_RAD[laser]
    return np.stack([np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)], 1)


def beams_vehicle(mount: LidarMount, servo_rad: np.ndarray, beams: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(origins, directions) (n, 3) in the vehicle frame of beams in the lidar frame, each with its servo position."""
    A, B = mount.T_vehicle_turntable.matrix(), mount.T_turntable_lidar.matrix()
    angle = mount.turntable_rad(servo_rad)
    c, s = np.cos(angle), np.sin(angle)

    def turned(v):
        v = np.broadcast_to(v, beams.shape)
        return np.stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1], v[:, 2]], axis=1)

    directions = turned(beams @ B[:3, :3].T) @ A[:3, :3].T
    return turned(B[:3, 3]) @ A[:3, :3].T + A[:3, 3], directions


def cast(things: Sequence[Thing], origin_m: np.ndarray, direction: np.ndarray, t_s: np.ndarray) -> np.ndarray:
    """Range (n,) of the nearest thing each beam meets; 0: none."""
    nearest = np.full(len(t_s), np.inf)
    for thing in things:
        nearest = np.minimum(nearest, thing.range_m(origin_m, direction, t_s))
    return np.where(np.isfinite(nearest), nearest, 0.0)


def packets_seen(
    things: Sequence[Thing], servo_rad: Servo, from_s: float, to_s: float, mount: LidarMount
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """(pulse times (384,), ranges (384,), origins and directions (384, 3) in the vehicle frame) of each packet."""
    first, end = round(from_s * 1e9 / PACKET_NS), int(to_s * 1e9 / PACKET_NS)
    for start in range(first, end, 32):  # 32 at once: numpy's own time vanishes
        packets = np.arange(start, min(start + 32, end))
        stamp_ns = START_NS + (packets[:, None] * PACKET_NS + PULSE_NS).ravel()
        t_s = (stamp_ns - START_NS) * 1e-9
        laser = np.tile(LASER, len(packets))
        origin_m, direction = beams_vehicle(mount, servo_rad(t_s), beams_lidar(stamp_ns, laser))
        range_m = cast(things, origin_m, direction, t_s)
        for k in range(len(packets)):
            part = slice(384 * k, 384 * (k + 1))
            yield stamp_ns[part], range_m[part], origin_m[part], direction[part]


def pulses_seen(
    things: Sequence[Thing],
    servo_rad: Servo,
    to_s: float,
    from_s: float = 0.0,
    mount: LidarMount = ON_ITS_SIDE,
) -> Iterator[SweptPulses]:
    """The slices of Sweep, placed without error."""
    for stamp_ns, range_m, origin_m, direction in packets_seen(things, servo_rad, from_s, to_s, mount):
        middle_s = (stamp_ns[192:193] - START_NS) * 1e-9
        yield SweptPulses(
            stamp_ns=int(stamp_ns[0]),
            point_stamp_ns=stamp_ns,
            direction_vehicle=direction.astype(np.float32),
            range_m=range_m.astype(np.float32),
            laser=LASER,
            reflectivity=np.full(384, 30, dtype=np.uint8),
            turntable_rad=float(mount.turntable_rad(servo_rad(middle_s))[0]),
            origin_vehicle_m=tuple(origin_m[192].tolist()),
        )


def together(slices: Iterator[SweptPulses], packets: int) -> Iterator[SweptPulses]:
    """The same pulses with so many packets in a slice."""
    while some := list(islice(slices, packets)):
        middle = some[len(some) // 2]
        yield SweptPulses(
            stamp_ns=some[0].stamp_ns,
            point_stamp_ns=np.concatenate([s.point_stamp_ns for s in some]),
            direction_vehicle=np.concatenate([s.direction_vehicle for s in some]),
            range_m=np.concatenate([s.range_m for s in some]),
            laser=np.concatenate([s.laser for s in some]),
            reflectivity=np.concatenate([s.reflectivity for s in some]),
            turntable_rad=middle.turntable_rad,
            origin_vehicle_m=middle.origin_vehicle_m,
        )


def seen(
    things: Sequence[Thing], servo_rad: Servo, seconds: float, mount: LidarMount = ON_ITS_SIDE
) -> Iterator[LidarFirings | ServoState]:
    """Packets of the VLP-16 at 600 rpm and servo states at 100 Hz, in order of time."""
    next_servo_ns = START_NS
    for stamp_ns, range_m, _, _ in packets_seen(things, servo_rad, 0.0, seconds, mount):
        while next_servo_ns <= stamp_ns[0]:
            yield servo(next_servo_ns, float(servo_rad(np.array((next_servo_ns - START_NS) / 1e9))))
            next_servo_ns += 10 * MS
        yield packet(stamp_ns, range_m)
    yield servo(next_servo_ns, float(servo_rad(np.array((next_servo_ns - START_NS) / 1e9))))


def packet(stamp_ns: np.ndarray, range_m: np.ndarray) -> LidarFirings:
    """One packet of the VLP-16 with these ranges (384,)."""
    return LidarFirings(
        stamp_ns=int(stamp_ns[0]),
        pulse_stamp_ns=stamp_ns,
        laser=LASER,
        azimuth_rad=azimuth_rad(stamp_ns).astype(np.float32),
        range_m=range_m.astype(np.float32),
        reflectivity=np.full(384, 30, dtype=np.uint8),
        return_kind=np.zeros(384, dtype=np.uint8),
        xyz_lidar_m=(beams_lidar(stamp_ns, LASER) * range_m[:, np.newaxis]).astype(np.float32),
        lost_packets=0,
        laser_elevation_rad=ELEVATION_RAD,
    )
