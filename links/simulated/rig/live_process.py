"""Process of the simulated rig in real time: `python -m links.simulated.rig.live_process SETTINGS`; see `live_rig`.

Pulses are cast once the servo position at their time is known, so a packet is sent some milliseconds after its last
pulse: the duration of a batch and of its casting. Packet stamps are exact (a VLP-16 locked to the host: `clock: utc`).
Nothing waits for the graph. On a busy machine packets are late or lost, as `rig.json` reports.

Source: ours; parts of `links.simulated.rig.run`, with the servo of `links.simulated.sensors.dynamixel_emulator`.
"""

from __future__ import annotations

import heapq
import json
import resource
import socket
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flow.config_error import ConfigError
from flow.link import TRUTH_TOPICS, LinkError, Record
from flow.metrics import Latency
from links.clock import host_time
from links.mavlink.frame_decoder import ARMED
from links.mavlink.profiles import best_values, required_parameters
from links.recording import RecordingWriter
from links.runs.truth import TRUTH_RECORDING
from links.simulated.autopilot.ardupilot_rules import ArduPilotRules
from links.simulated.autopilot.autopilot import Autopilot
from links.simulated.autopilot.autopilot_socket import AutopilotSocket
from links.simulated.autopilot.flight_stack.flight_socket import FlightSocket
from links.simulated.rig.image_cache import CachedCamera, ImageCache
from links.simulated.rig.live_images import TimedImageServer
from links.simulated.rig.live_rig import READY, RIG_REPORT, LiveRigSettings
from links.simulated.rig.recorded_lidar import RecordedLidar
from links.simulated.rig.run import Simulation
from links.simulated.rig.scenario import Scenario, load_scenario
from links.simulated.sensors.camera import CamerasSettings
from links.simulated.sensors.dynamixel_emulator import DynamixelEmulator
from links.simulated.sensors.lidar_packets import encode_position
from links.simulated.sensors.vehicle_odometry import VehicleOdometry
from stages.geometry.frames import Array64

WARM_PACKETS = 75  # one revolution of the rotor
SKIP_NS = 200_000_000  # when it is this late, it skips packets: they are lost
LOOPBACK = "127.0.0.1"
DISCARD_PORT = 9
POSITION_NS = 100_000_000  # period of the LiDAR's position packets
TRUTH_NS = 100_000_000  # period of the ground truth, which nobody waits for: batches cost less
SWITCH_S = 5e-4  # thread switch interval: the thread of the servo must not wait for the one that casts


class LiveSimulation(Simulation):
    """A scenario that starts on demand, with an emulated servo. Its internal times are those of the scenario."""

    def __init__(
        self, scenario: Scenario, images: ImageCache | None = None, recorded: RecordedLidar | None = None
    ) -> None:
        """With a `recorded` LiDAR no rays are cast, and the servo follows the recording."""
        super().__init__(scenario, images=images)
        self.recorded = recorded
        self.flight_socket: FlightSocket | None = None
        self.packet_ns = self.encoder.packet_ns
        self.ahead_ns = 0
        self.emulator: DynamixelEmulator | None = None
        if self.flight is not None:
            self.flight.stack.advance(scenario.start_ns + WARM_PACKETS * self.packet_ns)
        if recorded is None:
            self._servo.advance(scenario.start_ns + WARM_PACKETS * self.packet_ns)
            self.lidar_records(scenario.start_ns, WARM_PACKETS, self.packet_ns)  # compiles all that it uses

    def begin(self, servo: Path) -> DynamixelEmulator:
        """Start the scenario now; returns the servo, not yet on its pty."""
        motor = None if self.recorded is None else self.recorded.servo()
        self.ahead_ns = self.lidar_clock_ns = host_time.now_ns() - self.scenario.start_ns
        self.emulator = DynamixelEmulator(self.scenario.servo, self.seed, servo, self.now_ns, motor=motor)
        return self.emulator

    @property
    def cached_cameras(self) -> list[CachedCamera]:
        """Cameras with recorded images; rendering cannot keep up."""
        return [camera for camera in self._cameras if isinstance(camera, CachedCamera)]

    def now_ns(self) -> int:
        """Current time of the scenario."""
        return host_time.now_ns() - self.ahead_ns

    def T_world_lidar(self, stamp_ns: NDArray[np.int64]) -> tuple[Array64, Array64]:
        """See Simulation."""
        if self.emulator is None:
            return super().T_world_lidar(stamp_ns)
        return self.T_world_lidar_at(stamp_ns, self.emulator.output_rad(stamp_ns))

    def batch(self, first_ns: int, packets: int) -> tuple[list[Record], list[Record]]:
        """LiDAR packets from a past time on, and their ground truth on the host's clock."""
        until_ns = first_ns + packets * self.packet_ns
        if self.flight_socket is not None:
            self.flight_socket.advance(until_ns)
        if self.recorded is None:
            records = self.lidar_records(first_ns, packets, self.packet_ns)
        else:
            records = self.recorded.records(first_ns, until_ns)
        truth = [self._on_host(record) for record in records if record.topic.startswith(TRUTH_TOPICS)]
        return [record for record in records if not record.topic.startswith(TRUTH_TOPICS)], truth

    def host_truth_records(self, until_ns: int) -> list[Record]:
        """Ground truth before `until_ns` that was not returned yet, on the host's clock."""
        return [self._on_host(record) for record in self.truth_records(until_ns)]

    def _on_host(self, record: Record) -> Record:
        data = record.data
        if record.topic.startswith("/truth/hits"):
            pulse_ns = [stamp + self.ahead_ns for stamp in json.loads(data)["pulse_stamp_ns"]]
            data = json.dumps({"pulse_stamp_ns": pulse_ns}).encode()
        return Record(record.topic, record.arrival_ns + self.ahead_ns, record.stamp_ns + self.ahead_ns, data)


class LiveAutopilot(AutopilotSocket):
    """An autopilot with the required parameters that can report disarmed in flight."""

    armed = True

    def _send(self, message: Any) -> None:
        if not self.armed and message.get_type() == "HEARTBEAT":
            message.base_mode &= ~ARMED
        super()._send(message)


class RealTimeRig:
    """Sends until it is stopped or the scenario is over."""

    def __init__(self, rig: LiveRigSettings, folder: Path) -> None:
        scenario = load_scenario(rig.scenario)
        overrides: dict[str, Any] = {"seed": rig.seed, "duration_s": rig.duration_s}
        if rig.lidar_model is not None and rig.lidar_model != scenario.rig.model:
            lidar = {"model": rig.lidar_model, "mount": scenario.rig.mount}
            overrides["rig"] = lidar if rig.lidar_beams is None else {**lidar, "beams": rig.lidar_beams}
            if rig.lidar_beams is not None and rig.lidar_model.startswith("OS"):
                overrides["lidar"] = scenario.lidar.model_copy(update={"return_mode": rig.lidar_beams.return_mode})
        scenario = scenario.changed(**{name: value for name, value in overrides.items() if value is not None})
        self._rig, self._folder = rig, folder
        if rig.images is None:  # nothing reads its cameras
            scenario = scenario.changed(cameras=CamerasSettings())
        images = None if rig.images is None else ImageCache(rig.images, scenario)
        recorded = None if rig.packets is None else RecordedLidar(rig.packets, scenario)
        self._scenario, self.simulation = scenario, LiveSimulation(scenario, images, recorded)
        self.late = Latency()  # from the last pulse of a packet to its sending
        self.stop = threading.Event()
        self.packets = self.skipped = self.received = self.images = 0

    def run(self, ready: threading.Event) -> None:
        """Run the whole flight, in real time."""
        rig, scenario, simulation = self._rig, self._scenario, self.simulation
        with ExitStack() as open_parts:
            rig.servo.parent.mkdir(parents=True, exist_ok=True)
            open_parts.enter_context(simulation.begin(rig.servo))
            truth_file = RecordingWriter(self._folder / TRUTH_RECORDING, rig_yaml=scenario.rig_yaml())
            open_parts.enter_context(truth_file)
            udp = open_parts.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            autopilot = self._flight(simulation) or self._autopilot(simulation)
            if autopilot is not None:
                open_parts.enter_context(autopilot)
            images = open_parts.enter_context(self._cameras(simulation))
            ready.set()
            sent_ns = self._send(simulation, udp, truth_file)
            for record in simulation.host_truth_records(sent_ns):
                truth_file.write(record)
            self.images = images.shown
            if autopilot is not None:
                received = autopilot.received
                self.received = received if isinstance(received, int) else len(received)
        self._report()

    def _cameras(self, simulation: LiveSimulation) -> TimedImageServer:
        served = () if self._rig.images is None else self._rig.camera_ports.items()
        ports = {f"/camera/{platform}": port for platform, port in served}
        end_ns = self._scenario.start_ns + round(1e9 * self._scenario.duration_s)
        return TimedImageServer(simulation.cached_cameras, ports, simulation.now_ns, end_ns)

    def _flight(self, simulation: LiveSimulation) -> FlightSocket | None:
        """An autopilot in the loop; without a port it flies without a link."""
        if simulation.flight is None:
            return None
        send_to = LOOPBACK, self._rig.autopilot_port or DISCARD_PORT
        simulation.flight_socket = FlightSocket(simulation.flight.stack, send_to, simulation.now_ns)
        return simulation.flight_socket

    def _autopilot(self, simulation: LiveSimulation) -> AutopilotSocket | None:
        flight = next((source for source in simulation.telemetry_sources if isinstance(source, Autopilot)), None)
        if flight is None or self._rig.autopilot_port is None:
            return None
        send_to = LOOPBACK, self._rig.autopilot_port
        autopilot = LiveAutopilot(
            ArduPilotRules(),
            send_to=send_to,
            flight=flight,
            scenario_ns=simulation.now_ns,
            parameters=best_values(required_parameters("ardupilot", "none")),
        )
        autopilot.armed = self._rig.armed
        return autopilot

    def _send(self, simulation: LiveSimulation, udp: socket.socket, truth_file: RecordingWriter) -> int:
        """Send packets to the end; returns the time up to which they were sent."""
        rig, scenario = self._rig, self._scenario
        odometry = next(
            (source for source in simulation.telemetry_sources if isinstance(source, VehicleOdometry)), None
        )
        batch_packets = max(round(1e9 * rig.batch_s / simulation.packet_ns), 1)
        batch_ns = batch_packets * simulation.packet_ns
        first_ns, end_ns = scenario.start_ns, scenario.start_ns + round(1e9 * scenario.duration_s)
        poses: list[tuple[int, int, bytes]] = []  # (arrival, stamp, data)
        position_ns = 0  # due time of the next position packet
        truth_ns = first_ns  # due time of the next ground truth
        while first_ns + batch_ns <= end_ns:
            behind_ns = simulation.now_ns() - first_ns
            if behind_ns > SKIP_NS:
                skipped = behind_ns // simulation.packet_ns - batch_packets
                self.skipped += skipped
                first_ns += skipped * simulation.packet_ns
            next_ns = first_ns + batch_ns
            if self.stop.wait(max(0, next_ns - simulation.now_ns()) * 1e-9):
                return first_ns
            if rig.position_port is not None and next_ns >= position_ns:
                udp.sendto(encode_position(host_time.now_ns()), (LOOPBACK, rig.position_port))
                position_ns = next_ns + POSITION_NS
            packets, truth = simulation.batch(first_ns, batch_packets)
            for packet in packets:
                udp.sendto(packet.data, (LOOPBACK, rig.lidar_port))
                self.late.add(max(simulation.now_ns() - packet.stamp_ns - simulation.packet_ns, 1))
            self.packets += len(packets)
            if next_ns >= truth_ns:
                truth += simulation.host_truth_records(next_ns)
                truth_ns = next_ns + TRUTH_NS
            for record in truth:
                truth_file.write(record)
            for pose in odometry.records(next_ns) if odometry is not None else ():
                heapq.heappush(poses, (pose.arrival_ns, pose.stamp_ns, pose.data))
            while poses and poses[0][0] <= simulation.now_ns():
                _, stamp_ns, pose_json = heapq.heappop(poses)
                if rig.odometry_port is not None:
                    udp.sendto(_with_age(pose_json, simulation.now_ns() - stamp_ns), (LOOPBACK, rig.odometry_port))
            first_ns = next_ns
        return first_ns

    def _report(self) -> None:
        used = resource.getrusage(resource.RUSAGE_SELF)
        late = self.late
        report = {
            "packets": self.packets,
            "packets_skipped": self.skipped,
            "sent_after_last_pulse_ms": {
                "p50": round(late.percentile_ns(50) / 1e6, 3),
                "p99": round(late.percentile_ns(99) / 1e6, 3),
                "max": round(late.max_ns / 1e6, 3),
            },
            "mavlink_received": self.received,
            "images": self.images,
            "cpu_s": round(used.ru_utime + used.ru_stime, 2),
            "max_rss_mb": round(used.ru_maxrss / 1024, 1),
        }
        (self._folder / RIG_REPORT).write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


def _with_age(pose_json: bytes, age_ns: int) -> bytes:
    return json.dumps({**json.loads(pose_json), "age_s": age_ns * 1e-9}).encode()


def main(settings: str) -> int:
    """Run the rig until standard input ends. Prints READY when it starts to send."""
    given = json.loads(settings)
    folder = Path(given.pop("folder"))
    sys.setswitchinterval(SWITCH_S)
    try:
        rig = RealTimeRig(LiveRigSettings.model_validate(given), folder)
        ready = threading.Event()
        sending = threading.Thread(target=rig.run, args=(ready,), daemon=True)
        sending.start()
        while sending.is_alive() and not ready.wait(0.05):
            pass
        if not ready.is_set():
            return 1
        sys.stdout.write(f"{READY}\n")
        sys.stdout.flush()
        threading.Thread(target=_until_input_ends, args=(rig.stop,), daemon=True).start()
        sending.join()
    except (ConfigError, LinkError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


def _until_input_ends(stop: threading.Event) -> None:
    while sys.stdin.read(1):
        time.sleep(0.1)
    stop.set()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
