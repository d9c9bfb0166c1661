"""Two drones in one sky, each with an autopilot: what each chain of stages finds and would send. A table per flight.

    python -m tests.benchmarks.system.two_drones wander --first-seed 731 --flights 5

The simulated servo executes the goals of the aim stage, which it shares between both drones. A pose counts as sent when
the autopilot's gate accepts it, with positions only or with yaw. The flights:

    wander      each on its own random path, at up to 12 m/s
    apart       the first in an orbit at 3 m/s, the second hovers
    hover       both hover: nothing shows which drone carries which autopilot
    formation   the second 4 m beside the first on the same path, one in which nothing shows it either
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flow.link import LinkError, Tap
from flow.message import Message
from links.mavlink.poses.gate import PoseLimits
from links.mavlink.poses.position_gate import gate_reason
from links.runs.request import RunRequest
from links.simulated.matrix.flights import Cell, motions, path_of
from links.simulated.matrix.matrix import DRONE, LIDAR_UP_M, Conditions, scenario_of
from links.simulated.rig.closed_loop import ClosedLoop
from links.simulated.rig.run import Simulation
from links.simulated.rig.scenario import Scenario
from stages.messages import DroneFix, RelativePose

CONFIG = Path(__file__).parents[3] / "configs/two_drones.yaml"
CONDITIONS = Conditions(calibrated=True, odometry=True, autopilot=True, sparse=True)
KINDS = {"wander": ("wander", "wander"), "apart": ("orbit", "hover"), "hover": ("hover", "hover")}
DURATION_S, KNOT_S = 20.0, 0.5
WRONG_M = 1.0
HEAD = "seed drone  first fix [s]  fixes/s  RMSE [m]  of other drone  poses  wrong   sent  wrong  yaw sent  wrong"


class Outputs(Tap):
    """Keeps the fixes and poses of each stage."""

    def __init__(self) -> None:
        super().__init__()
        self.of: defaultdict[str, list[Any]] = defaultdict(list)

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Keep a fix or a pose."""
        if isinstance(message, DroneFix | RelativePose):
            self.of[output].append(message)


def scenario(kind: str, seed: int, attempt: int) -> Scenario:
    """Two drones 20 m from a parked vehicle, 50 to 130 deg apart at the start."""
    base = scenario_of(Cell("open_lot", 20, "hover", "parked"), seed, CONDITIONS)
    rng, knots = np.random.default_rng([seed, attempt]), np.arange(0.0, DURATION_S + KNOT_S, KNOT_S)
    azimuth, apart = rng.uniform(-np.pi, np.pi), rng.choice([-1.0, 1.0]) * np.radians(rng.uniform(50.0, 130.0))
    paths: list[np.ndarray] = []
    for motion, at in zip(KINDS.get(kind, ("wander",)), (azimuth, azimuth + apart), strict=False):
        cell = Cell("open_lot", 20, motion, "parked")
        paths.append(next(motions(cell, at, rng.uniform(0.7, 1.2)))(knots) + np.array([0.0, 0.0, LIDAR_UP_M]))
    if kind == "formation":
        paths.append(paths[0] + 4.0 * np.array([np.cos(azimuth + apart), np.sin(azimuth + apart), 0.0]))
    drones = [{"path": path_of(knots, path), "model": DRONE} for path in paths]
    other = {**drones[1], "autopilot": {"heading_of_world_x_deg": 140.0, "boot_s": 95.5}}
    return base.changed(duration_s=DURATION_S, drone=drones[0], other_drones=[other], truth_visible=False)


def fly(kind: str, seed: int, sets: Sequence[str]) -> list[str]:
    """A row for each drone."""
    for attempt in range(20):
        try:
            flight = scenario(kind, seed, attempt)
            outputs, request = Outputs(), RunRequest(CONFIG, sets=("viewer.file=null", *sets))
            graph = request.graph(flight.rig_yaml(), flight.name)
            simulation = Simulation(
                flight, loop=ClosedLoop(graph, flight.closed_loop, {}, (outputs,)), record_truth=False
            )
        except (LinkError, ValueError):  # a path meets the scene or the other drone
            continue
        for _ in simulation.records():
            pass
        return [row(simulation, outputs.of, seed, number) for number in (1, 2)]
    raise LinkError(f"seed {seed}: no free flight")


def row(simulation: Simulation, outputs: dict[str, list[Any]], seed: int, number: int) -> str:
    """One drone's figures: errors are distances from its own true position."""
    suffix = "" if number == 1 else f"_{number}"
    fixes, poses = outputs[f"track{suffix}.drone_fix"], outputs[f"fuse{suffix}.relative_pose"]
    error_m, other_m = (errors(simulation, fixes, n) for n in (number, 3 - number))
    own = error_m < WRONG_M
    first = next((f.stamp_ns for f, is_own in zip(fixes, own, strict=True) if is_own), None)
    first_s = np.nan if first is None else (first - simulation.scenario.start_ns) * 1e-9
    rate = own.sum() / (DURATION_S - first_s)
    rmse_m = np.sqrt(np.mean(error_m[own] ** 2)) if own.any() else np.nan
    known = [pose for pose in poses if pose.estimate is not None]
    pose_m = errors(simulation, known, number)
    text = f"{seed:4} {number:5}  {first_s:13.1f}  {rate:7.1f}  {rmse_m:8.3f}  {np.sum(other_m < WRONG_M):14}"
    text += f"  {len(known):5}  {np.sum(pose_m > WRONG_M):5}"
    for yaw in ("none", "measured"):
        passed = [gate_reason(pose, pose.stamp_ns, PoseLimits(), yaw) is None for pose in known]
        sent_m = pose_m[np.array(passed, dtype=bool)]
        text += f"  {len(sent_m):{5 if yaw == 'none' else 8}}  {np.sum(sent_m > WRONG_M):5}"
    return text


def errors(simulation: Simulation, messages: Sequence[Any], number: int) -> np.ndarray:
    """Distances (n,) of fixes or poses from a drone's true position [m]."""
    if not messages:
        return np.empty(0)
    stamps = np.array([message.stamp_ns for message in messages])
    (R, t), drone_m = simulation.truth.T_world_vehicle(stamps), simulation.truth.T_world_drone(stamps, number)[1]
    xyz_m = np.array([getattr(m, "estimate", m).xyz_vehicle_m for m in messages])
    return np.linalg.norm(xyz_m - np.einsum("nji,nj->ni", R, drone_m - t), axis=1)


def main() -> None:
    """Fly and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=[*KINDS, "formation"])
    parser.add_argument("--first-seed", type=int, default=731)
    parser.add_argument("--flights", type=int, default=5)
    parser.add_argument("--set", action="append", default=[], help="a setting, as aim.search_s=0.8")
    args = parser.parse_args()
    print(HEAD)  # noqa: T201
    for seed in range(args.first_seed, args.first_seed + args.flights):
        print("\n".join(fly(args.kind, seed, args.set)), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
