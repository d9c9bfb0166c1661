"""Fisheye images of the simulator's scenes with the true directions of their buildings, with and without clutter.

Each flight of the matrix (20 m, orbit, driving vehicle) gives images of both cameras, seconds apart. True directions are
the vertical, and the horizontal directions with at least `LEAST_SHARE` of the area of walls, or of kerbs and road marks.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from links.simulated.matrix.matrix import Cell, Conditions, scenario_of
from links.simulated.rig.run import Simulation
from links.simulated.rig.scenario import Scenario
from links.simulated.world.mesh import Mesh
from stages.messages import CameraMount, DroneTilt, Image
from tests.stages.panoramas import tilt_at

SCENES = ("manhattan", "atlanta", "campus", "park_edge", "open_lot")
LEAST_SHARE = 0.02
STRAIGHT = (("brick", "plaster", "concrete", "glass"), ("kerb", "marking"))
REACH_M = 130.0


@dataclass(frozen=True)
class View:
    """One image, its rotation, the drone's tilt (None for the vehicle) and what the stages are built with."""

    scenario: Scenario
    image: Image
    colour: np.ndarray  # (size, size, 3) RGB
    camera_mount: CameraMount
    R_world_mount: np.ndarray
    tilt: DroneTilt | None
    truth: np.ndarray  # (n, 3) directions, the vertical first


@functools.cache
def scenario_for(scene: str, seed: int, clutter: bool, size_px: int) -> Scenario:
    """The flight of one scene and seed."""
    conditions = Conditions(cameras_hz=5.0, cameras_px=size_px, autopilot=True, clutter=clutter)
    return scenario_of(Cell(scene, 20, "orbit", "driving"), seed, conditions)


def views(scene: str, seed: int, count: int, clutter: bool, size_px: int = 720) -> Iterator[View]:
    """`count` images of each camera, evenly spaced over a flight."""
    scenario = scenario_for(scene, seed, clutter, size_px)
    simulation = Simulation(scenario)
    truth = true_directions(simulation._scene.world_mesh)
    rng = np.random.default_rng([seed, 7])
    for frame, t_s in enumerate(np.linspace(0.5, scenario.duration_s - 0.5, count)):
        stamp_ns = scenario.start_ns + round(t_s * 1e9)
        poses = (simulation.truth.T_world_vehicle, simulation.truth.T_world_drone)
        for mount, camera, pose in zip(CameraMount, simulation._cameras, poses, strict=True):
            colour = camera.image(stamp_ns, frame)
            grey = cv2.imdecode(cv2.imencode(".jpg", colour[..., ::-1])[1], cv2.IMREAD_GRAYSCALE)
            readout_s = 1e-3 * camera.settings.readout_ms
            image = Image(stamp_ns=stamp_ns, frame_id=f"camera_{mount.value}", grey=grey, readout_s=readout_s)
            R = pose(np.array([stamp_ns]))[0][0]
            tilt = tilt_at(R, rng, stamp_ns) if mount is CameraMount.DRONE else None
            yield View(scenario, image, colour, mount, R, tilt, truth)


def true_directions(mesh: Mesh) -> np.ndarray:
    """(n, 3) the vertical, then horizontal directions: of walls, and of the longer side of flat marks."""
    found = np.radians(np.unique(np.concatenate([_azimuths_deg(mesh, names) for names in STRAIGHT])))
    level_axes = [np.array([np.cos(y + t), np.sin(y + t), 0.0]) for y in found for t in (0.0, np.pi / 2)]
    return np.array([[0.0, 0.0, 1.0], *level_axes])


def _azimuths_deg(mesh: Mesh, names: tuple[str, ...]) -> np.ndarray:
    """Azimuths (n,), modulo 90 deg, of the level edges of some surfaces."""
    triangle = mesh.vertices_m[mesh.faces]
    near = np.hypot(*triangle.mean(axis=1)[:, :2].T) < REACH_M
    used = mesh.is_surface(*names) & near
    a, b, c = (triangle[used, k] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1) / 2
    edges = np.stack([b - a, c - b, a - c], axis=1)
    level = np.abs(edges[..., 2]) < 1e-6
    length = np.where(level, np.linalg.norm(edges, axis=2), 0.0)
    k = np.argsort(length, axis=1)[:, -2]  # the longest level edge of a flat triangle is its diagonal
    k = np.where(level.sum(axis=1) == 1, np.argmax(length, axis=1), k)
    edge = edges[np.arange(len(k)), k]
    flat = np.abs(cross[:, 2]) > 1.9 * area
    keep = (length.max(axis=1) > 0.3) & (area > 1e-4) & (~flat | mesh.is_surface("marking")[used])
    yaw = np.mod(np.degrees(np.arctan2(edge[keep, 1], edge[keep, 0])), 90.0)
    weight = area[keep]
    if not len(weight):
        return np.empty(0)
    bins = np.round(yaw, 1) % 90.0
    values, inverse = np.unique(bins, return_inverse=True)
    share = np.bincount(inverse, weight) / weight.sum()
    return values[share > LEAST_SHARE]
