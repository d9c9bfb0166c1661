"""The scenario matrix: range x motion x vehicle x scene, an occlusion and a flight out of sight and back, by seed.

A cell says what happens (`links/simulated/matrix_flights.py`), a seed where: it draws the scene and the side.

Source: ours, after the cases of issue "A simulated rig".
"""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import fnmatch
from itertools import product
from pathlib import Path as FilePath

import numpy as np

from flow.link import LinkError
from links.recording import RecordingReader
from links.simulated.clearance import sample_times_s
from links.simulated.drone import DroneModel
from links.simulated.matrix_flights import CAMERA_HEIGHT_M, Cell, drone_path, vehicle_path
from links.simulated.run import simulate_into
from links.simulated.scenario import DroneSettings, Scenario
from links.simulated.servo import ServoSettings
from links.simulated.world import SceneSettings
from links.simulated.world.settings import Kind

RANGES_M = (10, 20, 30, 45, 60)
MOTIONS = ("hover", "orbit", "cross", "fast", "overhead", "climb")
VEHICLES = ("parked", "driving", "turning")
SCENES: tuple[Kind, ...] = ("manhattan", "atlanta", "campus", "park_edge", "open_lot")
OPEN: Kind = "open_lot"  # nothing to hide behind
SPECIALS = {"occlusion": 35, "return": 20}  # at which range
LIDAR_UP_M = 0.35  # over the camera, as in the standard rig
DRONE = DroneModel(surface="grey_shell")  # the LiDAR sees half of it at 45 m, nothing at 70 m
SERVO = ServoSettings(command_latency_s=0.002, command_jitter_s=5e-4, encoder_error_deg=0.3, backlash_deg=0.33)


def cells(only: str = "*", pairs: bool = False) -> list[Cell]:
    """All cells whose name matches a pattern (`campus-*-parked`).

    With `pairs` a small part in which each two values of range, motion, vehicle and scene still meet at least once.
    """
    found: list[Cell] = []
    for (r, range_m), (m, motion), (v, vehicle), (s, scene) in product(
        enumerate(RANGES_M), enumerate(MOTIONS), enumerate(VEHICLES), enumerate(SCENES)
    ):
        if not pairs or (v == (r + m) % len(VEHICLES) and s == (r + 3 * m) % len(SCENES)):
            found.append(Cell(scene, range_m, motion, vehicle))
    found += [Cell(scene, SPECIALS["return"], "return", "parked") for scene in SCENES]
    found += [Cell(scene, SPECIALS["occlusion"], "occlusion", "parked") for scene in SCENES if scene != OPEN]
    return [cell for cell in found if fnmatch(cell.name, only)]


def scenario_of(cell: Cell, seed: int) -> Scenario:
    """The scenario of a cell. LinkError when the seed's scene has no place for it (no building to hide behind)."""
    rng = np.random.default_rng([seed, 42])
    times = sample_times_s(cell.duration_s)
    vehicle, world = vehicle_path(cell, seed, rng, times)
    lidar_m = vehicle.at(times)[0] + [0.0, 0.0, LIDAR_UP_M]
    drone = drone_path(cell, world, rng, times, lidar_m)
    return Scenario(
        name=cell.name,
        description=f"{cell.motion} at {cell.range_m} m, vehicle {cell.vehicle}, {cell.scene}",
        seed=seed,
        start_utc=datetime.datetime(2025, 6, 1, 10, 20, 30, tzinfo=datetime.UTC),
        duration_s=cell.duration_s,
        scene=SceneSettings(kind=cell.scene),
        vehicle={"camera_height_m": CAMERA_HEIGHT_M, "path": vehicle},  # pyright: ignore[reportArgumentType]
        drone=DroneSettings(path=drone, model=DRONE),
        servo=SERVO,
        script=({"do": "sweep"}, {"do": "vibrate", "duration_s": 60.0, "follow_drone": True}),  # pyright: ignore[reportArgumentType]
    )


def is_made(file: FilePath, scenario: Scenario, closed_loop: str | None) -> bool:
    """Whether a file is the complete recording of this scenario, made in the same way."""
    if not file.is_file():
        return False
    try:
        with RecordingReader(file) as reader:
            same = reader.config_yaml == scenario.as_yaml() and reader.metadata.get("closed_loop") == closed_loop
            return same and reader.finished
    except LinkError:
        return False


@dataclass(frozen=True)
class MatrixReport:
    """What a run over the matrix did."""

    made: int
    kept: int  # were there, complete and the same
    impossible: tuple[str, ...]  # cells that a seed's scene has no place for, in words


def make_matrix(
    folder: FilePath,
    wanted: list[Cell],
    seeds: range,
    closed_loop: FilePath | None,
    progress: Callable[[float, float], None],
) -> MatrixReport:
    """Make what is missing: `folder/<cell>-s<seed>.mcap`. `progress` is told simulated seconds done and in all."""
    folder.mkdir(parents=True, exist_ok=True)
    whole_s = sum(cell.duration_s for cell in wanted) * len(seeds)
    done_s, made, kept = 0.0, 0, 0
    impossible: list[str] = []
    for seed, cell in product(seeds, wanted):
        file = folder / f"{cell.name}-s{seed}.mcap"
        try:
            scenario = scenario_of(cell, seed)
        except LinkError as error:
            impossible.append(f"seed {seed}: {error}")
        else:
            if is_made(file, scenario, closed_loop and closed_loop.name):
                kept += 1
            else:
                start_s = done_s
                simulate_into(
                    file,
                    scenario,
                    progress=lambda share, cell=cell, at=start_s: progress(at + share * cell.duration_s, whole_s),
                    overwrite=True,
                    closed_loop=closed_loop,
                )
                made += 1
        done_s += cell.duration_s
        progress(done_s, whole_s)
    return MatrixReport(made, kept, tuple(impossible))
