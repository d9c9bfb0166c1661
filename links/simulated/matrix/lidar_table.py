"""Table of the whole chain by LiDAR model: first fix, accuracy and rate of the positions.

    python -m links.simulated.matrix.lidar_table OUT --pairs --only '*-20m-[!r]*' --models XT16 XT32

Each flight is simulated in closed loop with configs/estimate.yaml, without the fusion, up to `AFTER_S` after its first
fix: perturbed and calibrated rig, autopilot, vehicle odometry, fewer rays per pulse (`grd matrix --perturbed
--calibrated --autopilot --odometry --sparse`). First fix: the first DroneFix within NEAR_M of the drone. Accuracy: RMSE
of the fixes within NEAR_M. Rate: those per second since the first. Wrong: fixes farther off. OUT/flights.jsonl has a
line for each flight; flights in it are not repeated.

Source: ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median_low
from typing import Any

import numpy as np

from flow.link import LinkError, Tap
from flow.message import Message
from links.runs.request import RunRequest
from links.runs.shipped import shipped
from links.simulated.matrix.flight_lines import CellFlight, flights_parser, flown, write_table
from links.simulated.matrix.matrix import Conditions, cells, scenario_of
from links.simulated.rig.closed_loop import ClosedLoop
from links.simulated.rig.run import Simulation
from links.simulated.world.scene import Truth
from stages.geometry.lidar_models import LIDAR_MODELS, LidarModel
from stages.messages import DroneFix

NEAR_M = 1.0  # as `grd evaluate`
AFTER_S = 5.0
CONFIG = Path("configs/estimate.yaml")
SETS = ("stages.fuse=null", "links.viewer=null")


class FixTap(Tap):
    """Errors of the fixes of a run."""

    def __init__(self) -> None:
        super().__init__()
        self.truth: Truth | None = None
        self.first_fix_s: float | None = None
        self.errors_m: list[float] = []  # of the fixes near the drone
        self.wrong = 0

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Take one message."""
        if not isinstance(message, DroneFix):
            return
        truth = self.truth
        assert truth is not None
        at = np.array([message.stamp_ns])
        R, t = (part[0] for part in truth.T_world_vehicle(at))
        error_m = float(np.linalg.norm(truth.T_world_drone(at)[1][0] - (R @ message.xyz_vehicle_m + t)))
        if error_m > NEAR_M:
            self.wrong += 1
            return
        self.errors_m.append(error_m)
        if self.first_fix_s is None:
            self.first_fix_s = (message.stamp_ns - truth.start_ns) * 1e-9


def fly(flight: CellFlight[LidarModel], progress: Callable[[float], None]) -> dict[str, Any] | None:
    """Simulate one flight. None: the scene of the seed does not allow it."""
    conditions = Conditions(
        autopilot=True, odometry=True, calibrated=True, perturbed=True, sparse=True, lidar=flight.variant
    )
    try:
        scenario = scenario_of(flight.cell, flight.seed, conditions)
    except LinkError:
        return None
    graph = RunRequest(shipped(CONFIG), sets=SETS).graph(scenario.rig_yaml(), "the rig")
    tap = FixTap()
    simulation = Simulation(scenario, loop=ClosedLoop(graph, scenario.closed_loop, {}, [tap]), record_truth=False)
    tap.truth = simulation.truth
    now_s = 0.0
    for record in simulation.records():
        now_s = (record.arrival_ns - scenario.start_ns) * 1e-9
        progress(now_s / scenario.duration_s)
        if tap.first_fix_s is not None and now_s > tap.first_fix_s + AFTER_S:
            break
    return {
        "cell": flight.name,
        "seed": flight.seed,
        "variant": flight.variant,
        "first_fix_s": tap.first_fix_s,
        "seconds": 0.0 if tap.first_fix_s is None else now_s - tap.first_fix_s,
        "errors_m": [round(error_m, 4) for error_m in tap.errors_m],
        "wrong": tap.wrong,
    }


def table_of(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown: a row for each model, over its flights."""
    lines = ["| model | flights | found | first fix [s]: median, slowest | RMSE [m] | fixes a second | wrong fixes |"]
    lines.append("| --- | --- | --- | --- | --- | --- | --- |")
    for model in LIDAR_MODELS:
        of = [row for row in rows if row["variant"] == model]
        if not of:
            continue
        first_s = sorted(row["first_fix_s"] if row["first_fix_s"] is not None else math.inf for row in of)
        errors_m = np.concatenate([np.array(row["errors_m"]) for row in of])
        seconds = sum(row["seconds"] for row in of)
        found, wrong = sum(map(math.isfinite, first_s)), sum(row["wrong"] for row in of)
        rmse, rate = (
            (f"{np.sqrt(np.mean(errors_m**2)):.3f}", f"{len(errors_m) / seconds:.1f}") if seconds else ("-", "-")
        )
        times = f"{_seconds(median_low(first_s))}, {_seconds(first_s[-1])}"
        lines.append(f"| {model} | {len(of)} | {found} | {times} | {rmse} | {rate} | {wrong} |")
    return "\n".join(lines)


def _seconds(value_s: float) -> str:
    return f"{value_s:.1f}" if math.isfinite(value_s) else "not found"


def main() -> None:
    """The command."""
    parser = flights_parser(__doc__)
    parser.add_argument("--models", nargs="*", default=list(LIDAR_MODELS), choices=list(LIDAR_MODELS))
    arguments = parser.parse_args()
    flights = [
        CellFlight(cell, seed, model)
        for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds)
        for cell in cells(arguments.only or ["*"], arguments.pairs)
        for model in arguments.models
    ]
    write_table(arguments.folder, table_of(flown(arguments.folder, flights, fly, arguments.jobs)))


if __name__ == "__main__":
    main()
