"""Closed loop: goals of the pipeline drive the simulated servo, in virtual time.

Each record of the simulation is fed to the graph at its arrival. A goal that follows from it leaves the host
`compute_s` later, whatever the simulating computer needs, and the servo executes it after its command latency. The
simulation never runs further ahead of the graph than `compute_s`, so no goal is late. Therefore the same scenario, seed
and configuration give the same bytes, however pulses are batched.

A replay of the recording with the same configuration takes the same steps and has the same output hash.

Source: ours; conservative look-ahead as in parallel discrete event simulation (Chandy and Misra, 1979).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory

import yaml
from pydantic import Field

from flow.counters import Counters
from flow.graph import Graph
from flow.link import LinkError, Record, Tap
from flow.message import Message
from flow.replay import Replay, RunReport
from flow.stage import StrictModel
from flow.taps import Digest
from links.dynamixel import Servo
from links.dynamixel.servo import NOT_LIVE, GoalCommand
from links.lidar import Lidar
from links.mavlink.poses.sent_frame import SentFrame
from links.runs.request import RunRequest
from links.simulated.rig.pose_loop import PoseLoop, PoseTap, has_autopilot
from links.simulated.sensors.servo import STEP_NS
from links.simulated.world.path import TimeSpan
from stages.messages import ServoGoal

LONGEST_BATCH_NS = 40_000_000  # longer batches are not faster


class ClosedLoopSettings(StrictModel):
    """Compute time of the host on the vehicle."""

    compute_s: float = Field(default=0.02, ge=0.003, le=1)  # from arrival of a record to the goal leaving the host
    killed_s: TimeSpan | None = None  # grd is not running; it starts again without its state


class GoalTap(Tap):
    """Passes each goal that is wired to the servo on to it, as a live run does."""

    def __init__(self) -> None:
        super().__init__()
        self._output: str | None = None
        self._servo: Servo | None = None

    def watch(self, output: str, servo: Servo) -> None:
        """Set the output that commands the servo, and the servo."""
        self._output, self._servo = output, servo

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Pass on a goal."""
        if self._servo is not None and output == self._output and isinstance(message, ServoGoal):
            self._servo.on_goal(message)


class ClosedLoop:
    """A graph that is fed with the records of the simulation and commands its servo."""

    def __init__(
        self, graph: Graph, settings: ClosedLoopSettings, loop_metadata: dict[str, str], taps: Sequence[Tap] = ()
    ) -> None:
        """`loop_metadata` is for the recording, names the configuration; `taps` are open and see all messages."""
        self.loop_metadata = loop_metadata
        self.graph, self._settings = graph, settings
        self._digest, self._taps = Digest(), taps
        self._compute_ns = round(settings.compute_s * 1e9)
        self._start_ns: int | None = None
        self._running = True
        self._folder = TemporaryDirectory(prefix="grd-") if settings.killed_s is not None else None
        self._start()

    def _start(self) -> None:
        """Build the graph's nodes, and, with an autopilot in the loop, open its session."""
        graph, goals, poses = self.graph, GoalTap(), PoseTap()
        self._replay = Replay(graph, (self._digest, goals, poses, *self._taps))
        self._servo: Servo | None = None
        if any(issubclass(spec.cls, Lidar | Servo) for spec in graph.nodes.values()):
            self._servo_name, output = servo_edge(graph)
            servo = self._replay.nodes[self._servo_name]
            assert isinstance(servo, Servo)
            self._servo = servo
            goals.watch(output, servo)
        connected = self._start_ns is not None and has_autopilot(graph)
        self._pose_tap = poses
        state_file = None if self._folder is None else FilePath(self._folder.name) / "sent.json"
        self._poses = PoseLoop(self._replay, graph, poses, self._compute_ns, state_file) if connected else None

    def connect_autopilot(self, start_ns: int) -> None:
        """The autopilot of a scenario that starts at a time flies on what the graph sends: open its session."""
        self._start_ns = start_ns
        self._start()

    def receive(self, record: Record) -> Record | None:
        """A record as it arrives at the host: a frame of the autopilot gets its stamp. None: not for the graph."""
        if not self._is_running(record.arrival_ns):
            return None
        return record if self._poses is None else self._poses.before(record)

    def _is_running(self, now_ns: int) -> bool:
        """Whether grd runs; after it was killed it is restarted."""
        killed_s = self._settings.killed_s
        if killed_s is None or self._start_ns is None:
            return True
        begin_ns, end_ns = (self._start_ns + round(1e9 * s) for s in killed_s)
        running = not begin_ns <= now_ns < end_ns
        if running and not self._running:
            self._start()
        self._running = running
        return running

    @property
    def heading_s(self) -> float | None:
        """Time from the first position to the first pose with a rotation, since the last start; None: not yet."""
        first_ns = self._pose_tap.first_ns
        return (first_ns[True] - min(first_ns.values())) * 1e-9 if True in first_ns else None

    @property
    def sent_frame(self) -> SentFrame | None:
        """Frame that poses are sent in; None: none was sent."""
        return None if self._poses is None else self._poses.sent_frame

    def sent(self) -> list[Record]:
        """Frames to the autopilot since the last call, stamped with the time at which they leave the host."""
        return [] if self._poses is None else self._poses.sent()

    def take(self, record: Record) -> tuple[int, GoalCommand] | None:
        """Process a record that has arrived; returns the time at which a command leaves the host, and the command."""
        self._replay.feed(record)
        command = None if self._servo is None else self._servo.take_command()
        return None if command is None else (record.arrival_ns + self._compute_ns, command)

    def longest_batch_ns(self) -> int:
        """How far the simulation may run ahead of the newest record fed to the graph."""
        return min(LONGEST_BATCH_NS, self._compute_ns - STEP_NS)

    def finish(self) -> RunReport:
        """Let the stages emit what they hold."""
        report = self._replay.finish()
        if self._servo is not None:  # these commands went to the simulated servo
            counters = report.counters[self._servo_name]
            totals = {name: count for name, count in counters.totals.items() if name != NOT_LIVE}
            report.counters[self._servo_name] = Counters(totals, groups=counters.groups)
        return report

    @property
    def report(self) -> RunReport:
        """Report of the graph up to now."""
        return self._replay.report

    @property
    def output_hash(self) -> str:
        """Hash over all messages up to now, as `grd replay` writes it."""
        return self._digest.hexdigest()


def servo_edge(graph: Graph) -> tuple[str, str]:
    """Name of the servo link that the graph commands, and the output wired to it. LinkError unless there is one."""
    found = [
        (edge.consumer, f"{edge.producer}.{edge.output}")
        for edge in graph.edges
        if issubclass(graph.nodes[edge.consumer].cls, Servo) and edge.port == "goal"
    ]
    if len(found) != 1:
        raise LinkError(
            f"closed loop needs exactly one servo that the graph commands, this graph has {len(found)}: wire it as "
            "'servo: {use: links.dynamixel.Servo, inputs: {goal: aim.servo_goal}}', as in configs/sim.yaml"
        )
    return found[0]


def loop_metadata(config: FilePath, graph: Graph) -> dict[str, str]:
    """Metadata of a recording made in closed loop: name of the configuration and hash of its content.

    The hash includes included files and the rig, but not the taps, which change no message.
    """
    taps = {name for name, spec in graph.nodes.items() if issubclass(spec.cls, Tap)}
    links = {name: link for name, link in graph.values.get("links", {}).items() if name not in taps}
    content = yaml.safe_dump(graph.values | {"links": links}, sort_keys=False)
    return {
        "closed_loop": config.name,
        "closed_loop_hash": hashlib.blake2b(content.encode(), digest_size=16).hexdigest(),
    }


def load_loop(
    config: FilePath, rig_yaml: str, scenario: str, settings: ClosedLoopSettings, taps: Sequence[Tap] = ()
) -> ClosedLoop:
    """A configuration as a closed loop on the rig of a scenario. ConfigError has all problems of the configuration."""
    graph = RunRequest(config).graph(rig_yaml, scenario)
    return ClosedLoop(graph, settings, loop_metadata(config, graph), taps)
