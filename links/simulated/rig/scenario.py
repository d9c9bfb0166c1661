"""Scenarios: one YAML file describes the scene, all motions, the sensors and the script of the servo.

Source: ours.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path as FilePath
from typing import Any, Literal, Self

import numpy as np
import yaml
from pydantic import Field, field_validator, model_validator

from flow.config.setting_errors import check_values
from flow.config.tree import load_tree, resolve
from flow.config_error import ConfigError
from flow.stage import StrictModel
from links.simulated.autopilot.autopilot import AutopilotSettings
from links.simulated.cues.cue_errors import CueSettings
from links.simulated.pose_sensors.fix_sensor import FixSensorSettings
from links.simulated.pose_sensors.rotation_sensor import RotationSensorSettings
from links.simulated.rig.closed_loop import ClosedLoopSettings
from links.simulated.rig.scripted_servo import Segment, VibrateSegment
from links.simulated.sensors.camera import CamerasSettings, rig_cameras
from links.simulated.sensors.lidar import LidarSettings
from links.simulated.sensors.servo import ServoSettings
from links.simulated.sensors.vehicle_odometry import VehicleOdometrySettings
from links.simulated.world.drone import DroneModel, drone_mesh
from links.simulated.world.path import Path, TimeSpan
from links.simulated.world.procedural import SceneSettings
from links.simulated.world.suspension import SuspensionSettings
from links.simulated.world.vehicle import vehicle_mesh_from_camera
from links.simulated.world.weather import Weather
from stages.geometry import rig_lidar
from stages.geometry.frames import Array64, LidarMount, Pose
from stages.geometry.lidar_models import LIDAR_MODELS, lidar_profile

CLEARANCE_M = 0.3  # minimum height of a drone above the road
WHEELS_M = 0.15  # maximum height of the vehicle's motion above or below the road
BLADE_STEPS = 4  # blade angles within half a turn, for the camera mask
OUSTER_STAGGER_DEG = 4.2, 1.4, -1.4, -4.2  # azimuth offsets of an OS1's lasers: firmware manual, beam angles
OPTIONAL_KEYS = ("other_drones", "truth_visible", "lidar_gaps_s")  # written to a scenario file only where used


class VehicleSettings(StrictModel):
    """The vehicle: its camera is the origin of the vehicle frame."""

    camera_height_m: float = Field(default=1.8, ge=1.0, le=5.0)
    path: Path = Path(waypoints=({"t_s": 0.0, "xyz_m": (0.0, 0.0, 0.0)},))  # pyright: ignore[reportArgumentType]
    suspension: SuspensionSettings | None = None  # pitch and roll; without it the vehicle stays level


class DroneSettings(StrictModel):
    """A drone and its path, world frame."""

    span_m: float = Field(default=0.5, ge=0.1, le=3.0)
    model: DroneModel = DroneModel()
    path: Path


class OtherDroneSettings(DroneSettings):
    """A further drone. With an autopilot it obeys flight dynamics and sends telemetry, as the first one does."""

    autopilot: AutopilotSettings | None = None

    @field_validator("autopilot")
    @classmethod
    def _is_not_in_the_loop(cls, value: AutopilotSettings | None) -> AutopilotSettings | None:
        if value is not None and value.flight_stack is not None:
            raise ValueError("flight_stack: only the first drone flies on what grd sends")
        return value


class RigLidar(rig_lidar.RigLidar):
    """The LiDAR on its turntable, as in the rig file. An Ouster without beams gets evenly spaced ones."""

    mount: LidarMount = LidarMount(
        T_vehicle_turntable=Pose(xyz_m=(0.0, 0.0, 0.25)),
        T_turntable_lidar=Pose(xyz_m=(0.0, 0.0, 0.10), rpy_deg=(90.0, 0.0, 0.0)),
    )

    @model_validator(mode="before")
    @classmethod
    def _with_beams(cls, values: Any) -> Any:
        model = values.get("model") if isinstance(values, dict) else None
        if not isinstance(model, str) or model not in LIDAR_MODELS or not model.startswith("OS") or "beams" in values:
            return values
        profile = lidar_profile(model)
        beams = rig_lidar.LidarBeams(
            elevation_deg=profile.elevation_deg,
            azimuth_deg=tuple(OUSTER_STAGGER_DEG[k % 4] for k in range(profile.lasers)),
            origin_mm=profile.origin_mm,
            packets="RNG19_RFL8_SIG16_NIR16",
        )
        return {**values, "beams": beams}


class Scenario(StrictModel):
    """A complete scenario. `with_drone` and `changed` make variants."""

    version: Literal[1] = 1
    name: str
    description: str = ""
    seed: int = Field(default=1, ge=0)
    start_utc: datetime.datetime
    duration_s: float = Field(gt=0, le=7200)
    scene: SceneSettings = SceneSettings()
    weather: Weather = Weather()
    vehicle: VehicleSettings = VehicleSettings()
    drone: DroneSettings | None = None
    other_drones: tuple[OtherDroneSettings, ...] = Field(default=(), max_length=9)
    lidar: LidarSettings = LidarSettings()
    servo: ServoSettings = ServoSettings()
    cameras: CamerasSettings = CamerasSettings()
    autopilot: AutopilotSettings | None = None  # with it the drone obeys flight dynamics; without, it follows its path
    vehicle_odometry: VehicleOdometrySettings | None = None
    cues: CueSettings | None = None  # GNSS, ranging, barometer
    script: tuple[Segment, ...] = ()
    closed_loop: ClosedLoopSettings = ClosedLoopSettings()  # replaces the script with --closed-loop
    lidar_gaps_s: tuple[TimeSpan, ...] = ()  # no packet of the LiDAR arrives
    fix_sensor: FixSensorSettings | None = None  # instead of LiDAR and servo: fast, for graphs with SimulatedFixes
    rotation_sensor: RotationSensorSettings | None = None  # instead of cameras, for graphs with SimulatedRotations
    truth_visible: bool = False  # write /truth/visible: the LiDAR's line of sight to each drone
    rig: RigLidar = RigLidar()  # the rig file attached to the recording
    true_mount: LidarMount | None = None  # the true mount of the LiDAR, if it differs from the rig file

    @field_validator("start_utc")
    @classmethod
    def _has_zone(cls, value: datetime.datetime) -> datetime.datetime:
        if value.tzinfo is None:
            raise ValueError("give the time zone, as in 2025-06-01T10:20:30Z")
        return value

    @model_validator(mode="after")
    def _can_be_driven(self) -> Self:
        times = np.arange(0.0, self.duration_s, 0.05)
        lift = self.vehicle.path.at(times)[0][:, 2]
        worst = np.abs(lift).argmax()
        if abs(lift[worst]) > WHEELS_M:
            raise ValueError(
                f"vehicle.path: {lift[worst]:+.2f} m off the road at {times[worst]:.2f} s; "
                "z is relative to the camera's height at the start and the road is flat: keep it 0"
            )
        return self

    @model_validator(mode="after")
    def _packets_hold_the_returns(self) -> Self:
        if self.rig.model.startswith("OS") and self.rig.beams is not None:
            mode = self.rig.beams.return_mode
            if self.lidar.return_mode != mode:
                raise ValueError(f"lidar.return_mode: {self.rig.beams.packets} packets hold {mode} returns: set {mode}")
        return self

    @model_validator(mode="after")
    def _can_be_flown(self) -> Self:
        if self.drone is None and self.autopilot is not None:
            raise ValueError("autopilot: the scenario has no drone for it; add one, or leave out the autopilot")
        if self.drone is None and any(isinstance(s, VibrateSegment) and s.follow_drone for s in self.script):
            raise ValueError("script: follow_drone is set but the scenario has no drone; give an azimuth_table")
        if self.drone is None and (self.other_drones or self.truth_visible):
            key = "other_drones" if self.other_drones else "truth_visible"
            raise ValueError(f"{key}: the scenario has no drone; add 'drone', the first one, or leave out {key}")
        times = np.arange(0.0, self.duration_s, 0.05)
        checked: list[tuple[str, DroneSettings, Array64]] = []
        for name, drone in self._drones():
            at_m = drone.path.at(times)[0]
            height = at_m[:, 2] + self.vehicle.camera_height_m
            if height.min() < CLEARANCE_M:
                raise ValueError(
                    f"{name}.path: {height.min():.2f} m above the road at {times[height.argmin()]:.2f} s, "
                    f"less than {CLEARANCE_M} m; z is relative to the camera, {self.vehicle.camera_height_m} m up"
                )
            for other_name, other, other_m in checked:
                separation = np.linalg.norm(at_m - other_m, axis=1)
                if separation.min() < (drone.span_m + other.span_m) / 2:
                    raise ValueError(f"{name}.path: collides with {other_name} at {times[separation.argmin()]:.2f} s")
            checked.append((name, drone, at_m))
        return self

    @model_validator(mode="after")
    def _cues_are_possible(self) -> Self:
        cues = self.cues
        if cues is None:
            return self
        if (cues.drone or cues.barometer) and self.autopilot is None:
            raise ValueError("cues: the drone's receiver and barometer report through its autopilot; add one")
        if self.autopilot is not None and self.autopilot.flight_stack is not None:
            raise ValueError("cues: not with flight_stack; its flight is not known in advance")
        if cues.barometer is not None and cues.drone is None:
            raise ValueError("cues.barometer: it reports at the rate of cues.drone; add that, as {rate_hz: 5}")
        for source in (cues.drone, cues.ranging):
            if source is not None and source.of_drone > len(self._drones()):
                raise ValueError(f"cues: of_drone is {source.of_drone}, the scenario has {len(self._drones())} drones")
        return self

    def _drones(self) -> list[tuple[str, DroneSettings]]:
        """All drones with their keys."""
        others = [(f"other_drones.{index}", drone) for index, drone in enumerate(self.other_drones)]
        return ([] if self.drone is None else [("drone", self.drone)]) + others

    @property
    def start_ns(self) -> int:
        """UTC of the start [ns]."""
        since = self.start_utc - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
        return (since // datetime.timedelta(microseconds=1)) * 1000

    @property
    def mount(self) -> LidarMount:
        """The true mount of the LiDAR."""
        return self.true_mount or self.rig.mount

    def with_drone(self, path: Path, span_m: float = 0.5) -> Scenario:
        """The same scenario with another flight, validated again."""
        return self.changed(drone={"span_m": span_m, "path": path})

    def changed(self, **settings: Any) -> Scenario:
        """The same scenario with some settings replaced, validated again."""
        return Scenario.model_validate(dict(self) | settings)

    def as_yaml(self) -> str:
        """The scenario as a file, with every setting (`OPTIONAL_KEYS` where used)."""
        unused = {name for name in OPTIONAL_KEYS if not getattr(self, name)}
        whole = self.model_copy(update={"lidar": self.lidar.of_model(self.rig.profile)})
        settings = whole.model_dump(mode="json", exclude_none=True, exclude=unused)
        return yaml.safe_dump(settings, sort_keys=False, width=120)

    def rig_yaml(self) -> str:
        """The rig file attached to the recording."""
        lidar = self.rig.model_dump(mode="json", exclude_unset=False, exclude_none=True)
        span_m = 0.5 if self.drone is None else self.drone.span_m
        rig: dict[str, Any] = {"version": 1, "lidar": lidar, "drone": {"span_m": span_m}}
        turns = np.linspace(0.0, np.pi, BLADE_STEPS, endpoint=False)
        drone = [drone_mesh(span_m, float(turn), self.drone.model) for turn in turns] if self.drone else []
        vehicle = vehicle_mesh_from_camera(self.vehicle.camera_height_m, self.mount)
        cameras = rig_cameras(self.cameras, vehicle, drone)
        return yaml.safe_dump(rig | ({"cameras": cameras} if cameras else {}), sort_keys=False)


def load_scenario(path: FilePath, sets: Sequence[str] = ()) -> Scenario:
    """Load a scenario file with its includes and changed settings (`autopilot.imu_hz=25`).

    ConfigError lists all problems with file and line.
    """
    tree = load_tree(path, sets=sets)
    values = resolve(tree, (), tree.values)
    if not tree.errors:
        check_values(tree, (), Scenario, values, "scenario")
    if tree.errors:
        raise ConfigError(tree.errors)
    return Scenario.model_validate(values)
