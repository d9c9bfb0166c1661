"""The scenario matrix: range x motion x vehicle x scene, an occlusion, and a flight out of range and back, by seed.

Special cells are added: an empty sky, an occlusion at a shorter range, two drones, a drone to search for, drones at
50 m. A cell determines what happens (`links/simulated/matrix/flights.py`), a seed where: it draws scene and direction.

Source: ours.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from itertools import chain, product

import numpy as np

from links.simulated.autopilot.autopilot import AutopilotSettings
from links.simulated.matrix.flights import CAMERA_HEIGHT_M, Cell, drone_path, two_paths, vehicle_path
from links.simulated.rig.perturbed_rig import PerturbedRig, draw_perturbed_rig
from links.simulated.rig.scenario import DroneSettings, OtherDroneSettings, RigLidar, Scenario
from links.simulated.rig.scripted_servo import SweepSegment, VibrateSegment
from links.simulated.sensors.camera import CameraSettings, CamerasSettings
from links.simulated.sensors.lidar import LidarSettings
from links.simulated.sensors.servo import GearTrain, ServoSettings
from links.simulated.sensors.vehicle_odometry import VehicleOdometrySettings
from links.simulated.world.clearance import sample_times_s
from links.simulated.world.drone import DroneModel
from links.simulated.world.procedural import SceneSettings
from links.simulated.world.procedural.settings import Kind
from links.simulated.world.weather import Weather
from stages.calibration.calibrate import ZERO_SIGMA_DEG
from stages.geometry.lidar_models import LidarModel

RANGES_M = (10, 20, 30, 45, 60)
MOTIONS = ("hover", "orbit", "cross", "fast", "overhead", "climb")
VEHICLES = ("parked", "driving", "turning")
SCENES: tuple[Kind, ...] = ("manhattan", "atlanta", "campus", "park_edge", "open_lot")
OPEN: Kind = "open_lot"  # has no obstacle that could hide a drone
SPECIALS = {"occlusion": 35, "return": 20}  # motion: range
SECOND: Kind = "village"  # the second generator, only where a pattern names it
SPECIAL_CELLS = (  # range, motion, vehicles; in every scene where they are possible
    (0, "empty", VEHICLES),
    (20, "occlusion", ("parked",)),
    (20, "two", ("parked",)),
    (40, "search", ("parked",)),
    (50, "hover", ("parked",)),
    (50, "orbit", ("parked",)),
)
SEARCHING = ("empty", "two", "search")  # without a closed loop the servo only sweeps
LIDAR_UP_M = 0.35  # above the camera, as in the standard rig
DRONE = DroneModel(surface="grey_shell")  # the LiDAR gets half of the returns at 45 m, none at 70 m
SERVO = ServoSettings(command_latency_s=0.002, command_jitter_s=5e-4, encoder_error_deg=0.3, backlash_deg=0.33)
SWEEPS = (SweepSegment(times=100),)
SWEEP_THEN_FOLLOW = (SweepSegment(), VibrateSegment(duration_s=60.0, follow_drone=True))
RAIN = Weather(rain_mmph=5.0)
READOUT_MS = 20.0  # of a common rolling shutter, first to last row
CLUTTERED_LENS = {"dirt_spots": 12, "flare": 1.0}


@dataclass(frozen=True)
class Conditions:
    """Conditions common to all cells of one run over the matrix."""

    calibrated: bool = False  # the rig file has the encoder's error and the backlash, as `grd calibrate` writes it
    odometry: bool = False  # the vehicle sends odometry
    rain: bool = False  # 5 mm/h
    autopilot: bool = False  # the drone sends telemetry over a radio, and obeys flight dynamics
    cameras_hz: float | None = None  # rate of two fisheyes; None: no cameras
    cameras_px: int = 720  # size of their square images
    readout_ms: float = 0.0  # of their rolling shutter, first to last row; 0: global shutter
    lidar: LidarModel = "VLP-16"
    perturbed: bool = False  # the rig differs from its file, and the kind of drone varies between flights
    sparse: bool = False  # fewer rays per pulse: half the time
    varied_sky: bool = False  # movers of `links/simulated/world/sky_movers.py`
    clutter: bool = False  # of the scene; with it rolling shutter, dirt and flare, and a sun of the seed's own


def cells(only: Sequence[str] = ("*",), pairs: bool = False) -> list[Cell]:
    """All cells whose name matches one of the patterns (`campus-*-parked`).

    With `pairs` a small subset in which any two values of range, motion, vehicle and scene occur together at least
    once; it has no special cells.
    """
    found: list[Cell] = []
    for (r, range_m), (m, motion), (v, vehicle), (s, scene) in product(
        enumerate(RANGES_M), enumerate(MOTIONS), enumerate(VEHICLES), enumerate(SCENES)
    ):
        if not pairs or (v == (r + m) % len(VEHICLES) and s == (r + 3 * m) % len(SCENES)):
            found.append(Cell(scene, range_m, motion, vehicle))
    found += [Cell(scene, SPECIALS["return"], "return", "parked") for scene in SCENES]
    found.extend(_in_every_scene(SPECIALS["occlusion"], "occlusion", ("parked",)))
    if not pairs:
        found.extend(chain.from_iterable(_in_every_scene(*special) for special in SPECIAL_CELLS))
    if not pairs and any("wander" in pattern or pattern.startswith(SECOND) for pattern in only):
        wandering = product((*SCENES, SECOND), (10, 20, 30, 40), ("wander",), VEHICLES)
        second = product((SECOND,), (20, 30, 40), ("hover",), VEHICLES)
        found += [Cell(*values) for values in (*wandering, *second)]
        found += [Cell(SECOND, 0, "empty", vehicle) for vehicle in VEHICLES]
    return [cell for cell in found if any(fnmatch(cell.name, pattern) for pattern in only)]


def _in_every_scene(range_m: int, motion: str, vehicles: Sequence[str]) -> Iterator[Cell]:
    """The cell in every scene; an occlusion only where there are obstacles."""
    for scene, vehicle in product(SCENES, vehicles):
        if not (motion == "occlusion" and scene == OPEN):
            yield Cell(scene, range_m, motion, vehicle)


def scenario_of(cell: Cell, seed: int, conditions: Conditions | None = None) -> Scenario:
    """The scenario of a cell. LinkError when the scene of the seed does not allow it (no building to hide behind)."""
    conditions = conditions or Conditions()
    rng = np.random.default_rng([seed, 42])
    times = sample_times_s(cell.duration_s)
    vehicle, world = vehicle_path(cell, seed, rng, times)
    lidar_m = vehicle.at(times)[0] + [0.0, 0.0, LIDAR_UP_M]
    if cell.motion == "empty":
        paths = ()
    elif cell.motion == "two":
        paths = two_paths(cell, world, rng, times, lidar_m)
    else:
        paths = (drone_path(cell, world, rng, times, lidar_m),)
    perturbed = draw_perturbed_rig(cell.name, seed) if conditions.perturbed else None
    appearance = {"model": DRONE} if perturbed is None else {"model": perturbed.model, "span_m": perturbed.span_m}
    drones = tuple(DroneSettings.model_validate({"path": path} | appearance) for path in paths)
    what = f"{cell.motion} at {cell.range_m} m" if drones else "no drone"
    nominal = RigLidar.model_validate({"model": conditions.lidar})
    found = {
        "servo_harmonics": GearTrain(SERVO, seed).harmonics(),
        "servo_play_deg": SERVO.backlash_deg,
        "pointing_sigma_deg": ZERO_SIGMA_DEG,  # as `grd calibrate` writes it
    }
    calibrated = nominal.mount.model_copy(update=found)
    true_mount = nominal.mount if conditions.calibrated else None
    if perturbed is not None:
        true_mount = perturbed.mount(nominal.mount)
    return Scenario(
        name=cell.name,
        description=f"{what}, vehicle {cell.vehicle}, {cell.scene}",
        seed=seed,
        start_utc=datetime.datetime(2025, 6, 1, 10, 20, 30, tzinfo=datetime.UTC),
        duration_s=cell.duration_s,
        scene=SceneSettings(
            kind=cell.scene, sky="varied" if conditions.varied_sky else "usual", clutter=conditions.clutter
        ),
        vehicle={"camera_height_m": CAMERA_HEIGHT_M, "path": vehicle},  # pyright: ignore[reportArgumentType]
        drone=drones[0] if drones else None,
        other_drones=tuple(OtherDroneSettings(**dict(drone)) for drone in drones[1:]),
        servo=SERVO,
        script=SWEEPS if cell.motion in SEARCHING else SWEEP_THEN_FOLLOW,
        truth_visible=bool(drones),
        autopilot=AutopilotSettings() if conditions.autopilot and drones else None,
        lidar=LidarSettings(
            footprint="sparse" if conditions.sparse else "dense",
            range_offset_m=0.0 if perturbed is None else perturbed.range_offset_m,
        ),
        cameras=_cameras(conditions, bool(drones), perturbed),
        weather=_weather(conditions, seed),
        vehicle_odometry=VehicleOdometrySettings() if conditions.odometry else None,
        rig=nominal.model_copy(update={"mount": calibrated}) if conditions.calibrated else nominal,
        true_mount=true_mount,
    )


def _weather(conditions: Conditions, seed: int) -> Weather:
    """The weather of a flight; with clutter each seed has its own sun."""
    weather = RAIN if conditions.rain else Weather()
    if not conditions.clutter:
        return weather
    rng = np.random.default_rng([seed, 32])
    sun = {"sun_elevation_deg": rng.uniform(15.0, 60.0), "sun_azimuth_deg": rng.uniform(0.0, 360.0)}
    return weather.model_copy(update=sun)


def _cameras(conditions: Conditions, drone: bool, perturbed: PerturbedRig | None) -> CamerasSettings:
    """The cameras of vehicle and, if there is one, drone."""
    if conditions.cameras_hz is None:
        return CamerasSettings()
    one = CameraSettings(rate_hz=conditions.cameras_hz, size_px=conditions.cameras_px, readout_ms=conditions.readout_ms)
    if conditions.clutter:
        one = one.model_copy(update=CLUTTERED_LENS | ({} if conditions.readout_ms else {"readout_ms": READOUT_MS}))
    vehicle = drones = one
    if perturbed is not None:
        vehicle = one.model_copy(update={"miscalibration": perturbed.camera_vehicle})
        drones = one.model_copy(update={"miscalibration": perturbed.camera_drone})
    return CamerasSettings(vehicle=vehicle, drone=drones if drone else None)
