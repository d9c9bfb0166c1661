"""The images of an earlier recording of the same flight, instead of painting them again.

A closed loop run again with another LiDAR stage or setting sees the same street, and painting is most of its time (176
of 286 s of a core for 40 s with two 720 px cameras at 5 Hz).
What the images show must be the same: seed, start, scene, weather, vehicle and drones with how they ride and fly,
cameras, and the turntable, of which the vehicle's camera sees the LiDAR. All else may differ. The flight may be shorter
than the recorded one; longer only where a drone goes round and round (`path.period_s`) past a world that stands still:
the images of the first round are those of the next ones, each so much later.

The recording tells all that as its config. Code is not in it: that vehicle and drones were where they are now is asked
of the truth recorded, and every image must have the stamp that it would get now.

Source: ours.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import ValidationError

from flow.link import LinkError, Record
from links.recording import CompressedImage, RecordingReader, decode_compressed_image, encode_compressed_image
from links.simulated.rig.scenario import Scenario
from links.simulated.sensors.camera import CameraSettings, FrameTimes, wanted_cameras
from links.simulated.world.mesh import Mesh
from links.simulated.world.procedural import World, build_world
from links.simulated.world.scene import Truth
from stages.geometry import Array64, quaternions_xyzw

NEAR_M = 1e-3  # the same place, on whichever computer
NEAR_QUATERNION = 1e-4
WAY_STEP_S = 0.25
NOT_THESE = "take a recording of the same flight, or leave --images out and have them painted"


class ImageCache:
    """A recording whose images are what a scenario's cameras would make. LinkError says why they are not."""

    def __init__(self, file: Path, scenario: Scenario) -> None:
        """Compares what the recording says of its flight; `cameras` compares the flight itself."""
        self._file, self._scenario = file, scenario
        with RecordingReader(file) as reader:
            recorded = _scenario_of(reader)
            carriers = [carrier for carrier, _ in wanted_cameras(scenario.cameras, scenario.drone is not None)]
            if not carriers:
                raise LinkError(f"{scenario.name} has no cameras: leave --images out")
            for topic in (f"/camera/{carrier}" for carrier in carriers):
                if topic not in reader.topics:
                    raise LinkError(f"{file} has nothing on {topic}: {NOT_THESE}")
        difference = first_difference(image_settings(recorded), image_settings(scenario))
        longer = scenario.duration_s > recorded.duration_s
        self._round_s = image_period_s(scenario) if longer else None  # what was painted to its end needs no round again
        if difference is None and longer and self._round_s is None:
            difference = "duration_s", f"{recorded.duration_s:g}", f"{scenario.duration_s:g}"
        if (
            difference is None
            and scenario.duration_s < recorded.duration_s
            and not _same(scenario_world(recorded), scenario_world(scenario))
        ):
            difference = (
                "duration_s",
                f"{recorded.duration_s:g}",
                f"{scenario.duration_s:g}, which leaves room for more",
            )
        if difference is not None:
            where, there, here = difference
            raise LinkError(f"{file} shows another flight: {where} is {there} there, {here} here; {NOT_THESE}")

    def cameras(self, truth: Truth) -> list[CachedCamera]:
        """The scenario's cameras, each giving the images of the recording."""
        self._compare_flown(truth)
        start_ns, seed = self._scenario.start_ns, self._scenario.seed
        return [
            CachedCamera(
                self._file, f"/camera/{carrier}", FrameTimes(carrier, settings, start_ns, seed), self._frames(settings)
            )
            for carrier, settings in wanted_cameras(self._scenario.cameras, truth.drone is not None)
        ]

    def _frames(self, settings: CameraSettings) -> int | None:
        """Images in a round; None where none comes again."""
        if self._round_s is None:
            return None
        frames = self._round_s * settings.rate_hz
        if abs(frames - round(frames)) > 1e-6:
            raise LinkError(
                f"{settings.rate_hz:g} Hz are {frames:.2f} images in a round of {self._round_s:g} s: "
                "take a rate that makes a whole number of them"
            )
        return round(frames)

    def _compare_flown(self, truth: Truth) -> None:
        """LinkError where vehicle or drones were elsewhere than they are now."""
        end_ns = self._scenario.start_ns + round(self._scenario.duration_s * 1e9)
        topics: dict[str, Callable[[NDArray[np.int64]], tuple[Array64, Array64]]]
        topics = {"/truth/vehicle": truth.T_world_vehicle}
        for number in truth.drones:
            name = "/truth/drone" if number == 1 else f"/truth/drone_{number}"
            topics[name] = partial(truth.T_world_drone, number=number)
        told: dict[str, list[tuple[int, list[float]]]] = {topic: [] for topic in topics}
        with RecordingReader(self._file) as reader:
            for record in reader.records(topics):
                if record.stamp_ns < end_ns:
                    pose = json.loads(record.data)
                    told[record.topic].append((record.stamp_ns, [*pose["xyz_m"], *pose["quaternion_xyzw"]]))
        for topic, poses in told.items():
            if not poses:
                raise LinkError(f"{self._file} has nothing on {topic}, so its images cannot be judged: {NOT_THESE}")
            stamps = np.array([stamp for stamp, _ in poses], dtype=np.int64)
            there = np.array([pose for _, pose in poses])
            R, t = topics[topic](stamps)
            turned = 1.0 - np.abs(np.einsum("ni,ni->n", quaternions_xyzw(R), there[:, 3:]))
            off = (np.linalg.norm(t - there[:, :3], axis=1) > NEAR_M) | (turned > NEAR_QUATERNION**2)
            if off.any():
                at_s = (stamps[off.argmax()] - self._scenario.start_ns) * 1e-9
                who = topic.removeprefix("/truth/")
                raise LinkError(
                    f"{self._file} shows another flight: {who} was elsewhere at {at_s:.2f} s though every setting is "
                    f"the same (code that moves it has changed since); {NOT_THESE}"
                )


class CachedCamera:
    """A camera whose images are there already; `records` as `links.simulated.sensors.camera.Camera` gives them."""

    def __init__(self, file: Path, topic: str, times: FrameTimes, frames: int | None = None) -> None:
        """`frames`: so many make a round, after which they come again; None: they do not."""
        self._file, self._topic, self._times, self._frames = file, topic, times, frames
        self._frame = 0  # of this round
        self._delay_ns = 0  # than in the first round
        self._coming = self._read()
        self._early: dict[int, Record] = {}  # by stamp: latencies differ, so a later image may arrive first

    def records(self, until_ns: int) -> list[Record]:
        """Frames whose readout ended before `until_ns`, each once."""
        records: list[Record] = []
        while self._times.ends_ns(self._frame) + self._delay_ns < until_ns:
            records.append(self._picture(self._times.stamp_ns(self._frame)))
            self._frame += 1
            if self._frame == self._frames:
                self._begin_again()
        return records

    def _begin_again(self) -> None:
        self._delay_ns += self._times.lasts_ns(self._frame)
        self._frame = 0
        self._coming, self._early = self._read(), {}

    def _read(self) -> Iterator[Record]:
        with RecordingReader(self._file) as reader:
            yield from reader.records([self._topic])

    def _picture(self, stamp_ns: int) -> Record:
        while stamp_ns not in self._early:
            record = next(self._coming, None)
            if record is None:
                raise LinkError(f"{self._file} has no image on {self._topic} stamped {stamp_ns}: {NOT_THESE}")
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
    """All settings that a image can show, and those of when images are taken; the mount is the true one."""
    said = scenario.model_dump(mode="json")
    same = ("seed", "start_utc", "scene", "weather", "vehicle", "drone", "other_drones", "cameras")
    mount = scenario.mount.model_dump(mode="json")
    flown = None if scenario.autopilot is None else said["autopilot"]["flight"]
    turntable = {name: mount[name] for name in ("T_vehicle_turntable", "T_turntable_lidar")}
    return {name: said[name] for name in same} | {"autopilot": {"flight": flown}, "mount": turntable}


def image_period_s(scenario: Scenario) -> float | None:
    """After so long every image is the same again [s]; None: never, or not for all that a camera sees."""
    flown = () if scenario.drone is None else (scenario.drone, *scenario.other_drones)
    rounds = {drone.path.period_s for drone in flown}
    parked = len(scenario.vehicle.path.waypoints) == 1 and scenario.vehicle.ride is None
    return rounds.pop() if len(rounds) == 1 and parked and not any(scenario.scene.movers()) else None


def first_difference(there: Any, here: Any, where: str = "") -> tuple[str, str, str] | None:
    """The first setting that differs, as a path (`weather.rain_mmph`), with both values; None when all are equal."""
    if isinstance(there, Mapping) and isinstance(here, Mapping):
        pairs = [
            (str(key), there.get(key), here.get(key)) for key in (*there, *(key for key in here if key not in there))
        ]
    elif isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        pairs = [(str(index), a, b) for index, (a, b) in enumerate(zip(there, here, strict=True))]
    else:
        return None if there == here else (where, _brief(there), _brief(here))
    found = (first_difference(a, b, f"{where}.{name}" if where else name) for name, a, b in pairs)
    return next((difference for difference in found if difference is not None), None)


def scenario_world(scenario: Scenario) -> World:
    """What stands and moves about the vehicle's way; how far it drives says what has to stand clear of it."""
    driven = scenario.vehicle.path.at(np.arange(0.0, scenario.duration_s, WAY_STEP_S))[0]
    return build_world(scenario.scene, scenario.vehicle.camera_height_m, scenario.seed, driven[:, :2])


def _same(one: World, other: World) -> bool:
    """The fixed world, and how many things move: which ones follows from seed and settings."""
    return _same_mesh(one.mesh, other.mesh) and len(one.movers) == len(other.movers)


def _same_mesh(one: Mesh, other: Mesh) -> bool:
    return (
        np.array_equal(one.vertices_m, other.vertices_m)
        and np.array_equal(one.faces, other.faces)
        and np.array_equal(one.surface, other.surface)
    )


def _brief(value: Any) -> str:
    if value is None:
        return "not given"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return "given" if isinstance(value, Mapping) else str(value)


def _scenario_of(reader: RecordingReader) -> Scenario:
    """The scenario that a recording was made of."""
    if reader.metadata.get("made_by") != "grd simulate" or reader.config_yaml is None:
        raise LinkError(f"{reader.path} is no simulated recording: --images takes one that `grd simulate` made")
    if not reader.finished:
        raise LinkError(f"{reader.path} was cut off: {NOT_THESE}")
    try:
        return Scenario.model_validate(yaml.safe_load(reader.config_yaml))
    except (yaml.YAMLError, ValidationError):
        raise LinkError(f"{reader.path}: its scenario is not one of this version of grd: {NOT_THESE}") from None
