"""Sweeps of many simulated streets that nothing was fitted to: how often each configuration finds, misses, invents.

Slow, so run by name; it prints the table of docs/RESULTS.md:
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
SEEN_HITS = 4  # fewer returns are no fair test of a detector
RIGHT_M = 1.0  # of where the drone was when it returned a pulse


class Last(Tap):
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
    """One sweep of a street; the drone passes at a random bearing, 35-75 deg up: the first that is not inside a house."""
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
        with suppress(LinkError):  # no way to fly there
            return Simulation(street.with_drone(FlightPath(waypoints=waypoints)), seed)


def judge(detections: list[Detections], truth_m: np.ndarray | None) -> tuple[int, int]:
    """(found, invented): whether an accepted candidate is right, and how many are not."""
    found, invented = 0, 0
    for message in detections:
        for xyz_m in message.xyz_vehicle_m[message.accepted]:
            right = truth_m is not None and np.linalg.norm(truth_m - xyz_m, axis=1).min() < RIGHT_M
            found, invented = max(found, int(right)), invented + (not right)
    return found, invented


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
            taps = {name: Last() for name in configs}
            runners = {name: Replay(graph, [taps[name]]) for name, graph in configs.items()}
            for record in simulation.records():
                for runner in runners.values():
                    runner.feed(record)
            hits = len(simulation.drone_return_ns)
            seen_ns = np.array(simulation.drone_return_ns, dtype=np.int64)
            truth_m = simulation.truth.T_world_drone(seen_ns)[1] if hits else None
            table[flight]["worlds"] += 1
            table[flight]["seen"] += hits >= SEEN_HITS
            for name, tap in taps.items():
                found, invented = judge(tap.detections, truth_m)
                table[flight][f"{name} found"] += found if hits >= SEEN_HITS else 0
                table[flight][f"{name} invented"] += invented
                if invented:
                    failures.append(f"{name}, seed {seed}, {flight}: {invented} invented")
    lines = ["", "| drone | worlds | seen | paper: found, invented | with gates: found, invented |", "| --- " * 5 + "|"]
    for flight, row in table.items():
        what = "none" if flight is None else f"{flight[0]:g} m, {flight[1]:g} m/s"
        cells = [f"{row[f'{name} found']}, {row[f'{name} invented']}" for name in configs]
        lines.append(f"| {what} | {row['worlds']} | {row['seen']} | {cells[0]} | {cells[1]} |")
    sys.stdout.write("\n".join([*lines, *failures, ""]))
    # the literal method always answers; the gates must invent less than one in four where there is nothing
    assert all(row["paper invented"] + row["paper found"] >= row["worlds"] * 0.9 for row in table.values())
    assert table[None]["replay invented"] <= len(SEEDS) / 4
