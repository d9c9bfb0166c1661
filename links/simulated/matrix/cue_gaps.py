"""Table of the pose after a gap of the LiDAR, with and without cues, in the whole simulator.

    python -m links.simulated.matrix.cue_gaps OUT --seeds 2

The drone of configs/scenarios/experiment_2.yaml is found by LiDAR and servo in closed loop with configs/cues.yaml, with
vehicle odometry and raw IMU, without cameras; no packet of the LiDAR arrives from GAP_S[0] to GAP_S[1]. The error and
the stated sigma (root of the covariance's trace) are those of the fused position 1, 2 and 5 s into the gap.
OUT/flights.jsonl has a line for each flight; flights in it are not repeated.

Source: ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flow.link import Tap
from flow.message import Message
from links.runs.request import RunRequest
from links.runs.shipped import shipped
from links.simulated.matrix.cue_table import ALL, CONFIG, GNSS, OFF_M
from links.simulated.matrix.flight_lines import flights_parser, flown, write_table
from links.simulated.rig.closed_loop import ClosedLoop
from links.simulated.rig.run import Simulation
from links.simulated.rig.scenario import Scenario, load_scenario
from links.simulated.sensors.camera import CamerasSettings
from links.simulated.sensors.vehicle_odometry import VehicleOdometrySettings
from links.simulated.world.scene import Truth
from stages.geometry.frames import Array64
from stages.messages import CueFactor, PoseState, RelativePose
from stages.messages.pose import PoseEstimate, PositionEstimate

SCENARIO = Path("configs/scenarios/experiment_2.yaml")
GAP_S = (17.0, 22.0)
AFTER_S = (1.0, 2.0, 5.0)
CHI2_95 = 7.815  # 3 degrees of freedom
VARIANTS: dict[str, dict[str, Any] | None] = {
    "none": None,
    "gnss": GNSS,
    "all": ALL,
    "wrong: gnss 30 m off": {**GNSS, "drone": OFF_M},
}


@dataclass(frozen=True)
class Flight:
    """One flight to simulate."""

    seed: int
    variant: str
    name: str = SCENARIO.stem


class GapTap(Tap):
    """Errors of the poses in the gap."""

    def __init__(self) -> None:
        super().__init__()
        self.truth: Truth | None = None
        self.states: dict[str, int] = {}  # poses in the gap by state
        self.errors: dict[float, tuple[float, float]] = {}  # [s] into the gap: error, sigma [m] of the newest pose
        self.inside = 0  # poses in the gap whose 95 % ellipsoid holds the truth
        self.used: dict[str, int] = {}  # measurements of cues in the graph, in the gap
        self.contradicts: set[str] = set()

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Take one message."""
        truth = self.truth
        assert truth is not None
        since_s = (message.stamp_ns - truth.start_ns) * 1e-9 - GAP_S[0]
        if isinstance(message, CueFactor):
            self._on_factor(message, since_s)
        elif isinstance(message, RelativePose) and 0.0 < since_s <= GAP_S[1] - GAP_S[0]:
            self._on_pose(message, since_s, truth)

    def _on_factor(self, factor: CueFactor, since_s: float) -> None:
        if factor.contradicts:
            self.contradicts.add(factor.source)
        if factor.used and since_s > 0.0:
            self.used[factor.source] = self.used.get(factor.source, 0) + 1

    def _on_pose(self, pose: RelativePose, since_s: float, truth: Truth) -> None:
        self.states[pose.state.name] = self.states.get(pose.state.name, 0) + 1
        found = pose.estimate
        reached = [after_s for after_s in AFTER_S if since_s <= after_s]
        if found is None or pose.state is PoseState.LOST:
            for after_s in reached:
                self.errors.pop(after_s, None)
            return
        at = np.array([pose.stamp_ns])
        R, t = (part[0] for part in truth.T_world_vehicle(at))
        error_m = found.xyz_vehicle_m - R.T @ (truth.T_world_drone(at)[1][0] - t)
        covariance_m2 = position_covariance_m2(found)
        self.inside += bool(error_m @ np.linalg.solve(covariance_m2, error_m) <= CHI2_95)
        for after_s in reached:
            self.errors[after_s] = float(np.linalg.norm(error_m)), math.sqrt(float(np.trace(covariance_m2)))


def position_covariance_m2(estimate: PositionEstimate | PoseEstimate) -> Array64:
    """Of the position relative to the vehicle, vehicle axes (3, 3)."""
    if isinstance(estimate, PositionEstimate):
        return estimate.covariance_vehicle_m2
    R = estimate.R_vehicle_drone
    return R @ estimate.covariance[3:, 3:] @ R.T


def scenario_of(flight: Flight) -> Scenario:
    """The scenario of a flight."""
    return load_scenario(shipped(SCENARIO)).changed(
        seed=flight.seed,
        duration_s=GAP_S[1] + 0.2,
        cameras=CamerasSettings(),
        vehicle_odometry=VehicleOdometrySettings(),
        lidar_gaps_s=(GAP_S,),
        cues=VARIANTS[flight.variant],
    )


def fly(flight: Flight, progress: Callable[[float], None]) -> dict[str, Any]:
    """Simulate one flight."""
    scenario = scenario_of(flight)
    graph = RunRequest(shipped(CONFIG), sets=("links.viewer=null",)).graph(scenario.rig_yaml(), "the rig")
    tap = GapTap()
    simulation = Simulation(scenario, loop=ClosedLoop(graph, scenario.closed_loop, {}, [tap]), record_truth=False)
    tap.truth = simulation.truth
    for record in simulation.records():
        progress((record.arrival_ns - scenario.start_ns) * 1e-9 / scenario.duration_s)
    return {
        "cell": flight.name,
        "seed": flight.seed,
        "variant": flight.variant,
        "states": tap.states,
        "errors": {str(after_s): errors for after_s, errors in tap.errors.items()},
        "inside": tap.inside,
        "used": tap.used,
        "contradicts": sorted(tap.contradicts),
    }


def table_of(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown: by variant, RMS error / RMS sigma after each time, and how many flights were not lost then."""
    head = " | ".join(f"{after_s:g} s" for after_s in AFTER_S)
    lines = [f"| cues | flights | {head} | in 95 % ellipsoid in gaps [%] | contradiction seen |"]
    lines.append("| --- " * (len(AFTER_S) + 4) + "|")
    for variant in VARIANTS:
        of = [row for row in rows if row["variant"] == variant]
        if not of:
            continue
        cells = []
        for after_s in AFTER_S:
            there = [row["errors"][str(after_s)] for row in of if str(after_s) in row["errors"]]
            rms = np.sqrt(np.mean(np.square(there), axis=0)) if there else None
            lost = f" ({len(of) - len(there)} LOST)" if there and len(there) < len(of) else ""
            cells.append("LOST" if rms is None else f"{rms[0]:.2f} / {rms[1]:.2f}{lost}")
        poses = sum(count for row in of for state, count in row["states"].items() if state != "LOST")
        inside = 100.0 * sum(row["inside"] for row in of) / poses if poses else math.nan
        seen = sum(bool(row["contradicts"]) for row in of)
        lines.append(f"| {variant} | {len(of)} | {' | '.join(cells)} | {inside:.0f} | {seen} |")
    return "\n".join(lines)


def main() -> None:
    """The command."""
    parser = flights_parser(__doc__, cells=False)
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS), choices=list(VARIANTS))
    arguments = parser.parse_args()
    flights = [
        Flight(seed, variant)
        for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds)
        for variant in arguments.variants
    ]
    write_table(arguments.folder, table_of(flown(arguments.folder, flights, fly, arguments.jobs)))


if __name__ == "__main__":
    main()
