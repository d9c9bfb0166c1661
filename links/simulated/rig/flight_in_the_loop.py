"""The autopilot in the loop within a simulation: it flies the drone, and receives what the graph sends.

Source: ours.
"""

from __future__ import annotations

import numpy as np

from flow.graph import Graph
from flow.link import TRUTH_TOPICS, LinkError, Record
from links.simulated.autopilot.flight_stack.outcomes.outcome import FlightOutcome, Outcome
from links.simulated.autopilot.flight_stack.stack import FlightStack
from links.simulated.pose_sensors.pose_source import SimulatedFixes, SimulatedRotations
from links.simulated.rig.closed_loop import ClosedLoop
from links.simulated.rig.pose_loop import has_autopilot, pose_edge
from links.simulated.rig.scenario import Scenario
from links.simulated.sensors.vehicle_odometry import VehicleOdometry
from links.simulated.world.clearance import visible
from links.simulated.world.mesh import RayScene
from links.simulated.world.scene import Truth

OUTCOME_TOPIC = f"{TRUTH_TOPICS}/flight"
SENSORS = (  # of a scenario: name, link that reads it, what it replaces, a configuration with and without it
    ("fix_sensor", SimulatedFixes, "a LiDAR", "sim_flight_fixes.yaml", "sim_flight.yaml"),
    ("rotation_sensor", SimulatedRotations, "cameras", "sim_flight_rotations_fixes.yaml", "sim_flight_yaw_fixes.yaml"),
)
ABOVE_M = 50.0  # over the place of a take-off, must be free


def check_loop(graph: Graph, scenario: Scenario) -> None:
    """Raise LinkError for a graph that lacks what a scenario in closed loop needs, or reads what it does not have."""
    for name, link, replaced, with_it, without in SENSORS:
        has = getattr(scenario, name) is not None
        reads = any(issubclass(spec.cls, link) for spec in graph.nodes.values())
        if reads and not has:
            raise LinkError(
                f"the scenario {scenario.name} has no {name}, which the configuration reads: use one that does not, as "
                f"configs/{without}, or set {name}={{}} of the scenario"
            )
        if has and not reads:
            raise LinkError(
                f"the scenario {scenario.name} has a {name} in place of {replaced}, which the configuration does not "
                f"read: use configs/{with_it}, or one that includes it"
            )
    stack = None if scenario.autopilot is None else scenario.autopilot.flight_stack
    if stack is not None and graph.left_out:
        raise LinkError(
            f"the rig of the scenario {scenario.name} lacks what the configuration needs: "
            f"{'; '.join(graph.left_out_texts())}. Use another configuration or scenario"
        )
    if stack is not None and not (has_autopilot(graph) and pose_edge(graph)[1]):
        raise LinkError(
            f"the autopilot of the scenario {scenario.name} flies on poses of grd (flight_stack), and the "
            "configuration sends none: wire 'autopilot: {inputs: {pose: fuse.relative_pose}}', as sim_flight.yaml does"
        )


class FlightInTheLoop:
    """One flight. Without a `loop` the autopilot receives nothing."""

    def __init__(self, scenario: Scenario, loop: ClosedLoop | None, odometry: VehicleOdometry | None) -> None:
        assert scenario.drone is not None
        assert scenario.autopilot is not None
        self.stack = FlightStack(
            scenario.autopilot,
            scenario.drone.path,
            scenario.vehicle.path,
            -scenario.vehicle.camera_height_m,
            scenario.start_ns,
            scenario.duration_s,
            scenario.seed,
            odometry.drift_m if odometry is not None else None,
        )
        self._loop, self._odometry = loop, odometry
        self._outcome: FlightOutcome | None = None
        if loop is not None:
            loop.connect_autopilot(scenario.start_ns)

    def watch(self, world: RayScene, truth: Truth) -> None:
        """Look for collisions with the scene, and compare sent poses with the truth."""
        start_m = self.stack.quadrotor.state[None, 0:3]
        if self.stack.settings.on_ground and not visible(world, start_m, start_m + np.array([0.0, 0.0, ABOVE_M]))[0]:
            x, y, _ = start_m[0]
            raise LinkError(f"drone.path: something stands where it takes off, ({x:.1f}, {y:.1f}) m: move its start")
        self._outcome = FlightOutcome(self.stack, world, truth, self._odometry)

    def is_over(self) -> bool:
        """Whether the flight was lost some time ago; called after each part of it."""
        return self._outcome is not None and self._outcome.is_over()

    def arrived(self, record: Record) -> Record | None:
        """A record as the host receives it; None: it does not (the host is down, or rejects the frame)."""
        if self._loop is None or record.topic.startswith(TRUTH_TOPICS):
            return record
        return self._loop.receive(record)

    def sent(self) -> list[Record]:
        """Frames that the host has sent since the last call; they go to the autopilot."""
        if self._loop is None:
            return []
        frames = self._loop.sent()
        if self._loop.sent_frame is not None:
            self.stack.sent_frame = self._loop.sent_frame
        for frame in frames:
            if frame.stamp_ns != frame.arrival_ns:
                continue  # of an earlier run: recorded again, not sent
            self.stack.receive(frame.data, frame.arrival_ns)
            if self._outcome is not None:
                self._outcome.on_sent(frame, self._loop.sent_frame)
        return frames

    def result(self) -> Outcome | None:
        """The outcome."""
        heading_s = None if self._loop is None else self._loop.heading_s
        return None if self._outcome is None else self._outcome.result(heading_s)

    def record(self, at_ns: int) -> Record | None:
        """The outcome as a record."""
        outcome = self.result()
        return None if outcome is None else Record(OUTCOME_TOPIC, at_ns, at_ns, outcome.as_json())
