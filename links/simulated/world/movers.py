"""Moving objects other than vehicle and drones: cars, birds that beat their wings, a balloon on its string.

A mover is cast in its own frame, with its pose at the time of each ray, as vehicle and drones are. All paths are
closed, so that a mover stays near however long a scenario lasts. Movers do not avoid each other or the drone.

Source: ours; speeds of birds: Alerstam et al., PLoS Biology 5 (2007) e197 (crows and gulls: 9 to 14 m/s in still air).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from links.simulated.kernels.motion import rotations_z
from links.simulated.world.mesh import Mesh, box, merge, quads, rod
from stages.geometry.frames import Array64

FLAP_STEPS = 8


class Mover(Protocol):
    """A body with a pose and a shape at every time."""

    @property
    def name(self) -> str:
        """Kind of object: car, bird, balloon."""
        ...

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        """Its shapes, in its own frame; one for a rigid body."""
        ...

    @property
    def speed_mps(self) -> float:
        """Upper bound of its speed."""
        ...

    @property
    def small(self) -> bool:
        """Whether pulses that pass near it are cast with the fine pattern."""
        ...

    def poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        """T_world_body at times (n,) after the start: rotations (n, 3, 3), positions (n, 3) [m]."""
        ...

    def shape(self, time_s: Array64) -> NDArray[np.int64]:
        """Index into `meshes` at times (n,)."""
        ...


@dataclass(frozen=True)
class Car:
    """Drives along a straight line at constant speed and restarts at its beginning."""

    mesh: Mesh
    start_m: Array64  # (3,) world
    end_m: Array64
    speed_mps: float
    head_start_s: float
    name: str = "car"
    small: bool = False

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        return (self.mesh,)

    def poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        along = self.end_m - self.start_m
        length_m = float(np.linalg.norm(along))
        share = np.mod((time_s + self.head_start_s) * self.speed_mps / length_m, 1.0)
        yaw = np.full(len(share), np.arctan2(along[1], along[0]))
        return rotations_z(yaw), self.start_m + share[:, None] * along

    def shape(self, time_s: Array64) -> NDArray[np.int64]:
        return np.zeros(len(time_s), dtype=np.int64)


@dataclass(frozen=True)
class Bird:
    """Flies around an ellipse while it rises and falls, slightly banked, beating its wings."""

    span_m: float
    centre_m: Array64  # (3,) world
    radii_m: Array64  # (3,): along, across, vertical
    heading_rad: float  # of the major axis
    lap_s: float
    beat_hz: float
    phase: float  # 0 to 1
    name: str = "bird"
    small: bool = True

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        return tuple(bird_mesh(self.span_m, 2 * np.pi * step / FLAP_STEPS) for step in range(FLAP_STEPS))

    @property
    def speed_mps(self) -> float:
        along, across, up = self.radii_m
        return float(2 * np.pi / self.lap_s * np.hypot(max(along, across), 2 * up))

    def poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        angle = 2 * np.pi * (time_s / self.lap_s + self.phase)
        position = np.column_stack([np.cos(angle), np.sin(angle), np.sin(2 * angle)]) * self.radii_m
        tangent = np.column_stack([-np.sin(angle), np.cos(angle)]) * self.radii_m[:2]
        turn = rotations_z(np.full(1, self.heading_rad))[0]
        yaw = np.arctan2(tangent[:, 1], tangent[:, 0]) + self.heading_rad
        return rotations_z(yaw) @ _BANK, position @ turn.T + self.centre_m

    def shape(self, time_s: Array64) -> NDArray[np.int64]:
        return np.floor(np.mod(time_s * self.beat_hz + self.phase, 1.0) * FLAP_STEPS).astype(np.int64)


_BANK = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(0.3), np.sin(0.3)], [0.0, -np.sin(0.3), np.cos(0.3)]])  # inwards


@dataclass(frozen=True)
class Balloon:
    """Sways on its string in the wind."""

    diameter_m: float
    anchor_m: Array64  # (3,) world: its mean position
    sway_m: float
    period_s: float
    phase: float
    name: str = "balloon"
    small: bool = True

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        return (balloon_mesh(self.diameter_m),)

    @property
    def speed_mps(self) -> float:
        return 2 * np.pi * self.sway_m / self.period_s * 1.7

    def poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        angle = 2 * np.pi * (time_s / self.period_s + self.phase)
        sway = self.sway_m * np.column_stack([np.sin(angle), 0.6 * np.sin(1.6 * angle), 0.2 * np.cos(2 * angle)])
        return rotations_z(0.3 * np.sin(angle)), self.anchor_m + sway

    def shape(self, time_s: Array64) -> NDArray[np.int64]:
        return np.zeros(len(time_s), dtype=np.int64)


def bird_mesh(span_m: float, beat_rad: float) -> Mesh:
    """Body, tail and two wings, raised by 35 deg * cos(beat); the outer wings lag behind."""
    b = 0.5 * span_m
    raised, lag = 0.6 * np.cos(beat_rad), 0.6 * np.cos(beat_rad - 0.9)
    parts = [
        box((-0.30 * b, -0.09 * b, -0.08 * b), (0.35 * b, 0.09 * b, 0.10 * b), "feather", taper=0.3),
        quads([[(-0.3 * b, -0.05 * b, 0), (-0.3 * b, 0.05 * b, 0), (-0.7 * b, 0.14 * b, 0), (-0.7 * b, -0.14 * b, 0)]],
              "feather"),
    ]  # fmt: skip
    for side in (-1.0, 1.0):
        wrist = b * np.array([0.08, side * 0.5 * np.cos(raised), 0.5 * np.sin(raised)])
        tip = wrist + b * np.array([-0.10, side * 0.5 * np.cos(lag), 0.5 * np.sin(lag)])
        root = b * np.array([0.12, side * 0.06, 0.05])
        chord = b * np.array([-0.34, 0.0, 0.0])
        parts.append(quads([[root, wrist, wrist + 0.95 * chord, root + chord]], "feather"))
        parts.append(quads([[wrist, tip, tip + 0.35 * chord, wrist + 0.95 * chord]], "feather"))
    return merge(parts)


def balloon_mesh(diameter_m: float) -> Mesh:
    """A pear of 8 rings of 12 quads, centred on the origin, with half a metre of string."""
    up = np.linspace(-1, 1, 9)
    radius = np.sqrt(np.maximum(1 - up**2, 0)) * (1 - 0.12 * (1 - up) / 2)
    turn = np.linspace(0, 2 * np.pi, 13)
    ring = radius[:, None]
    grid = np.stack([ring * np.cos(turn), ring * np.sin(turn), np.tile(1.15 * up[:, None], 13)], axis=2)
    grid *= diameter_m / 2
    skin = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=2).reshape(-1, 4, 3)
    low = -0.575 * diameter_m
    return merge([quads(skin, "latex"), rod((0, 0, low), (0, 0, low - 0.5), 0.002, "wire", sides=3)])


def draw_bird(
    rng: Generator, low_m: float, high_m: float, along_m: float, across_m: float, R_world_scene: Array64
) -> Bird:
    """A bird near the vehicle's start, of small to gull size, 7 to 12 m/s, in a box along the road (half sizes)."""
    radii = np.array([rng.uniform(0.4, 1.0) * along_m, rng.uniform(0.3, 0.8) * across_m, rng.uniform(0.2, 1.2)])
    height = rng.uniform(low_m, high_m)
    drift = (along_m - radii[0]) * rng.uniform(-1, 1)
    lap_m = 2 * np.pi * np.sqrt((radii[0] ** 2 + radii[1] ** 2) / 2)
    return Bird(
        span_m=rng.uniform(0.3, 1.1),
        centre_m=R_world_scene @ np.array([drift, 0.2 * across_m * rng.uniform(-1, 1), height]),
        radii_m=radii,
        heading_rad=float(np.arctan2(R_world_scene[1, 0], R_world_scene[0, 0])),
        lap_s=lap_m / rng.uniform(7, 12),
        beat_hz=rng.uniform(3.0, 6.0),
        phase=rng.uniform(),
    )


def draw_balloon(
    rng: Generator, low_m: float, high_m: float, along_m: float, across_m: float, R_world_scene: Array64
) -> Balloon:
    """A party balloon in a box along the road (half sizes)."""
    position = np.array([rng.uniform(-1, 1) * along_m, rng.uniform(-1, 1) * across_m, rng.uniform(low_m, high_m)])
    return Balloon(
        diameter_m=rng.uniform(0.28, 0.6),
        anchor_m=R_world_scene @ position,
        sway_m=rng.uniform(0.2, 0.8),
        period_s=rng.uniform(3, 7),
        phase=rng.uniform(),
    )
