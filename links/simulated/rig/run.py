"""Simulates a scenario: records in order of arrival, or a recording on disk.

Source: ours. The same scenario and seed give the same bytes. Ground truth goes to /truth/* only.
"""

from __future__ import annotations

import dataclasses
import heapq
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import NDArray

from flow.link import TRUTH_TOPICS, LinkError, Record
from links.lidar import packet_format
from links.recording import RecordingWriter
from links.simulated.autopilot.autopilot import Autopilot
from links.simulated.autopilot.flight_stack.outcomes.outcome import Outcome
from links.simulated.autopilot.flight_stack.stack import FlightStack
from links.simulated.cues.cue_sensors import CueSensors
from links.simulated.kernels.lidar import lidar_poses
from links.simulated.pose_sensors.fix_sensor import FixSensor
from links.simulated.pose_sensors.rotation_sensor import RotationSensor
from links.simulated.rig.closed_loop import ClosedLoop, load_loop
from links.simulated.rig.cue_sources import cue_sensors, drone_receiver
from links.simulated.rig.flight_in_the_loop import FlightInTheLoop, check_loop
from links.simulated.rig.image_cache import CachedCamera, ImageCache, scenario_world
from links.simulated.rig.scenario import OtherDroneSettings, Scenario, load_scenario
from links.simulated.rig.scripted_servo import ServoScript
from links.simulated.rig.truth_records import TruthRecords
from links.simulated.sensors.camera import Camera, build_cameras
from links.simulated.sensors.camera_paint import Street
from links.simulated.sensors.lidar import Lidar
from links.simulated.sensors.lidar_packets import PacketEncoder
from links.simulated.sensors.servo import ServoBus
from links.simulated.sensors.vehicle_odometry import VehicleOdometry
from links.simulated.world.clearance import check_paths
from links.simulated.world.flight import Flight
from links.simulated.world.flown_motion import FlownMotion
from links.simulated.world.path import Path
from links.simulated.world.scene import Scene, Truth, drone_shapes
from links.simulated.world.suspension import SuspendedPath
from links.simulated.world.vehicle import vehicle_mesh, vehicle_mesh_from_camera
from stages.geometry.frames import Array64

OTHER_SEEDS = 1_000_003  # between the seeds of two drones' gusts and sensor errors
BATCH_PACKETS = 32  # pulses are cast in batches; their size changes no byte


@dataclasses.dataclass(frozen=True)
class SimulationReport:
    """Statistics of a simulation."""

    seed: int
    records: int
    pulses: int
    returns: int
    drone_returns: int  # pulses with a return that has most of its power from a drone
    wall_s: float
    size_bytes: int
    output_hash: str | None = None  # of the closed loop; a replay with the same configuration has the same hash
    outcome: Outcome | None = None  # of an autopilot in the loop

    def __str__(self) -> str:
        text = (
            f"seed {self.seed}: {self.records} records, {self.pulses} pulses, {self.returns} with a return, "
            f"{self.drone_returns} from the drone; {self.size_bytes / 1e6:.2f} MB in {self.wall_s:.1f} s"
        )
        if self.output_hash is not None:
            text += f"; closed loop's output hash {self.output_hash}"
        return text if self.outcome is None else f"{text}\n{self.outcome}"


class Simulation:
    """One run of a scenario. Iterate `records()` once; the counts and `drone_return_ns` are updated meanwhile."""

    def __init__(
        self,
        scenario: Scenario,
        seed: int | None = None,
        loop: ClosedLoop | None = None,
        images: ImageCache | None = None,
        *,
        record_truth: bool = True,
    ) -> None:
        """With a `loop` its pipeline commands the servo, and the scenario's script is not used.

        With `images`, a recording of the same flight, the cameras are not rendered.
        """
        if loop is not None:
            check_loop(loop.graph, scenario)
        self._loop, self._record_truth = loop, record_truth
        self.scenario = scenario if seed is None else scenario.changed(seed=seed)
        self.seed = self.scenario.seed
        start_ns, duration_s = scenario.start_ns, scenario.duration_s
        self.telemetry_sources: list[Autopilot | FlightStack | VehicleOdometry | RotationSensor | CueSensors] = []
        self.flight: FlightInTheLoop | None = None
        vehicle_motion = _vehicle_motion(self.scenario)
        odometry: VehicleOdometry | None = None
        if scenario.vehicle_odometry is not None:
            odometry = VehicleOdometry(scenario.vehicle_odometry, vehicle_motion, start_ns, duration_s, self.seed)
        drone_motion = self._drone_motion(odometry)
        if odometry is not None:
            self.telemetry_sources.append(odometry)
        if (cues := cue_sensors(self.scenario, vehicle_motion, drone_motion)) is not None:
            self.telemetry_sources.append(cues)
        others = [self._other_motion(number, other) for number, other in enumerate(scenario.other_drones, 2)]
        self.truth = Truth(start_ns, vehicle_motion, drone_motion, tuple(others))
        self._scene = _scene(self.scenario, self.truth)
        self._check_paths()
        if self.flight is not None:
            self.flight.watch(self._scene.world, self.truth)
        fixes = scenario.fix_sensor
        self._fixes = None if fixes is None else FixSensor(fixes, self.truth, scenario.lidar_gaps_s, self.seed)
        if scenario.rotation_sensor is not None:
            self.telemetry_sources.append(RotationSensor(scenario.rotation_sensor, self.truth, self.seed))
        form = packet_format(scenario.rig.model, scenario.rig.beams)
        self._lidar = Lidar(scenario.lidar, scenario.start_ns, self.seed, scenario.weather, form)
        self.encoder = PacketEncoder(scenario.rig, scenario.lidar.return_mode)
        script = scenario.script if loop is None else ()
        commander = ServoScript(script, self.drone_servo_rad if scenario.drone else None, self.seed)
        shift_ns = round(scenario.mount.servo_time_offset_s * 1e9)
        self._servo = ServoBus(scenario.servo, commander, scenario.start_ns, shift_ns, self.seed)
        self._arrival = np.random.default_rng([self.seed, 5])
        self._packet_arrival_ns = 0  # of the newest LiDAR packet: datagrams on one cable keep their order
        self._cameras: Sequence[Camera | CachedCamera] = (
            self._rendered_cameras() if images is None else images.cameras(self.truth)
        )
        lidar_at = (lambda stamp_ns: self.T_world_lidar(stamp_ns)[1]) if scenario.truth_visible else None
        self._truth_records = TruthRecords(self.truth, self._scene.world, lidar_at)
        self._waiting: list[tuple[int, int, Record]] = []  # by arrival
        self._made = itertools.count()
        self.lidar_clock_ns = 0  # offset of the LiDAR's clock from the scenario's
        self.pulses = 0
        self.returns = 0
        self.drone_return_ns: list[int] = []  # truth, for statistics: times of returns from drones

    def _check_paths(self) -> None:
        """Raise LinkError for a planned path that meets the scene."""
        drone, others = self.scenario.drone, self.scenario.other_drones
        spans_m = [flying.span_m for flying in (drone, *others) if flying is not None]
        planned = self.truth if self.flight is None else dataclasses.replace(self.truth, drone=drone and drone.path)
        check_paths(self._scene.world, planned, self.scenario.duration_s, spans_m)

    def _drone_motion(self, odometry: VehicleOdometry | None) -> Path | Flight | FlownMotion | None:
        """The drone's motion: its path, a flight along it, or that of an autopilot in the loop. Adds the autopilot."""
        scenario, drone, autopilot = self.scenario, self.scenario.drone, self.scenario.autopilot
        if drone is None or autopilot is None:
            return drone.path if drone else None
        if autopilot.flight_stack is not None:
            self.flight = FlightInTheLoop(scenario, self._loop, odometry)
            self.telemetry_sources.append(self.flight.stack)
            return self.flight.stack.motion
        start_ns, duration_s = scenario.start_ns, scenario.duration_s
        motion = Flight(drone.path, autopilot.flight, duration_s, self.seed)
        receiver = drone_receiver(scenario, motion)
        self.telemetry_sources.append(Autopilot(autopilot, motion, start_ns, duration_s, self.seed, receiver))
        return motion

    def _other_motion(self, number: int, drone: OtherDroneSettings) -> Path | Flight:
        """The motion of drone 2, 3, ...: its path, or a flight along it. Adds its autopilot."""
        if drone.autopilot is None:
            return drone.path
        start_ns, duration_s, seed = self.scenario.start_ns, self.scenario.duration_s, self.seed + number * OTHER_SEEDS
        motion = Flight(drone.path, drone.autopilot.flight, duration_s, seed)
        autopilot = Autopilot(drone.autopilot, motion, start_ns, duration_s, seed, drone=number)
        self.telemetry_sources.append(autopilot)
        return motion

    def _rendered_cameras(self) -> list[Camera]:
        scenario, height = self.scenario, self.scenario.vehicle.camera_height_m
        return build_cameras(
            scenario.cameras,
            self._scene,
            Street.of(scenario.scene, height),
            scenario.weather,
            vehicle_mesh_from_camera(height, scenario.mount),
            scenario.start_ns,
            self.seed,
            reflections=scenario.scene.clutter,
        )

    def records(self) -> Iterator[Record]:
        """All records in order of arrival, with sequence numbers."""
        sent = 0
        start_ns = self.scenario.start_ns
        end_ns = start_ns + round(self.scenario.duration_s * 1e9)
        packet_ns = self.encoder.packet_ns
        first_ns = start_ns
        most = BATCH_PACKETS if self._loop is None else max(1, self._loop.longest_batch_ns() // packet_ns)
        while first_ns < end_ns:
            packets = min(most, -(-(end_ns - first_ns) // packet_ns))
            next_ns = first_ns + packets * packet_ns
            self._push(self._made_records(first_ns, packets, packet_ns))
            first_ns = next_ns
            if self.flight is not None and self.flight.is_over():
                end_ns = next_ns
            while self._waiting and (self._waiting[0][0] < next_ns or first_ns >= end_ns):
                record: Record | None = heapq.heappop(self._waiting)[2]
                if self.flight is not None:
                    record = self.flight.arrived(record)
                    if record is None:
                        continue
                record = dataclasses.replace(record, sequence=sent)
                self._feed_loop(record)
                yield record
                sent += 1
        if self._loop is not None:
            self._loop.finish()
        if self.flight is not None and (outcome := self.flight.record(end_ns)) is not None:
            yield dataclasses.replace(outcome, sequence=sent)

    def _made_records(self, first_ns: int, packets: int, packet_ns: int) -> list[Record]:
        """Records of all sensors from a time on, for the duration of so many LiDAR packets."""
        next_ns = first_ns + packets * packet_ns
        if self.flight is not None:
            self.flight.stack.advance(next_ns)
        if self._fixes is not None:
            records = self._fixes.records(next_ns)
        else:
            records = self._servo.advance(next_ns)
            records += self.lidar_records(first_ns, packets, packet_ns)
        for camera in self._cameras:
            records += camera.records(next_ns)
        for source in self.telemetry_sources:
            records += source.records(next_ns)
        return records + (self.truth_records(next_ns) if self._record_truth else [])

    def _push(self, records: list[Record]) -> None:
        """Keep records until they arrive, except LiDAR packets in a gap."""
        gaps_ns = [[self.scenario.start_ns + round(1e9 * s) for s in gap] for gap in self.scenario.lidar_gaps_s]
        for record in records:
            lidar = record.topic == "/lidar/packets"
            if not (lidar and any(begin <= record.stamp_ns < end for begin, end in gaps_ns)):
                heapq.heappush(self._waiting, (record.arrival_ns, next(self._made), record))

    def _feed_loop(self, record: Record) -> None:
        """Feed a record to the pipeline, except ground truth; pass on its command to the servo and its frames."""
        if self._loop is None or record.topic.startswith(TRUTH_TOPICS):
            return
        sent = self._loop.take(record)
        if sent is not None:
            left_ns, command = sent
            self._servo.command(left_ns, command.position_rad, command.speed_radps)
        if self.flight is not None:
            self._push(self.flight.sent())

    def T_world_lidar(self, stamp_ns: NDArray[np.int64]) -> tuple[Array64, Array64]:
        """True poses of the LiDAR: rotations (n, 3, 3), positions (n, 3) [m]."""
        return self.T_world_lidar_at(stamp_ns, self._servo.output_rad(stamp_ns))

    def T_world_lidar_at(self, stamp_ns: NDArray[np.int64], output_rad: Array64) -> tuple[Array64, Array64]:
        """The same for given output angles (n,) of the servo: T_wv T_vt Rz(angle) T_tl."""
        mount = self.scenario.mount
        T_vehicle_turntable, T_turntable_lidar = mount.T_vehicle_turntable.matrix(), mount.T_turntable_lidar.matrix()
        R_world_vehicle, t_world_vehicle = self.truth.T_world_vehicle(stamp_ns)
        angle_rad = mount.turntable_rad(output_rad)
        return lidar_poses(R_world_vehicle, t_world_vehicle, T_vehicle_turntable, angle_rad, T_turntable_lidar)

    def drone_servo_rad(self, time_s: float) -> float:
        """Servo position at which the plane through the turntable's axis and azimuth 0 contains the drone."""
        stamp = np.array([self.scenario.start_ns + round(max(time_s, 0.0) * 1e9)])
        R, t = (part[0] for part in self.truth.T_world_vehicle(stamp))
        drone = R.T @ (self.truth.T_world_drone(stamp)[1][0] - t)
        mount = self.scenario.mount
        T = mount.T_vehicle_turntable.matrix()
        x, y, _ = T[:3, :3].T @ (drone - T[:3, 3])
        return mount.servo_sign * float(np.mod(np.arctan2(y, x), np.pi)) + np.radians(mount.servo_zero_deg)

    def truth_records(self, until_ns: int) -> list[Record]:
        """Ground truth before `until_ns` that was not returned yet."""
        return self._truth_records.records(until_ns)

    def lidar_records(self, first_ns: int, packets: int, packet_ns: int) -> list[Record]:
        """LiDAR packets from a time on, in order of time, and the records of pulses that drones returned."""
        profile, sequences = self.encoder.profile, self.encoder.sequences
        sequence_ns = first_ns + self.encoder.sequence_offsets_ns(packets)
        pulse_ns = (sequence_ns[:, None] + np.array(profile.firing_ns)).ravel()
        pulses = self._lidar.fire(pulse_ns, *self.T_world_lidar(pulse_ns), self._scene)
        self.pulses += len(pulse_ns)
        self.returns += int(np.count_nonzero(pulses.range_m))
        self.drone_return_ns += pulse_ns[(pulses.drone_share > 0.5).any(axis=0)].tolist()
        azimuth = self._lidar.azimuth_rad(sequence_ns).reshape(packets, -1)
        ranges = pulses.range_m.reshape(-1, packets, sequences, profile.lasers)
        shades = pulses.reflectivity.reshape(ranges.shape)
        jitter_ns = self._arrival.uniform(3e5, 8e5, packets).astype(np.int64)
        last_pulse_ns = pulse_ns.reshape(packets, -1)[:, -1]
        arrivals_ns = np.maximum.accumulate(np.maximum(last_pulse_ns + jitter_ns, self._packet_arrival_ns))
        self._packet_arrival_ns = int(arrivals_ns[-1])
        records: list[Record] = []
        for i in range(packets):
            at = first_ns + i * packet_ns
            data = self.encoder.encode(at + self.lidar_clock_ns, azimuth[i], ranges[:, i], shades[:, i])
            stamp_ns = at // 1000 * 1000
            records.append(Record("/lidar/packets", arrival_ns=int(arrivals_ns[i]), stamp_ns=stamp_ns, data=data))
        return records + self._truth_records.hits(pulse_ns.reshape(packets, -1), pulses)


def _vehicle_motion(scenario: Scenario) -> Path | SuspendedPath:
    vehicle = scenario.vehicle
    if vehicle.suspension is None:
        return vehicle.path
    return SuspendedPath(vehicle.path, vehicle.suspension, scenario.duration_s, scenario.seed)


def _scene(scenario: Scenario, truth: Truth) -> Scene:
    world, drone = scenario_world(scenario), scenario.drone
    return Scene(
        world.mesh,
        vehicle_mesh(scenario.vehicle.camera_height_m),
        drone_shapes(drone.span_m, drone.model) if drone else (),
        truth,
        world.movers,
        scenario.weather.wetness,
        [drone_shapes(other.span_m, other.model) for other in scenario.other_drones],
    )


def simulate(
    scenario: FilePath,
    out: FilePath,
    seed: int | None = None,
    progress: Callable[[float], None] | None = None,
    overwrite: bool = False,
    closed_loop: FilePath | None = None,
    duration_s: float | None = None,
    images: FilePath | None = None,
    sets: Sequence[str] = (),
) -> SimulationReport:
    """Simulate a scenario file into a recording, in closed loop if a configuration is given.

    `sets` change settings of the scenario (`autopilot.imu_hz=25`). `images` is a recording of the same flight whose
    images are used; the result is the same to the byte. `progress` gets the completed fraction, 0 to 1. Errors are
    LinkError, and ConfigError for the configuration.
    """
    given = {"seed": seed, "duration_s": duration_s}
    loaded = load_scenario(scenario, sets).changed(
        **{name: value for name, value in given.items() if value is not None}
    )
    loop = None
    if closed_loop is not None:
        loop = load_loop(closed_loop, loaded.rig_yaml(), f"{loaded.name} (rig)", loaded.closed_loop)
    return simulate_into(out, loaded, progress, overwrite, loop, images)


def simulate_into(
    out: FilePath,
    scenario: Scenario,
    progress: Callable[[float], None] | None = None,
    overwrite: bool = False,
    loop: ClosedLoop | None = None,
    images: FilePath | None = None,
) -> SimulationReport:
    """The same for a scenario in memory. The recording has the scenario, with every setting, attached as its config."""
    if images is not None and out.exists() and out.samefile(images):
        raise LinkError(f"{out} is both the output and the source of the images: choose another name for the output")
    began = time.perf_counter()
    simulation = Simulation(scenario, loop=loop, images=images and ImageCache(images, scenario))
    metadata = {"made_by": "grd simulate", "scenario": scenario.name, "seed": str(simulation.seed)}
    if loop is not None:
        metadata |= loop.loop_metadata
    count = 0
    with RecordingWriter(
        out,
        rig_yaml=scenario.rig_yaml(),
        config_yaml=scenario.as_yaml(),
        metadata=metadata,
        lossless=True,
        overwrite=overwrite,
    ) as writer:
        for record in simulation.records():
            writer.write(record)
            count += 1
            if progress is not None and count % 100 == 0:
                progress(min(1.0, (record.arrival_ns - scenario.start_ns) * 1e-9 / scenario.duration_s))
    if progress is not None:
        progress(1.0)
    return SimulationReport(
        seed=simulation.seed,
        records=count,
        pulses=simulation.pulses,
        returns=simulation.returns,
        drone_returns=len(simulation.drone_return_ns),
        wall_s=time.perf_counter() - began,
        size_bytes=out.stat().st_size,
        output_hash=None if loop is None else loop.output_hash,
        outcome=None if simulation.flight is None else simulation.flight.result(),
    )
