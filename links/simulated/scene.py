"""Everything rays can meet: the fixed world, the moving vehicle's body and the flying drone.

Source: ours. A moving body is cast in its own frame with the rays of each moment, so it moves within a revolution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from links.simulated.drone import BLADES, drone_mesh
from links.simulated.mesh import Array32, Array64, Mesh, RayScene
from links.simulated.path import Path

ROTOR_HZ = 95.0
ROTOR_STEPS = 8  # standing positions of the blades within half a turn
MOVES_M = 1.0  # no drone moves farther within half a batch of pulses
BODY_REACH_M = 200.0


@dataclass(frozen=True)
class Truth:
    """Where vehicle and drone are at any moment; `drone` is None in an empty sky."""

    start_ns: int
    vehicle: Path
    drone: Path | None

    def seconds(self, stamp_ns: NDArray[np.int64]) -> Array64:
        """Time since the start [s]."""
        return ((stamp_ns - self.start_ns) * 1e-9).astype(np.float64)

    def T_world_vehicle(self, stamp_ns: NDArray[np.int64]) -> tuple[Array64, Array64]:
        """Rotations (n, 3, 3) and positions (n, 3) [m]."""
        return self.vehicle.level_poses(self.seconds(stamp_ns))

    def T_world_drone(self, stamp_ns: NDArray[np.int64]) -> tuple[Array64, Array64]:
        """Rotations (n, 3, 3) and positions (n, 3) [m]; a LookupError when there is no drone."""
        if self.drone is None:
            raise LookupError("this scenario has no drone")
        return self.drone.flying_poses(self.seconds(stamp_ns))


class Scene:
    """The surroundings a simulated sensor looks into."""

    def __init__(self, world: Mesh, vehicle: Mesh, span_m: float, truth: Truth) -> None:
        self._truth = truth
        self._world = RayScene(world)
        self._vehicle = RayScene(vehicle)
        self._drone: list[RayScene] = []
        if truth.drone is not None:
            steps = np.arange(ROTOR_STEPS) * 2 * np.pi / BLADES / ROTOR_STEPS
            self._drone = [RayScene(drone_mesh(span_m, float(step))) for step in steps]

    def cast(
        self, pulse_ns: NDArray[np.int64], origins_world_m: Array32, directions_world: Array32, max_range_m: float
    ) -> tuple[Array32, Array32, NDArray[np.bool_]]:
        """See `lidar.Surroundings`."""
        rays = directions_world.shape[1]
        flat_o, flat_d = origins_world_m.reshape(-1, 3), directions_world.reshape(-1, 3)
        ranges, fractions = self._world.cast(flat_o, flat_d, max_range_m)
        ranges, fractions = ranges.reshape(-1, rays), fractions.reshape(-1, rays)
        is_drone = np.zeros(ranges.shape, dtype=np.bool_)

        downwards = np.nonzero((directions_world[:, :, 2] < 0).any(axis=1))[0]  # the body is below the LiDAR
        pose = self._truth.T_world_vehicle(pulse_ns[downwards])
        self._nearer(self._vehicle, downwards, pose, origins_world_m, directions_world, ranges, fractions)
        near = np.nonzero(self.near_drone(pulse_ns, origins_world_m[:, 0], directions_world[:, 0]))[0]
        turns = self._truth.seconds(pulse_ns[near]) * ROTOR_HZ
        step = (turns * BLADES * ROTOR_STEPS).astype(np.int64) % ROTOR_STEPS
        for index in np.unique(step):
            pick = near[step == index]
            pose = self._truth.T_world_drone(pulse_ns[pick])
            is_drone[pick] = self._nearer(
                self._drone[index], pick, pose, origins_world_m, directions_world, ranges, fractions
            )
        return ranges, fractions, is_drone

    def near_drone(
        self, pulse_ns: NDArray[np.int64], origins_world_m: Array32, directions_world: Array32
    ) -> NDArray[np.bool_]:
        """See `lidar.Surroundings`."""
        near = np.zeros(len(pulse_ns), dtype=np.bool_)
        if not self._drone:
            return near
        reach_m = self._drone[0].radius_m + 0.01  # the body and the beam's width where it leaves
        middle = pulse_ns[len(pulse_ns) // 2 : len(pulse_ns) // 2 + 1]
        maybe = np.nonzero(
            _passes(self._truth.T_world_drone(middle)[1], origins_world_m, directions_world, reach_m + MOVES_M)
        )[0]
        drone_world_m = self._truth.T_world_drone(pulse_ns[maybe])[1]
        near[maybe] = _passes(drone_world_m, origins_world_m[maybe], directions_world[maybe], reach_m)
        return near

    @staticmethod
    def _nearer(
        body: RayScene,
        pick: NDArray[np.intp],
        T_world_body: tuple[Array64, Array64],
        origins_world_m: Array32,
        directions_world: Array32,
        ranges: Array32,
        fractions: Array32,
    ) -> NDArray[np.bool_]:
        """Cast the picked pulses against a body in its own frame; nearer hits replace what was found. Which did."""
        R, t = T_world_body
        origins = (origins_world_m[pick] - t[:, None, :]) @ R  # R^T (p - t), points as rows
        directions = directions_world[pick] @ R
        found, fraction = body.cast(
            origins.reshape(-1, 3).astype(np.float32), directions.reshape(-1, 3).astype(np.float32), BODY_REACH_M
        )
        found, fraction = found.reshape(-1, ranges.shape[1]), fraction.reshape(-1, ranges.shape[1])
        nearer = found < ranges[pick]
        ranges[pick] = np.where(nearer, found, ranges[pick])
        fractions[pick] = np.where(nearer, fraction, fractions[pick])
        return nearer


def _passes(target_m: Array64, origins_m: Array32, directions: Array32, reach_m: float) -> NDArray[np.bool_]:
    """Rays (n, 3) that pass the target within the reach plus 2 mm per metre for the beam's spread."""
    to_target = target_m - origins_m
    ahead = np.einsum("ni,ni->n", to_target, directions)
    miss_squared = np.einsum("ni,ni->n", to_target, to_target) - ahead**2
    return (ahead > 0) & (miss_squared < (reach_m + 0.002 * ahead) ** 2)
