"""Everything a ray can hit: the static world, the body of the moving vehicle, the drones and other movers.

A moving body is cast in its own frame, with its pose at the time of each ray, so it moves within a revolution. Only
rays that meet its bounding box are cast, so the cost of a body grows with the rays near it, not with all rays.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from links.simulated.kernels.ray_casting import Array32, into_body, keep_nearer, rays_near
from links.simulated.world.drone import BLADES, DroneModel, drone_mesh
from links.simulated.world.flight import Flight
from links.simulated.world.flown_motion import FlownMotion
from links.simulated.world.mesh import Mesh, RayScene
from links.simulated.world.movers import Mover
from links.simulated.world.path import Path
from links.simulated.world.suspension import SuspendedPath
from stages.geometry.frames import Array64

ROTOR_HZ = 95.0
ROTOR_STEPS = 8  # blade positions within half a turn
TOP_SPEED_MPS = 50.0  # upper bound for drones and vehicle
BOX_MARGIN_M = 0.01
BEAM_START_M = 0.01  # half width of a beam where it leaves the sensor


@dataclass(frozen=True)
class Truth:
    """Poses of vehicle and drones at any time; `drone` is None in an empty sky."""

    start_ns: int
    vehicle: Path | SuspendedPath  # a path stays level, a suspended path pitches and rolls
    drone: Path | Flight | FlownMotion | None  # followed exactly; with its own dynamics; flown by an autopilot
    others: tuple[Path | Flight, ...] = ()  # drones 2, 3, ...

    def seconds(self, stamp_ns: NDArray[np.int64]) -> Array64:
        """Time since the start [s]."""
        return ((stamp_ns - self.start_ns) * 1e-9).astype(np.float64)

    def T_world_vehicle(self, stamp_ns: NDArray[np.int64]) -> tuple[Array64, Array64]:
        """Rotations (n, 3, 3) and positions (n, 3) [m]."""
        return self.vehicle.level_poses(self.seconds(stamp_ns))

    @property
    def drones(self) -> range:
        """Numbers of the drones, from 1."""
        return range(1, 1 if self.drone is None else 2 + len(self.others))

    def T_world_drone(self, stamp_ns: NDArray[np.int64], number: int = 1) -> tuple[Array64, Array64]:
        """Rotations (n, 3, 3) and positions (n, 3) [m]. LookupError when there is no such drone."""
        flown = (self.drone, *self.others)[number - 1] if number in self.drones else None
        if flown is None:
            raise LookupError(f"this scenario has no drone {number}")
        return flown.flying_poses(self.seconds(stamp_ns))


@dataclass(frozen=True)
class Body:
    """Something that moves: its shapes and its pose over time."""

    name: str  # vehicle, drone, drone_2, car, bird, balloon
    meshes: tuple[Mesh, ...]  # in the frame of the body
    pose: Callable[[NDArray[np.int64]], tuple[Array64, Array64]]  # T_world_body at times (n,) [ns]
    shape: Callable[[NDArray[np.int64]], NDArray[np.int64]] | None  # index of its mesh at times (n,); None: always 0
    speed_mps: float  # upper bound
    small: bool  # pulses that pass near it are cast with the fine pattern
    wetness: float = 0.0
    drone: int = 0  # number of the drone, from 1; 0: not a drone

    @cached_property
    def scenes(self) -> tuple[RayScene, ...]:
        """The shapes, prepared for ray casting."""
        return tuple(RayScene(mesh, self.wetness) for mesh in self.meshes)

    @cached_property
    def radius_m(self) -> float:
        """Radius around the origin of the body that contains all shapes."""
        return max(scene.radius_m for scene in self.scenes)

    @cached_property
    def box_m(self) -> tuple[Array64, Array64]:
        """Lower and upper corner of the bounding box of all shapes, with a margin."""
        low = np.min([mesh.vertices_m.min(axis=0) for mesh in self.meshes], axis=0)
        high = np.max([mesh.vertices_m.max(axis=0) for mesh in self.meshes], axis=0)
        return low - BOX_MARGIN_M, high + BOX_MARGIN_M

    def near(
        self, pulse_ns: NDArray[np.int64], origins_m: Array32, directions: Array32
    ) -> tuple[NDArray[np.intp], Array64, Array64]:
        """Pulses (of n, axes (n, 3)) that may hit the body, and its poses at their times (m, 3, 3), (m, 3).

        The result does not depend on how the pulses are batched.
        """
        middle = pulse_ns[len(pulse_ns) // 2 : len(pulse_ns) // 2 + 1]
        away_s = 1e-9 * max(int(pulse_ns.max() - middle[0]), int(middle[0] - pulse_ns.min()))
        reach_m = self.radius_m + BEAM_START_M
        maybe = rays_near(self.pose(middle)[1], origins_m, directions, reach_m + self.speed_mps * away_s)
        if len(maybe) == 0:
            return maybe, np.empty((0, 3, 3)), np.empty((0, 3))
        R, t = self.pose(pulse_ns[maybe])
        if self.small:
            close = rays_near(t, origins_m[maybe], directions[maybe], reach_m)
            maybe, R, t = maybe[close], R[close], t[close]
        return maybe, R, t


class Scene:
    """The environment of the simulated sensors. `world` and `bodies` are for sensors that cast rays of their own."""

    def __init__(
        self,
        world: Mesh,
        vehicle: Mesh,
        drone: tuple[Mesh, ...],
        truth: Truth,
        movers: Sequence[Mover] = (),
        wetness: float = 0.0,
        others: Sequence[tuple[Mesh, ...]] = (),
    ) -> None:
        """`drone` and `others` are the meshes of `drone_shapes` for drones 1, 2, 3, ...; empty in an empty sky."""
        self.world_mesh = world
        self.world = RayScene(world, wetness)
        self._truth = truth
        self.bodies = [Body("vehicle", (vehicle,), truth.T_world_vehicle, None, TOP_SPEED_MPS, False, wetness)]
        for number, shapes in zip(truth.drones, (drone, *others), strict=False):
            name = "drone" if number == 1 else f"drone_{number}"
            flown = partial(truth.T_world_drone, number=number)
            self.bodies.append(Body(name, shapes, flown, self._rotor_step, TOP_SPEED_MPS, True, drone=number))
        for mover in movers:
            self.bodies.append(
                Body(
                    mover.name,
                    mover.meshes,
                    partial(self._at_seconds, mover.poses),
                    partial(self._at_seconds, mover.shape),
                    mover.speed_mps,
                    mover.small,
                    wetness,
                )
            )

    def _at_seconds(self, function: Callable[[Array64], Any], stamp_ns: NDArray[np.int64]) -> Any:
        return function(self._truth.seconds(stamp_ns))

    def _rotor_step(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        turns = self._truth.seconds(stamp_ns) * ROTOR_HZ
        return (turns * BLADES * ROTOR_STEPS).astype(np.int64) % ROTOR_STEPS

    def cast(
        self, pulse_ns: NDArray[np.int64], origins_world_m: Array32, directions_world: Array32, max_range_m: float
    ) -> tuple[Array32, Array32, NDArray[np.uint8]]:
        """See `lidar.Environment`."""
        rays = directions_world.shape[1]
        flat_o, flat_d = origins_world_m.reshape(-1, 3), directions_world.reshape(-1, 3)
        ranges = np.full(len(flat_o), np.inf, dtype=np.float32)
        fractions = np.zeros(len(flat_o), dtype=np.float32)
        drone = np.zeros(len(flat_o), dtype=np.uint8)
        for body in self.bodies:
            pick, R, t = body.near(pulse_ns, origins_world_m[:, 0], directions_world[:, 0])
            if len(pick) == 0:
                continue
            origins, directions, ray = into_body(R, t, origins_world_m, directions_world, pick, *body.box_m)
            shape = None if body.shape is None else body.shape(pulse_ns[ray // rays])
            for index, scene in enumerate(body.scenes):
                of_shape = slice(None) if shape is None else np.nonzero(shape == index)[0]
                target = ray[of_shape]
                if len(target):
                    found = scene.cast(origins[of_shape], directions[of_shape], max_range_m)
                    nearer = keep_nearer(target, *found, ranges, fractions)
                    drone[nearer] = body.drone
        limit = np.minimum(ranges, np.float32(max_range_m))  # Embree is faster on short rays
        drone[keep_nearer(None, *self.world.cast(flat_o, flat_d, limit), ranges, fractions)] = 0
        return ranges.reshape(-1, rays), fractions.reshape(-1, rays), drone.reshape(-1, rays)

    def near_small_body(
        self, pulse_ns: NDArray[np.int64], origins_world_m: Array32, directions_world: Array32
    ) -> NDArray[np.bool_]:
        """See `lidar.Environment`."""
        near = np.zeros(len(pulse_ns), dtype=np.bool_)
        for body in self.bodies:
            if body.small:
                near[body.near(pulse_ns, origins_world_m, directions_world)[0]] = True
        return near


def drone_shapes(span_m: float, model: DroneModel) -> tuple[Mesh, ...]:
    """The drone with its blades in each of their positions."""
    steps = np.arange(ROTOR_STEPS) * 2 * np.pi / BLADES / ROTOR_STEPS
    return tuple(drone_mesh(span_m, float(step), model) for step in steps)
