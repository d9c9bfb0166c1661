"""Sweeps of simulated streets that nothing was fitted to: detections and false detections of each configuration.

Slow; run it by name. It prints the table of docs/RESULTS.md:
    python -m pytest tests/test_worlds.py -m slow -s
"""

from __future__ import annotations

import sys
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from flow.graph import load_graph
from flow.link import LinkError, Tap
from flow.message import Message
from flow.replay import Replay
from links.simulated.rig.run import Simulation
from links.simulated.rig.scenario import load_scenario
from links.simulated.world.path import Path as FlightPath
from links.simulated.world.path import Waypoint
from stages.messages import Detections, DroneFix

ROOT = Path(__file__).resolve().parents[1]
SEEDS = range(200, 212)
FLIGHTS = [None, (10.0, 1.0), (20.0, 1.0), (30.0, 1.0), (15.0, 5.0)]  # (range [m], speed [m/s]); None: no drone
SWEEP_S = 2.9
MIN_RETURNS = 4  # a drone with fewer returns is not counted as visible
MAX_ERROR_M = 1.0  # from the position of the drone at one of its returns


class DetectionLog(Tap):
    """Keeps detections and counts fixes."""

    def __init__(self) -> None:
        super().__init__()
        self.detections = []
        self.fixes = 0

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        if isinstance(message, Detections):
            self.detections.append(message)
        elif isinstance(message, DroneFix):
            self.fixes += 1


def world(seed: int, flight: tuple[float, float] | None) -> Simulation:
    """One sweep of a street; the drone passes at a random bearing, 35-75 deg up; paths through buildings are drawn again."""
    base = load_scenario(ROOT / "configs" / "scenarios" / "street_sweep.yaml")
    street = base.changed(duration_s=SWEEP_S, script=base.script[:1], drone=None)
    if flight is None:
        return Simulation(street, seed)
    range_m, speed_mps = flight
    rng = np.random.default_rng([seed, int(range_m), 99])
    while True:
        up, bearing, course = np.radians(rng.uniform(35, 75)), *rng.uniform(0, 2 * np.pi, 2)
        middle = range_m * np.array([np.cos(up) * np.cos(bearing), np.cos(up) * np.sin(bearing), np.sin(up)])
        velocity = speed_mps * np.array([np.cos(course), np.sin(course), 0.0])
        times = (0.0, SWEEP_S / 2, SWEEP_S)
        waypoints = tuple(Waypoint(t_s=t, xyz_m=tuple((middle + velocity * (t - times[1])).tolist())) for t in times)
        with suppress(LinkError):  # the path crosses a building
            return Simulation(street.with_drone(FlightPath(waypoints=waypoints)), seed)


def count_detections(detections: list[Detections], truth_m: np.ndarray | None) -> tuple[int, int]:
    """(found, false): whether an accepted candidate is the drone, and how many are not."""
    found, false = 0, 0
    for message in detections:
        for xyz_m in message.xyz_vehicle_m[message.accepted]:
            is_drone = truth_m is not None and np.linalg.norm(truth_m - xyz_m, axis=1).min() < MAX_ERROR_M
            found, false = max(found, int(is_drone)), false + (not is_drone)
    return found, false


@pytest.mark.slow
def test_how_often_a_sweep_finds_the_drone():
    configs = {
        name: load_graph(ROOT / "configs" / f"{name}.yaml", sets=["viewer.file=null"]) for name in ("paper", "replay")
    }
    table: dict[object, Counter[str]] = {flight: Counter() for flight in FLIGHTS}
    failures: list[str] = []
    for flight in FLIGHTS:
        for seed in SEEDS:
            simulation = world(seed, flight)
            taps = {name: DetectionLog() for name in configs}
            runners = {name: Replay(graph, [taps[name]]) for name, graph in configs.items()}
            for record in simulation.records():
                for runner in runners.values():
                    runner.feed(record)
            returns = len(simulation.drone_return_ns)
            return_ns = np.array(simulation.drone_return_ns, dtype=np.int64)
            truth_m = simulation.truth.T_world_drone(return_ns)[1] if returns else None
            table[flight]["worlds"] += 1
            table[flight]["visible"] += returns >= MIN_RETURNS
            for name, tap in taps.items():
                found, false = count_detections(tap.detections, truth_m)
                table[flight][f"{name} found"] += found if returns >= MIN_RETURNS else 0
                table[flight][f"{name} false"] += false
                if false:
                    failures.append(f"{name}, seed {seed}, {flight}: {false} false")
    lines = ["", "| drone | worlds | visible | paper: found, false | with gates: found, false |", "| --- " * 5 + "|"]
    for flight in FLIGHTS:
        row = table[flight]
        what = "none" if flight is None else f"{flight[0]:g} m, {flight[1]:g} m/s"
        cells = [f"{row[f'{name} found']}, {row[f'{name} false']}" for name in configs]
        lines.append(f"| {what} | {row['worlds']} | {row['visible']} | {cells[0]} | {cells[1]} |")
    sys.stdout.write("\n".join([*lines, *failures, ""]))
    # the paper baseline always reports a drone; with gates fewer than one in four empty skies give a false detection
    assert all(row["paper false"] + row["paper found"] >= row["worlds"] * 0.9 for row in table.values())
    assert table[None]["replay false"] <= len(SEEDS) / 4
