"""Builds a scene by kind and seed: the static mesh and the movers.

Source: ours. Scenes are built in the scene frame, road axis along x, z = 0 on the carriageway, and returned in the
world frame, whose origin is the vehicle camera at the start. Nothing here depends on the method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from links.simulated.world.mesh import Mesh, merge
from links.simulated.world.movers import Car, Mover, draw_balloon, draw_bird
from links.simulated.world.procedural.atlanta import atlanta
from links.simulated.world.procedural.clutter import clutter, people
from links.simulated.world.procedural.open_scenes import campus, open_lot, park_edge
from links.simulated.world.procedural.parts import car
from links.simulated.world.procedural.settings import HALF_LENGTH_M, Kind, SceneSettings, VehicleCorridor
from links.simulated.world.procedural.street import manhattan, street
from links.simulated.world.procedural.village import village, village_movers
from links.simulated.world.sky_movers import draw_sky
from stages.geometry.frames import Array64, rotation_z

KINDS: dict[Kind, Callable[[SceneSettings, VehicleCorridor, Generator], list[Mesh]]] = {
    "street": street,
    "manhattan": manhattan,
    "atlanta": atlanta,
    "campus": campus,
    "park_edge": park_edge,
    "open_lot": open_lot,
    "village": village,
}
PARKED = np.zeros((1, 2))


@dataclass(frozen=True)
class World:
    """A scene in the world frame: its static mesh and its movers."""

    mesh: Mesh
    movers: tuple[Mover, ...]


def build_world(settings: SceneSettings, camera_height_m: float, seed: int, vehicle_xy_m: Array64 = PARKED) -> World:
    """The scene. The same settings, seed and vehicle path (n, 2), world frame, give the same scene."""
    yaw = np.radians(settings.vehicle_yaw_deg)
    start = np.array([0.0, settings.vehicle_lane_y_m])
    corridor = VehicleCorridor(vehicle_xy_m @ rotation_z(yaw)[:2, :2].T + start)
    parts = KINDS[settings.kind](settings, corridor, np.random.default_rng([seed, 1]))
    walkers: list[Mover] = []
    if settings.clutter:
        parts += clutter(settings, corridor, np.random.default_rng([seed, 30]))
        R = rotation_z(-yaw)
        shift = R @ np.array([0.0, -settings.vehicle_lane_y_m, -camera_height_m])
        walkers += people(settings, corridor, (R, shift), np.random.default_rng([seed, 31]))
    mesh = merge(parts).moved((0.0, -settings.vehicle_lane_y_m, -camera_height_m)).moved(rotation=rotation_z(-yaw))
    movers = _movers(settings, camera_height_m, corridor, np.random.default_rng([seed, 10]))
    return World(mesh, (*movers, *walkers))


def world_mesh(settings: SceneSettings, camera_height_m: float, seed: int) -> Mesh:
    """The static mesh of the scene around a parked vehicle."""
    return build_world(settings, camera_height_m, seed).mesh


def _movers(
    settings: SceneSettings, camera_height_m: float, corridor: VehicleCorridor, rng: Generator
) -> tuple[Mover, ...]:
    cars, birds, balloons = settings.movers()
    turn = rotation_z(-np.radians(settings.vehicle_yaw_deg))
    movers: list[Mover] = []
    lane_y = -settings.vehicle_lane_y_m  # the other lane
    for _ in range(cars):
        forward = -np.sign(lane_y) or -1.0
        ends = np.array([[-forward, lane_y, 0.0], [forward, lane_y, 0.0]]) * [HALF_LENGTH_M, 1.0, 1.0]
        ends = (ends - [0.0, settings.vehicle_lane_y_m, camera_height_m]) @ turn.T
        driver = Car(car(rng), ends[0], ends[1], rng.uniform(5, 14), rng.uniform(0, 60))
        if corridor.allows(np.arange(-HALF_LENGTH_M, HALF_LENGTH_M, 1.0), lane_y, 1.0):
            movers.append(driver)
    if settings.kind == "village":
        return (*movers, *village_movers(rng, birds + balloons))
    if settings.sky == "varied":
        return (*movers, *draw_sky(rng, birds + balloons))
    road = settings.road_width_m / 2
    for _ in range(birds):
        movers.append(draw_bird(rng, 3.0, 22.0, 28.0, road + 1.0, turn))
    for _ in range(balloons):
        movers.append(draw_balloon(rng, 4.0, 14.0, 18.0, road, turn))
    return tuple(movers)
