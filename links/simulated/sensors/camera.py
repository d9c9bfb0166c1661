"""The two fisheyes: one on the vehicle faces up, one on the drone faces down. Settings, frame times and records.

Source: ours. The stamp of a frame is the middle of the exposure of its middle row.
"""

from __future__ import annotations

import dataclasses
import math
import operator
from collections.abc import Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flow.link import Record
from flow.stage import StrictModel
from links.recording import CompressedImage, encode_compressed_image
from links.simulated.kernels.ray_casting import Array32
from links.simulated.sensors.camera_mask import own_body
from links.simulated.sensors.camera_paint import Street
from links.simulated.sensors.camera_rays import CameraScene
from links.simulated.sensors.camera_sensor import (
    SensorSettings,
    auto_exposure,
    develop,
    dirt,
    encode_jpeg,
    flare,
    transmission,
)
from links.simulated.sensors.camera_view import RenderRays, Shutter, View, mean_radiance, render
from links.simulated.world.mesh import Mesh, RayScene
from links.simulated.world.scene import Scene
from links.simulated.world.sky import light
from links.simulated.world.weather import Weather
from stages.geometry.frames import Array64, Pose, Vector3, quaternions_xyzw, rotation_from_rpy_deg
from stages.geometry.lens import Equidistant, KannalaBrandt, Lens, OCam

UPWARD_MOUNT = Pose(rpy_deg=(0.0, 0.0, 90.0))  # the top of the image is forward, its right is left
DOWNWARD_RPY_DEG = (180.0, 0.0, -90.0)  # the top of the image is forward, its right is right
BELOW_BODY_M = 0.02
CameraMount = Literal["vehicle", "drone"]
AnyLens = Equidistant | KannalaBrandt | OCam


class CameraMiscalibration(StrictModel):
    """How far the rig file is from the true camera."""

    rotation_deg: Vector3 = (0.0, 0.0, 0.0)  # error of the mount: roll, pitch, yaw about the axes of the platform
    focal_share: float = Field(default=0.0, ge=-0.1, le=0.1)  # error of the focal length, as a fraction of it
    centre_share: tuple[float, float] = (0.0, 0.0)  # error of the centre, right and down, as a fraction of the size

    def lens(self, true: AnyLens, size_px: int) -> AnyLens:
        """The lens as the rig file states it."""
        rig_mount = true.scaled(1.0 + self.focal_share)
        right, down = self.centre_share
        centre_px = true.centre_px[0] + right * size_px, true.centre_px[1] + down * size_px
        return rig_mount.model_copy(update={"centre_px": centre_px})

    def mount(self, true: Pose) -> Pose:
        """The mount as the rig file states it."""
        return rotated(true, self.rotation_deg)


def rotated(pose: Pose, rpy_deg: Vector3) -> Pose:
    """A pose rotated in place, about the axes of its parent frame."""
    R = rotation_from_rpy_deg(rpy_deg) @ pose.matrix()[:3, :3]
    x, y, z, w = quaternions_xyzw(R[None])[0].tolist()
    return Pose(xyz_m=pose.xyz_m, quaternion_xyzw=(x, y, z, w))


class CameraSettings(StrictModel):
    """One fisheye camera. The image is square."""

    size_px: int = Field(default=720, ge=64, le=1440)
    lens: Lens | None = None  # null: an equidistant lens whose 235 deg fill the image
    mount: Pose | None = None  # T_vehicle_camera or T_drone_camera; null: at the vehicle origin, under the drone
    rate_hz: float = Field(default=10.0, ge=1, le=15)
    readout_ms: float = Field(default=0.0, ge=0, le=60)  # first to last row; 0: a global shutter
    dirt_spots: Annotated[int, Field(exclude_if=operator.not_, ge=0, le=100)] = 0  # on the lens
    flare: Annotated[float, Field(exclude_if=operator.not_, ge=0, le=2)] = 0.0  # of glare, streaks, ghosts; 0: none
    latency_ms: tuple[float, float] = (30.0, 80.0)  # shortest and longest, from the end of the readout to arrival
    sensor: SensorSettings = SensorSettings()
    miscalibration: Annotated[CameraMiscalibration | None, Field(exclude_if=operator.not_)] = (
        None  # null: the rig is exact
    )

    @model_validator(mode="after")
    def _fits_its_period(self) -> Self:
        longest_ms = self.readout_ms + (self.sensor.exposure_ms or self.sensor.max_exposure_ms)
        if longest_ms > 1000 / self.rate_hz:
            raise ValueError(f"exposure and readout take {longest_ms:g} ms, the period is {1000 / self.rate_hz:g} ms")
        if not 0 <= self.latency_ms[0] <= self.latency_ms[1]:
            raise ValueError("latency_ms: give the shortest and the longest latency, both 0 or more")
        return self

    @property
    def true_lens(self) -> AnyLens:
        """The lens in use."""
        if self.lens is not None:
            return self.lens
        middle = (self.size_px - 1) / 2
        return Equidistant(focal_px=(self.size_px / 2 - 2) / math.radians(117.5), centre_px=(middle, middle))


class CamerasSettings(StrictModel):
    """The cameras of a scenario; by default none."""

    vehicle: CameraSettings | None = None
    drone: CameraSettings | None = None


class FrameTimes:
    """Times of a camera's frames, which are known before the frames are rendered."""

    def __init__(self, platform: CameraMount, settings: CameraSettings, start_ns: int, seed: int) -> None:
        self._settings = settings
        self.seed = [seed, 21 if platform == "vehicle" else 22]
        timing = np.random.default_rng([*self.seed, 0])
        self._first_ns = start_ns + round(timing.uniform(0.2, 1.0) * 1e9 / settings.rate_hz)

    def stamp_ns(self, frame: int) -> int:
        """Frames are triggered at a constant rate with a jitter of 50 us, one sigma."""
        jitter_ns = np.random.default_rng([*self.seed, 2, frame]).normal(0, 5e4)
        return self._first_ns + round(frame * 1e9 / self._settings.rate_hz + jitter_ns)

    def duration_ns(self, frames: int) -> int:
        """Duration of this many frame periods."""
        return round(frames * 1e9 / self._settings.rate_hz)

    def end_ns(self, frame: int) -> int:
        """End of the readout at the latest: the exposure itself is known only once the frame is rendered."""
        sensor = self._settings.sensor
        longest_ms = self._settings.readout_ms + (sensor.exposure_ms or sensor.max_exposure_ms)
        return self.stamp_ns(frame) + round(0.5e6 * longest_ms)

    def arrival_ns(self, frame: int) -> int:
        """Arrival at the host."""
        low, high = self._settings.latency_ms
        rng = np.random.default_rng([*self.seed, 3, frame])
        return self.end_ns(frame) + round(1e6 * rng.triangular(low, (2 * low + high) / 3, high + 1e-9))


class Camera:
    """A camera in the scene. `records` returns its frames as they are measured."""

    def __init__(
        self, platform: CameraMount, settings: CameraSettings, mount: Pose, scene: CameraScene, start_ns: int, seed: int
    ) -> None:
        """`mount` is T_mount_camera; the platform is one of the bodies of the scene."""
        self.settings = settings
        self._topic, self._frame_id = f"/camera/{platform}", f"camera_{platform}"
        own = next(i for i, body in enumerate(scene.bodies) if body.name == platform)
        self._platform = scene.bodies[own]
        self._T_mount_camera = T = mount.matrix()
        self._pixels = RenderRays(settings.true_lens, settings.size_px)
        covered = scene.always_hit(own, T[:3, 3], self._pixels.direction @ T[:3, :3].T)
        self._view = View(scene, self._pixels, self.T_world_camera, own, covered)
        limit_rad = math.radians(settings.true_lens.max_off_axis_deg)
        self._transmission = transmission(self._pixels.off_axis_rad, limit_rad, settings.sensor.vignetting)
        if settings.dirt_spots:
            rng = np.random.default_rng([seed, 23, own])
            self._transmission *= dirt(
                self._pixels.rows, self._pixels.columns, settings.size_px, settings.dirt_spots, rng
            )
        self._times = FrameTimes(platform, settings, start_ns, seed)
        self._frame = 0

    def records(self, until_ns: int) -> list[Record]:
        """Frames whose readout ended before `until_ns`, each once."""
        records: list[Record] = []
        while self._times.end_ns(self._frame) < until_ns:
            records.append(self._record(self._frame))
            self._frame += 1
        return records

    def T_world_camera(self, stamp_ns: NDArray[np.int64]) -> tuple[Array64, Array64]:
        """Rotations (n, 3, 3) and positions (n, 3) [m]."""
        R, t = self._platform.pose(stamp_ns)
        T = self._T_mount_camera
        return R @ T[:3, :3], t + R @ T[:3, 3]

    def image(self, stamp_ns: int, frame: int = 0) -> NDArray[np.uint8]:
        """The image (size, size, 3), RGB, of a frame with stamp `stamp_ns`."""
        rng = np.random.default_rng([*self._times.seed, 1, frame])
        exposure_s, gain = auto_exposure(self.settings.sensor, mean_radiance(self._view, stamp_ns))
        row_s = 1e-3 * self.settings.readout_ms / self.settings.size_px
        shutter = Shutter(stamp_ns, exposure_s, row_s)
        radiance = render(self._view, shutter, rng)
        if self.settings.flare:
            self._add_flare(radiance, stamp_ns)
        radiance[self._pixels.rows, self._pixels.columns] *= self._transmission[:, None]
        return develop(radiance, self.settings.sensor, exposure_s, gain, rng)

    def _add_flare(self, radiance: Array32, stamp_ns: int) -> None:
        """Add the lens flare, if the sun is in the field of view and nothing hides it."""
        scene, at = self._view.scene, np.array([stamp_ns])
        R, t = self.T_world_camera(at)
        sun_px = self.settings.true_lens.project((scene.light.sun_direction @ R[0])[None])[0]
        if np.isfinite(sun_px).all() and scene.light.sun_rgb.any() and scene.sees_sun(t[0], at):
            centre_px = np.array(self.settings.true_lens.centre_px)
            added = np.zeros_like(radiance)
            flare(added, sun_px, centre_px, self.settings.flare, scene.light.sun_rgb)
            inside = self._pixels.rows, self._pixels.columns
            radiance[inside] += added[inside]

    def _record(self, frame: int) -> Record:
        stamp_ns = self._times.stamp_ns(frame)
        jpeg = encode_jpeg(self.image(stamp_ns, frame), self.settings.sensor.jpeg_quality)
        data = encode_compressed_image(CompressedImage(stamp_ns, self._frame_id, jpeg))
        return Record(self._topic, arrival_ns=self._times.arrival_ns(frame), stamp_ns=stamp_ns, data=data)


def build_cameras(
    settings: CamerasSettings,
    scene: Scene,
    street: Street,
    weather: Weather,
    vehicle_from_camera: Mesh,
    start_ns: int,
    seed: int,
    *,
    reflections: bool = False,
) -> list[Camera]:
    """The cameras of the scenario. The vehicle's camera is inside the vehicle mesh, so it gets another mesh."""
    cameras: list[Camera] = []
    for platform, one in enabled_cameras(settings, any(body.name == "drone" for body in scene.bodies)):
        bodies = list(scene.bodies)
        if platform == "vehicle":
            own = next(i for i, body in enumerate(bodies) if body.name == platform)
            bodies[own] = dataclasses.replace(bodies[own], meshes=(vehicle_from_camera,))
        around = CameraScene(
            scene.world, scene.world_mesh, bodies, street, light(weather, seed), reflections=reflections
        )
        drone = next((body.meshes[0] for body in bodies if body.name == "drone"), None)
        cameras.append(Camera(platform, one, camera_mount(platform, one, drone), around, start_ns, seed))
    return cameras


def camera_mount(platform: CameraMount, settings: CameraSettings, drone: Mesh | None) -> Pose:
    """T_vehicle_camera or T_drone_camera. By default the drone's camera is below the front of its body."""
    if settings.mount is not None:
        return settings.mount
    if platform == "vehicle" or drone is None:
        return UPWARD_MOUNT
    x = 0.2 * float(drone.vertices_m[:, 0].max())
    up = np.array([[0.0, 0.0, 1.0]], dtype=np.float32)
    below = RayScene(drone).cast(np.array([[x, 0.0, -2.0]], dtype=np.float32), up, 4.0)[0][0]
    z = float(below) - 2.0 if np.isfinite(below) else 0.0
    return Pose(xyz_m=(round(x, 4), 0.0, round(z - BELOW_BODY_M, 4)), rpy_deg=DOWNWARD_RPY_DEG)


def rig_cameras(settings: CamerasSettings, vehicle_from_camera: Mesh, drone: Sequence[Mesh]) -> dict[str, Any]:
    """`cameras:` of the rig file; empty without cameras. `drone`: its meshes over the blade angles, if there is one."""
    tree: dict[str, Any] = {}
    for platform, one in enabled_cameras(settings, len(drone) > 0):
        mount = camera_mount(platform, one, drone[0] if drone else None)
        meshes = [vehicle_from_camera] if platform == "vehicle" else drone
        masked_px, max_off_axis_deg = own_body(one.true_lens, one.size_px, mount, meshes)
        rig_mount, lens = mount, one.true_lens
        if one.miscalibration is not None:
            rig_mount, lens = one.miscalibration.mount(mount), one.miscalibration.lens(lens, one.size_px)
        tree[platform] = {
            f"T_{platform}_camera": rig_mount.model_dump(mode="json", exclude_none=True),
            "lens": lens.model_dump(mode="json"),
            "size_px": one.size_px,
            "readout_ms": one.readout_ms,
            "masked_px": masked_px,
            "max_off_axis_deg": max_off_axis_deg,
        }
    return tree


def enabled_cameras(settings: CamerasSettings, drone: bool) -> list[tuple[CameraMount, CameraSettings]]:
    """The enabled cameras by platform. In an empty sky the drone's camera is left out."""
    enabled: list[tuple[CameraMount, CameraSettings]] = []
    if settings.vehicle is not None:
        enabled.append(("vehicle", settings.vehicle))
    if settings.drone is not None and drone:
        enabled.append(("drone", settings.drone))
    return enabled
