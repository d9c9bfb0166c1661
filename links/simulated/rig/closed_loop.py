"""Closed loop: the pipeline's own goals drive the simulated servo, in virtual time.

Each record that the simulation makes is fed to the graph when it has arrived. A goal that the graph gives leaves the
host `compute_s` after the arrival of the record that caused it, whatever the computer that simulates needs, and the
servo obeys its command latency later. The simulation never runs further ahead of the graph than `compute_s`, so no
goal comes too late to be obeyed in time: the same scenario, seed and configuration give the same bytes, and it does not
matter how pulses are batched.

A replay of the recording with the same configuration takes the same steps: its output hash is the one given here.

Source: ours; conservative look-ahead as in parallel discrete event simulation (Chandy and Misra, 1979).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import yaml
from pydantic import BaseModel, ConfigDict, Field

from flow.graph import Graph
from flow.link import LinkError, Record, Tap
from flow.message import Message
from flow.replay import Replay, RunReport
from flow.taps import Digest
from links.dynamixel import Servo
from links.dynamixel.servo import NOT_LIVE, GoalCommand
from links.run_folder import Asked
from links.simulated.sensors.servo import STEP_NS
from stages.messages import ServoGoal

LONGEST_BATCH_NS = 40_000_000  # a longer one saves no more time


class ClosedLoopSettings(BaseModel):
    """How the host on the vehicle keeps up."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    compute_s: float = Field(default=0.02, ge=0.003, le=1)  # arrival of a record to the goal it causes leaving the host


class GoalTap(Tap):
    """Hands each goal that is wired to the servo over to it, as a live run does."""

    def __init__(self) -> None:
        super().__init__()
        self._output: str | None = None
        self._servo: Servo | None = None

    def watch(self, output: str, servo: Servo) -> None:
        """Which goals go to which servo."""
        self._output, self._servo = output, servo

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """A goal on its way."""
        if self._servo is not None and output == self._output and isinstance(message, ServoGoal):
            self._servo.on_goal(message)


class ClosedLoop:
    """A graph that is fed with the simulation's records and commands its servo."""

    def __init__(
        self, graph: Graph, settings: ClosedLoopSettings, loop_metadata: dict[str, str], taps: Sequence[Tap] = ()
    ) -> None:
        """`loop_metadata` is what recordings keep of the graph's origin; `taps` are open and see every message."""
        self.loop_metadata = loop_metadata
        self._digest, goals = Digest(), GoalTap()
        self._replay = Replay(graph, (self._digest, goals, *taps))
        name, output = servo_edge(graph)
        servo = self._replay.nodes[name]
        assert isinstance(servo, Servo)
        self._servo, self._servo_name = servo, name
        goals.watch(output, servo)
        self._compute_ns = round(settings.compute_s * 1e9)

    def take(self, record: Record) -> tuple[int, GoalCommand] | None:
        """Run all that follows from a record that has arrived: when which command leaves the host, or None."""
        self._replay.feed(record)
        command = self._servo.take_command()
        return None if command is None else (record.arrival_ns + self._compute_ns, command)

    def longest_batch_ns(self) -> int:
        """How far the simulation may run ahead of the newest record that the graph has seen."""
        return min(LONGEST_BATCH_NS, self._compute_ns - STEP_NS)

    def finish(self) -> RunReport:
        """Let the stages give out what they hold."""
        report = self._replay.finish()
        report.counters[self._servo_name].pop(NOT_LIVE, None)  # they went to the simulated servo
        return report

    @property
    def report(self) -> RunReport:
        """What the graph did so far."""
        return self._replay.report

    @property
    def output_hash(self) -> str:
        """Hash over every message so far, as `grd replay` writes it."""
        return self._digest.hexdigest()


def servo_edge(graph: Graph) -> tuple[str, str]:
    """Name of the servo link that the graph commands, and the output wired to it. LinkError when there is none."""
    found = [
        (edge.consumer, f"{edge.producer}.{edge.output}")
        for edge in graph.edges
        if issubclass(graph.nodes[edge.consumer].cls, Servo) and edge.port == "goal"
    ]
    if len(found) != 1:
        raise LinkError(
            f"closed loop needs one servo that the graph commands, this graph has {len(found)}: wire it as "
            "'servo: {use: links.dynamixel.Servo, inputs: {goal: aim.servo_goal}}'; configs/sim.yaml does"
        )
    return found[0]


def loop_metadata(config: Path, graph: Graph) -> dict[str, str]:
    """What a recording keeps of the configuration that closed its loop: the file's name and a hash of all it says.

    Includes are in the hash and so is the rig; taps are not: they change no message.
    """
    taps = {name for name, spec in graph.nodes.items() if issubclass(spec.cls, Tap)}
    links = {name: link for name, link in graph.values.get("links", {}).items() if name not in taps}
    said = yaml.safe_dump(graph.values | {"links": links}, sort_keys=False)
    return {"closed_loop": config.name, "closed_loop_hash": hashlib.blake2b(said.encode(), digest_size=16).hexdigest()}


def load_loop(config: Path, rig_yaml: str, scenario: str, settings: ClosedLoopSettings) -> ClosedLoop:
    """A configuration as a closed loop on a scenario's rig. Raises ConfigError with every problem, or LinkError."""
    graph = Asked(config).graph(rig_yaml, scenario)
    return ClosedLoop(graph, settings, loop_metadata(config, graph))
