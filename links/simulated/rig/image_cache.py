"""Images of an earlier recording of the same flight, so that they are not rendered again.

Rendering is most of the time of a closed loop, while another LiDAR stage or setting leaves the images as they are.
The images are the same if seed, start, scene, weather, vehicle and drones with their motion, cameras, and the turntable
(the vehicle's camera sees the LiDAR) are. All other settings may differ. The flight may be shorter than the recorded
one. It may be longer only if all drones fly closed paths of one period (`path.period_s`) in a static scene: the images
of the first lap then repeat, delayed.

The config attached to the recording states these settings. Changes of code show in the recorded ground truth, with
which the motion of vehicle and drones must agree, and in the stamps of the images.

Source: ours.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from flow.config.yaml_text import YamlTextError, yaml_values
from flow.link import LinkError, Record
from links.recording import CompressedImage, RecordingReader, decode_compressed_image, encode_compressed_image
from links.simulated.rig.scenario import Scenario
from links.simulated.sensors.camera import CameraSettings, FrameTimes, enabled_cameras
from links.simulated.world.mesh import Mesh
from links.simulated.world.procedural import World, build_world
from links.simulated.world.scene import Truth
from stages.geometry.frames import Array64, quaternions_xyzw

NEAR_M = 1e-3  # tolerance between computers
NEAR_QUATERNION = 1e-4
PATH_STEP_S = 0.25
OTHER_FLIGHT = "use a recording of the same flight, or leave out --images to render them"


class ImageCache:
    """A recording that has the images of a scenario's cameras. LinkError states why it has not."""

    def __init__(self, file: Path, scenario: Scenario) -> None:
        """Compares the settings of the recording; `cameras` compares its motion."""
        self._file, self._scenario = file, scenario
        with RecordingReader(file) as reader:
            recorded = recorded_scenario(reader)
            platforms = [platform for platform, _ in enabled_cameras(scenario.cameras, scenario.drone is not None)]
            if not platforms:
                raise LinkError(f"{scenario.name} has no cameras: leave out --images")
            for topic in (f"/camera/{platform}" for platform in platforms):
                if topic not in reader.topics:
                    raise LinkError(f"{file} has nothing on {topic}: {OTHER_FLIGHT}")
        difference = first_difference(image_settings(recorded), image_settings(scenario))
        longer = scenario.duration_s > recorded.duration_s
        self._period_s = image_period_s(scenario) if longer else None  # a recorded flight needs no repetition
        if difference is None and longer and self._period_s is None:
            difference = "duration_s", f"{recorded.duration_s:g}", f"{scenario.duration_s:g}"
        if (
            difference is None
            and scenario.duration_s < recorded.duration_s
            and not _same_world(scenario_world(recorded), scenario_world(scenario))
        ):
            difference = (
                "duration_s",
                f"{recorded.duration_s:g}",
                f"{scenario.duration_s:g}, which adds objects to the scene",
            )
        if difference is not None:
            where, there, here = difference
            raise LinkError(f"{file} shows another flight: {where} is {there} in it, {here} now; {OTHER_FLIGHT}")

    def cameras(self, truth: Truth) -> list[CachedCamera]:
        """The cameras of the scenario, with the images of the recording."""
        self._compare_motion(truth)
        start_ns, seed = self._scenario.start_ns, self._scenario.seed
        return [
            CachedCamera(
                self._file,
                f"/camera/{platform}",
                FrameTimes(platform, settings, start_ns, seed),
                self._frames(settings),
            )
            for platform, settings in enabled_cameras(self._scenario.cameras, truth.drone is not None)
        ]

    def _frames(self, settings: CameraSettings) -> int | None:
        """Images per lap; None when they do not repeat."""
        if self._period_s is None:
            return None
        frames = self._period_s * settings.rate_hz
        if abs(frames - round(frames)) > 1e-6:
            raise LinkError(
                f"{settings.rate_hz:g} Hz are {frames:.2f} images in a lap of {self._period_s:g} s: "
                "choose a rate with a whole number of them"
            )
        return round(frames)

    def _compare_motion(self, truth: Truth) -> None:
        """LinkError if the recorded motion of vehicle or drones differs from the present one."""
        end_ns = self._scenario.start_ns + round(self._scenario.duration_s * 1e9)
        topics: dict[str, Callable[[NDArray[np.int64]], tuple[Array64, Array64]]]
        topics = {"/truth/vehicle": truth.T_world_vehicle}
        for number in truth.drones:
            name = "/truth/drone" if number == 1 else f"/truth/drone_{number}"
            topics[name] = partial(truth.T_world_drone, number=number)
        recorded_poses: dict[str, list[tuple[int, list[float]]]] = {topic: [] for topic in topics}
        with RecordingReader(self._file) as reader:
            for record in reader.records(topics):
                if record.stamp_ns < end_ns:
                    pose = json.loads(record.data)
                    recorded_poses[record.topic].append((record.stamp_ns, [*pose["xyz_m"], *pose["quaternion_xyzw"]]))
        for topic, poses in recorded_poses.items():
            if not poses:
                raise LinkError(f"{self._file} has nothing on {topic}, so its images cannot be checked: {OTHER_FLIGHT}")
            stamps = np.array([stamp for stamp, _ in poses], dtype=np.int64)
            there = np.array([pose for _, pose in poses])
            R, t = topics[topic](stamps)
            rotation_error = 1.0 - np.abs(np.einsum("ni,ni->n", quaternions_xyzw(R), there[:, 3:]))
            off = (np.linalg.norm(t - there[:, :3], axis=1) > NEAR_M) | (rotation_error > NEAR_QUATERNION**2)
            if off.any():
                at_s = (stamps[off.argmax()] - self._scenario.start_ns) * 1e-9
                who = topic.removeprefix("/truth/")
                raise LinkError(
                    f"{self._file} shows another flight: {who} has another pose at {at_s:.2f} s although all settings "
                    f"are the same (the code has changed since); {OTHER_FLIGHT}"
                )


class CachedCamera:
    """A camera with recorded images; `records` is that of `links.simulated.sensors.camera.Camera`."""

    def __init__(self, file: Path, topic: str, times: FrameTimes, frames: int | None = None) -> None:
        """`frames`: number of images in a lap, after which they repeat; None: they do not."""
        self._file, self._topic, self._times, self._frames = file, topic, times, frames
        self._frame = 0  # of this lap
        self._delay_ns = 0  # since the first lap
        self._records = self._read()
        self._early: dict[int, Record] = {}  # by stamp: a later image may arrive first

    def records(self, until_ns: int) -> list[Record]:
        """Frames whose readout ended before `until_ns`, each once."""
        records: list[Record] = []
        while self._times.end_ns(self._frame) + self._delay_ns < until_ns:
            records.append(self._image_record(self._times.stamp_ns(self._frame)))
            self._frame += 1
            if self._frame == self._frames:
                self._restart_lap()
        return records

    def _restart_lap(self) -> None:
        self._delay_ns += self._times.duration_ns(self._frame)
        self._frame = 0
        self._records, self._early = self._read(), {}

    def _read(self) -> Iterator[Record]:
        with RecordingReader(self._file) as reader:
            yield from reader.records([self._topic])

    def _image_record(self, stamp_ns: int) -> Record:
        while stamp_ns not in self._early:
            record = next(self._records, None)
            if record is None:
                raise LinkError(f"{self._file} has no image on {self._topic} with stamp {stamp_ns}: {OTHER_FLIGHT}")
            self._early[record.stamp_ns] = record
        return _delayed(self._early.pop(stamp_ns), self._delay_ns)


def _delayed(record: Record, delay_ns: int) -> Record:
    if delay_ns == 0:
        return record
    image = decode_compressed_image(record.data)
    stamp_ns = record.stamp_ns + delay_ns
    data = encode_compressed_image(CompressedImage(stamp_ns, image.frame_id, image.data))
    return Record(record.topic, record.arrival_ns + delay_ns, stamp_ns, data)


def image_settings(scenario: Scenario) -> dict[str, Any]:
    """All settings that affect the images and their times; the mount is the true one."""
    return flight_settings(scenario) | scenario.model_dump(mode="json", include={"cameras"})


def flight_settings(scenario: Scenario) -> dict[str, Any]:
    """All settings that affect the world, the motion in it, and the turntable."""
    settings = scenario.model_dump(mode="json")
    same = ("seed", "start_utc", "scene", "weather", "vehicle", "drone", "other_drones")
    mount = scenario.mount.model_dump(mode="json")
    flight = None if scenario.autopilot is None else settings["autopilot"]["flight"]
    turntable = {name: mount[name] for name in ("T_vehicle_turntable", "T_turntable_lidar")}
    return {name: settings[name] for name in same} | {"autopilot": {"flight": flight}, "mount": turntable}


def image_period_s(scenario: Scenario) -> float | None:
    """Period [s] after which all images repeat; None when they never do."""
    flight = () if scenario.drone is None else (scenario.drone, *scenario.other_drones)
    periods = {drone.path.period_s for drone in flight}
    parked = len(scenario.vehicle.path.waypoints) == 1 and scenario.vehicle.suspension is None
    return periods.pop() if len(periods) == 1 and parked and not any(scenario.scene.movers()) else None


def first_difference(there: Any, here: Any, where: str = "") -> tuple[str, str, str] | None:
    """The first setting that differs, as a path (`weather.rain_mmph`), with both values; None when all are equal."""
    if isinstance(there, Mapping) and isinstance(here, Mapping):
        pairs = [
            (str(key), there.get(key), here.get(key)) for key in (*there, *(key for key in here if key not in there))
        ]
    elif isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        pairs = [(str(index), a, b) for index, (a, b) in enumerate(zip(there, here, strict=True))]
    else:
        return None if there == here else (where, _summary(there), _summary(here))
    found = (first_difference(a, b, f"{where}.{name}" if where else name) for name, a, b in pairs)
    return next((difference for difference in found if difference is not None), None)


def scenario_world(scenario: Scenario) -> World:
    """Static scene and movers of a scenario; the driven path is kept free of objects."""
    driven = scenario.vehicle.path.at(np.arange(0.0, scenario.duration_s, PATH_STEP_S))[0]
    return build_world(scenario.scene, scenario.vehicle.camera_height_m, scenario.seed, driven[:, :2])


def _same_world(one: World, other: World) -> bool:
    """Whether the static meshes and the number of movers agree; seed and settings determine the movers."""
    return _same_mesh(one.mesh, other.mesh) and len(one.movers) == len(other.movers)


def _same_mesh(one: Mesh, other: Mesh) -> bool:
    return (
        np.array_equal(one.vertices_m, other.vertices_m)
        and np.array_equal(one.faces, other.faces)
        and np.array_equal(one.surface, other.surface)
    )


def _summary(value: Any) -> str:
    if value is None:
        return "not given"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return "given" if isinstance(value, Mapping) else str(value)


def recorded_scenario(reader: RecordingReader) -> Scenario:
    """The scenario of a recording. LinkError when it has none."""
    if reader.metadata.get("made_by") != "grd simulate" or reader.config_yaml is None:
        raise LinkError(f"{reader.path} is no simulated recording: choose one made by `grd simulate`")
    if not reader.finished:
        raise LinkError(f"{reader.path} is incomplete: {OTHER_FLIGHT}")
    try:
        return Scenario.model_validate(yaml_values(reader.config_yaml))
    except (YamlTextError, ValidationError):
        raise LinkError(f"{reader.path}: its scenario does not fit this version of grd: {OTHER_FLIGHT}") from None
