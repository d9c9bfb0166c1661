"""The two fisheyes: the vehicle's looks up, the drone's looks down. Settings, times and records of each.

Source: ours. A frame's stamp is the middle of its middle row's exposure.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from flow.link import Record
from links.recording import CompressedImage, encode_compressed_image
from links.simulated.camera_mask import own_body
from links.simulated.camera_paint import Street
from links.simulated.camera_rays import CameraScene
from links.simulated.camera_sensor import SensorSettings, auto_exposure, develop, encode_jpeg, transmission
from links.simulated.camera_sky import light
from links.simulated.camera_view import PixelRays, Shutter, View, mean_radiance, render
from links.simulated.mesh import Array64, Mesh, RayScene
from links.simulated.scene import Scene
from links.simulated.weather import Weather
from stages.geometry import Pose
from stages.lens import Equidistant, KannalaBrandt, Lens, OCam

LOOKS_UP = Pose(rpy_deg=(0.0, 0.0, 90.0))  # the image's top is forward, its right is left
LOOKS_DOWN_RPY_DEG = (180.0, 0.0, -90.0)  # the image's top is forward, its right is right
BELOW_BODY_M = 0.02
Carrier = Literal["vehicle", "drone"]


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class CameraSettings(_Settings):
    """One fisheye camera."""

    size_px: int = Field(default=720, ge=64, le=1440)  # square
    lens: Lens | None = None  # null: an equidistant one that fills the image with 235 deg
    mount: Pose | None = None  # T_vehicle_camera or T_drone_camera; null: at the vehicle's origin, under the drone
    rate_hz: float = Field(default=10.0, ge=1, le=15)
    readout_ms: float = Field(default=0.0, ge=0, le=60)  # first to last row; 0: a global shutter
    latency_ms: tuple[float, float] = (30.0, 80.0)  # from the end of readout to arrival
    sensor: SensorSettings = SensorSettings()

    @model_validator(mode="after")
    def _fits_its_period(self) -> Self:
        longest_ms = self.readout_ms + (self.sensor.exposure_ms or self.sensor.max_exposure_ms)
        if longest_ms > 1000 / self.rate_hz:
            raise ValueError(f"exposure and readout take {longest_ms:g} ms, a period is {1000 / self.rate_hz:g} ms")
        if not 0 <= self.latency_ms[0] <= self.latency_ms[1]:
            raise ValueError("latency_ms: give the shortest and the longest, both 0 or more")
        return self

    @property
    def true_lens(self) -> Equidistant | KannalaBrandt | OCam:
        """The lens in use."""
        if self.lens is not None:
            return self.lens
        middle = (self.size_px - 1) / 2
        return Equidistant(focal_px=(self.size_px / 2 - 2) / math.radians(117.5), centre_px=(middle, middle))


class CamerasSettings(_Settings):
    """The cameras of a scenario; none by default."""

    vehicle: CameraSettings | None = None
    drone: CameraSettings | None = None


class Camera:
    """A camera in the scene. `records` gives its frames as they are measured."""

    def __init__(
        self, carrier: Carrier, settings: CameraSettings, mount: Pose, scene: CameraScene, start_ns: int, seed: int
    ) -> None:
        """`mount` is T_carrier_camera; the carrier is one of the scene's bodies."""
        self.settings = settings
        self._topic, self._frame_id = f"/camera/{carrier}", f"camera_{carrier}"
        own = next(i for i, body in enumerate(scene.bodies) if body.name == carrier)
        self._carrier = scene.bodies[own]
        self._T_carrier_camera = T = mount.matrix()
        self._pixels = PixelRays(settings.true_lens, settings.size_px)
        covered = scene.always_hit(own, T[:3, 3], self._pixels.direction @ T[:3, :3].T)
        self._view = View(scene, self._pixels, self.T_world_camera, own, covered)
        limit_rad = math.radians(settings.true_lens.max_off_axis_deg)
        self._transmission = transmission(self._pixels.off_axis_rad, limit_rad, settings.sensor.vignetting)
        self._seed = [seed, 21 if carrier == "vehicle" else 22]
        timing = np.random.default_rng([*self._seed, 0])
        self._first_ns = start_ns + round(timing.uniform(0.2, 1.0) * 1e9 / settings.rate_hz)
        self._frame = 0

    def records(self, until_ns: int) -> list[Record]:
        """Frames whose readout ended before `until_ns`, each once."""
        records: list[Record] = []
        while (ends_ns := self._ends_ns(self._frame)) < until_ns:
            records.append(self._record(self._frame, ends_ns))
            self._frame += 1
        return records

    def T_world_camera(self, stamp_ns: NDArray[np.int64]) -> tuple[Array64, Array64]:
        """Rotations (n, 3, 3) and positions (n, 3) [m]."""
        R, t = self._carrier.pose(stamp_ns)
        T = self._T_carrier_camera
        return R @ T[:3, :3], t + R @ T[:3, 3]

    def image(self, stamp_ns: int, frame: int = 0) -> NDArray[np.uint8]:
        """The picture (size, size, 3), RGB, of a frame whose middle is `stamp_ns`."""
        rng = np.random.default_rng([*self._seed, 1, frame])
        exposure_s, gain = auto_exposure(self.settings.sensor, mean_radiance(self._view, stamp_ns))
        row_s = 1e-3 * self.settings.readout_ms / self.settings.size_px
        shutter = Shutter(stamp_ns, exposure_s, row_s)
        radiance = render(self._view, shutter, rng)
        radiance[self._pixels.rows, self._pixels.columns] *= self._transmission[:, None]
        return develop(radiance, self.settings.sensor, exposure_s, gain, rng)

    def _stamp_ns(self, frame: int) -> int:
        """Frames are triggered at a steady rate, off by some 50 us."""
        jitter_ns = np.random.default_rng([*self._seed, 2, frame]).normal(0, 5e4)
        return self._first_ns + round(frame * 1e9 / self.settings.rate_hz + jitter_ns)

    def _ends_ns(self, frame: int) -> int:
        """No exposure is longer than the longest: how long it is shows only when the frame is made."""
        sensor = self.settings.sensor
        longest_ms = self.settings.readout_ms + (sensor.exposure_ms or sensor.max_exposure_ms)
        return self._stamp_ns(frame) + round(0.5e6 * longest_ms)

    def _record(self, frame: int, ends_ns: int) -> Record:
        stamp_ns = self._stamp_ns(frame)
        low, high = self.settings.latency_ms
        latency_ns = round(
            1e6 * np.random.default_rng([*self._seed, 3, frame]).triangular(low, (2 * low + high) / 3, high + 1e-9)
        )
        jpeg = encode_jpeg(self.image(stamp_ns, frame), self.settings.sensor.jpeg_quality)
        data = encode_compressed_image(CompressedImage(stamp_ns, self._frame_id, jpeg))
        return Record(self._topic, arrival_ns=ends_ns + latency_ns, stamp_ns=stamp_ns, data=data)


def build_cameras(
    settings: CamerasSettings,
    scene: Scene,
    street: Street,
    weather: Weather,
    vehicle_from_camera: Mesh,
    start_ns: int,
    seed: int,
) -> list[Camera]:
    """The scenario's cameras. The vehicle's camera sits inside the vehicle's mesh: it sees another one instead."""
    cameras: list[Camera] = []
    for carrier, one in _wanted(settings):
        bodies = list(scene.bodies)
        if carrier == "vehicle":
            own = next(i for i, body in enumerate(bodies) if body.name == carrier)
            bodies[own] = dataclasses.replace(bodies[own], meshes=(vehicle_from_camera,))
        elif not any(body.name == carrier for body in bodies):
            continue  # an empty sky has no drone to carry a camera
        around = CameraScene(scene.world, scene.world_mesh, bodies, street, light(weather, seed))
        drone = next((body.meshes[0] for body in bodies if body.name == "drone"), None)
        cameras.append(Camera(carrier, one, mount_of(carrier, one, drone), around, start_ns, seed))
    return cameras


def mount_of(carrier: Carrier, settings: CameraSettings, drone: Mesh | None) -> Pose:
    """T_vehicle_camera or T_drone_camera. By default a drone's camera hangs right under the front of its body."""
    if settings.mount is not None:
        return settings.mount
    if carrier == "vehicle" or drone is None:
        return LOOKS_UP
    x = 0.2 * float(drone.vertices_m[:, 0].max())
    up = np.array([[0.0, 0.0, 1.0]], dtype=np.float32)
    below = RayScene(drone).cast(np.array([[x, 0.0, -2.0]], dtype=np.float32), up, 4.0)[0][0]
    z = float(below) - 2.0 if np.isfinite(below) else 0.0
    return Pose(xyz_m=(round(x, 4), 0.0, round(z - BELOW_BODY_M, 4)), rpy_deg=LOOKS_DOWN_RPY_DEG)


def rig_cameras(settings: CamerasSettings, vehicle_from_camera: Mesh, drone: Sequence[Mesh]) -> dict[str, Any]:
    """The rig file's `cameras:`; empty without cameras. `drone`: how its blades may stand; nothing without a drone."""
    tree: dict[str, Any] = {}
    for carrier, one in _wanted(settings):
        if carrier == "drone" and not drone:
            continue
        mount = mount_of(carrier, one, drone[0] if drone else None)
        meshes = [vehicle_from_camera] if carrier == "vehicle" else drone
        masked_px, max_off_axis_deg = own_body(one.true_lens, one.size_px, mount, meshes)
        tree[carrier] = {
            f"T_{carrier}_camera": mount.model_dump(mode="json", exclude_none=True),
            "lens": one.true_lens.model_dump(mode="json"),
            "size_px": one.size_px,
            "masked_px": masked_px,
            "max_off_axis_deg": max_off_axis_deg,
        }
    return tree


def _wanted(settings: CamerasSettings) -> Iterator[tuple[Carrier, CameraSettings]]:
    if settings.vehicle is not None:
        yield "vehicle", settings.vehicle
    if settings.drone is not None:
        yield "drone", settings.drone
